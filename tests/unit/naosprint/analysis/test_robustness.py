"""Ranges of disturbances: what is searched, kept, plotted and refused."""

from __future__ import annotations

import json
from pathlib import Path

import naopolicies
import pytest
from naosprint.__main__ import main
from naosprint.analysis import figures
from naosprint.analysis.robustness import DISTURBANCES, Disturbance, Point, examine

DELAY = next(each for each in DISTURBANCES if each.name == "delay")


def test_the_range_ends_where_too_many_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search finds every border of the grid, with few runs, and keeps what it has run in order."""
    pushes = next(each for each in DISTURBANCES if each.name == "pushes")
    for border in (None, *range(len(pushes.strengths))):
        limit = -1.0 if border is None else pushes.strengths[border]

        def run(checkpoint: Path, disturbance: Disturbance, strength: float, *_: int, limit: float = limit) -> Point:
            return Point(strength, 0.05 if strength <= limit else 0.06, 0.0, 1.0)

        monkeypatch.setattr("naosprint.analysis.robustness._run", run)
        (found,) = examine(Path("unused"), names=["pushes"])
        assert found.reached == (None if border is None else limit)
        assert found.complete == (border == len(pushes.strengths) - 1)
        assert len(found.points) <= 7
        assert [point.strength for point in found.points] == sorted(point.strength for point in found.points)


def test_a_policy_is_examined_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """t1-sprint stands no delay; the NAO's engine has no pushes, which is said instead of a range."""
    arguments = ["--episodes", "3", "--threads", "1", "--output", str(tmp_path)]
    assert main(["examine", "t1-sprint", "--only", "delay", *arguments]) == 0
    assert "delay     Delay              none" in capsys.readouterr().out
    written = json.loads((tmp_path / "robustness.json").read_text(encoding="utf-8"))
    (delay,) = written["ranges"]
    assert delay["reached"] == 0.0 and delay["points"][0][:2] == [0.0, 0.0] and delay["points"][-1][:2] == [5.0, 1.0]
    assert (tmp_path / "robustness.svg").read_text(encoding="utf-8").count("<svg") == 1
    assert main(["examine", "sprint", "--only", "pushes", *arguments[:4]]) == 0
    assert "not possible in this simulator" in capsys.readouterr().out


def test_figures_have_a_panel_for_each_range_that_was_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "naosprint.analysis.robustness._run", lambda *arguments: Point(arguments[2], arguments[2] / 10.0, 0.0, 1.0)
    )
    ranges = examine(naopolicies.folder("t1-sprint"))
    assert len(figures.robustness(ranges, 0.05).axes) == len(DISTURBANCES)


def test_unknown_disturbances_and_impossible_numbers_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        (["--only", "rain"], "rain: unknown; choose among pushes"),
        (["--episodes", "0"], "--episodes: must be between 1"),
        (["--most-failures", "5"], "--most-failures: must be at least 0 and less than 1"),
    ):
        assert main(["examine", "t1-sprint", *arguments]) == 1
        assert message in capsys.readouterr().err
