"""Jobs, step counts and folders in the documents match their commands."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from naoctl.cli import build_app
from naospec import TrainingSpec
from typer.testing import CliRunner

from . import documents
from .documents import ROOT, Command

SUBMITS = [command for command in documents.commands() if command.words[:2] == ("naoctl", "submit")]
#: Steps in the names of checkpoints and in progress lines.
STEPS = re.compile(r"(?:checkpoint|export)-0*(\d+)|of ([\d,]+) steps")


def dry_run(words: tuple[str, ...], folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(build_app(), [*words[1:], *([] if "--dry-run" in words else ["--dry-run"])])
    assert done.exit_code == 0, f"{shlex.join(words)}: {done.output}{done.exception}"
    printed: dict[str, Any] = json.loads(done.stdout)
    return printed.get("job", printed)


def write_job_files(document: Path, folder: Path) -> None:
    """Write the files in a document: blocks whose first line is a comment with the name."""
    for language in ("yaml", "toml"):
        for text in documents.blocks(document, language):
            if name := re.match(r"# ([\w-]+\.(?:yaml|toml))\n", text):
                (folder / name[1]).write_text(text)


@pytest.mark.parametrize("command", SUBMITS, ids=str)
def test_every_submit_in_the_documents_is_a_job(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_job_files(ROOT / command.document, tmp_path)
    job = dry_run(command.words, tmp_path, monkeypatch)
    assert TrainingSpec.model_validate(job["spec"]).planned_steps == job["spec"]["total_steps"]


@pytest.mark.parametrize(
    "name", ["README.md", "docs/tutorial.md", "docs/how-to/export.md", "docs/how-to/rcssservermj.md"]
)
def test_step_counts_are_those_of_the_documents_own_jobs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A training of 3 million steps ends at a whole rollout, and its checkpoint has that name."""
    write_job_files(ROOT / name, tmp_path)
    usual = ("naoctl", "submit", "--steps", "3000000")  # the training of `make demo`
    planned = {
        dry_run(words, tmp_path, monkeypatch)["spec"]["total_steps"]
        for words in [usual, *(command.words for command in SUBMITS if command.document == name)]
    }
    shown = {int((match[1] or match[2]).replace(",", "")) for match in STEPS.finditer((ROOT / name).read_text("utf-8"))}
    assert shown <= planned, f"{name} shows {shown - planned}, its jobs have {planned}"


def test_the_report_is_in_the_folder_that_the_tutorial_names() -> None:
    text = (ROOT / "docs" / "tutorial.md").read_text("utf-8")
    (line,) = [line for line in text.splitlines() if line.startswith("naoctl report ")]
    command, page = line.split("#")[0].split(), line.rsplit(" ", 1)[1]
    from naoctl.commands.artifacts import REPORT_PAGE

    assert page == f"{command[command.index('-o') + 1]}/report/{REPORT_PAGE}"
