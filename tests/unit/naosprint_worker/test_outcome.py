"""A child's report is read back, or its absence detected."""

from __future__ import annotations

from pathlib import Path

import pytest
from naosprint_worker.outcome import OUTCOME_FILE, Outcome, TrainerExitCode, describe_exit, last_lines


def test_outcome_survives_the_round_trip(tmp_path: Path) -> None:
    outcome = Outcome(TrainerExitCode.PERMANENT, "diverged", "loss is not finite at step 4096 — ö", "Traceback …")
    outcome.write(tmp_path)
    assert Outcome.read(tmp_path) == outcome
    assert [path.name for path in tmp_path.iterdir()] == [OUTCOME_FILE]


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"kind": "a"}', '{"code": 3, "kind": "a", "message": "b"}', "\x00"]
)
def test_a_damaged_outcome_counts_as_none(tmp_path: Path, text: str) -> None:
    (tmp_path / OUTCOME_FILE).write_text(text)
    assert Outcome.read(tmp_path) is None


def test_no_outcome(tmp_path: Path) -> None:
    assert Outcome.read(tmp_path) is None


def test_last_lines_reads_only_the_end(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_bytes(b"\xff" * 100_000 + b"\none\n\n  two  \n")
    assert last_lines(path, lines=2) == "one\n  two"
    assert len(last_lines(path)) < 10_000
    assert last_lines(tmp_path / "missing") == ""


@pytest.mark.parametrize(
    ("status", "words"),
    [(0, "exit code 0"), (65, "exit code 65"), (-9, "signal 9 (SIGKILL)"), (-11, "signal 11 (SIGSEGV)")],
)
def test_exit_in_words(status: int, words: str) -> None:
    assert describe_exit(status) == words
