"""The commands of README, tutorial and how-tos work on a running service, typed as they stand."""

from __future__ import annotations

import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
sys.path.insert(0, str(ROOT / "docs"))
import check_documents  # noqa: E402

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(1200)]
NAMED_FILE = re.compile(r"^```(?:yaml|toml)\n# ([\w-]+\.(?:yaml|toml))\n(.*?)^```", re.MULTILINE | re.DOTALL)


def text_of(document: str) -> str:
    return (ROOT / document).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def service() -> Iterator[tuple[check_documents.Shell, str]]:
    """A shell, and the address of the service that README's command starts in it."""
    # A short path, because sockets lie in it.
    folder = Path(tempfile.mkdtemp(prefix="nao-"))
    try:
        home, work = folder / "home", folder / "work"
        home.mkdir()
        work.mkdir()
        shell = check_documents.Shell(work, home, Path(sys.executable).parent)
        _, stays, _ = check_documents.split(check_documents.commands(text_of("README.md")))
        assert stays == "naoctl up"
        with shell.service(stays) as url:
            yield shell, url
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.parametrize("document", ["README.md", "docs/tutorial.md", "docs/how-to/sweeps.md", "docs/how-to/tune.md"])
def test_the_commands_of_a_document_work(service: tuple[check_documents.Shell, str], document: str) -> None:
    shell, url = service
    text = text_of(document)
    for name, content in NAMED_FILE.findall(text):
        (shell.folder / name).write_text(content)
    _, stays, lines = check_documents.split(check_documents.commands(text))
    assert stays in ("", "naoctl up")
    assert check_documents.typed(shell, lines, url) == len([line for line in lines if not re.match("[A-Z]+=", line)])
