"""A child's report is read back, or its absence detected."""

from __future__ import annotations

from pathlib import Path

import pytest
from naosprint_worker.outcome import OUTCOME_FILE, Outcome, TrainerExitCode, describe_exit, last_lines, public


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


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (
            "(psycopg.errors.X) no\nDETAIL:  Key (id)=(7)\n[SQL: INSERT INTO jobs]\n[parameters: {}]",
            "(psycopg.errors.X) no",
        ),
        ("writing: IntegrityError: no [SQL: UPDATE jobs SET x = 1", "writing: IntegrityError: no"),
        ("No such file: '/srv/w 1/work/job_1/a b.npz'", "No such file: '…/a b.npz'"),
        ("the worker's folder /srv/w/work: disk full", "the worker's folder …/work: disk full"),
        ("'/a/b' -> '/c/d'; last output: /usr/bin/x: bad", "'…/b' -> '…/d'; last output: …/x: bad"),
        ("GET http://store:9000/b?X-Amz-Signature=1: 403", "GET (address) 403"),
        ("postgresql+psycopg://u:p@h/d, file:///srv/a/b", "(address) (address)"),
        ("7 m/s of 3/4, algorithm.gamma or/and sprint1", "7 m/s of 3/4, algorithm.gamma or/and sprint1"),
    ],
)
def test_an_error_for_users_has_no_internals(text: str, shown: str) -> None:
    assert public(text) == shown


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
