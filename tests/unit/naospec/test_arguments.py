"""An argument that is empty is refused by name: as a path it would be the current folder."""

from __future__ import annotations

import pytest
from naojobs.__main__ import main as naojobs
from naosim.cli import main as naosim
from naosprint.__main__ import main as naosprint


@pytest.mark.parametrize(
    ("main", "words", "name"),
    [
        (naosprint, ["train", ""], "workdir"),
        (naosprint, ["train", "new", "--from-policy", ""], "--from-policy"),
        (naosprint, ["train", "new", "--resume="], "--resume"),
        (naosprint, ["evaluate", "sprint", "--output", ""], "--output"),
        (naosprint, ["match", "example", ""], "TEAM"),
        (naosim, ["check", ""], "TRACE.npz"),
        (naojobs, ["artifacts", "export", ""], "file"),
    ],
)
def test_an_empty_argument_is_refused_by_name(
    main: object, words: list[str], name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert callable(main)
    with pytest.raises(SystemExit, match="2"):
        main(words)
    assert capsys.readouterr().err.endswith(f"{name}: is empty\n")
