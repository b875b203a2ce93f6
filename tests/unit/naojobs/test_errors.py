"""What of an error its user sees."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from naojobs.errors import public

SITE = next(path for path in sys.path if path.endswith("site-packages"))
STDLIB = Path(json.__file__).parents[1]


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
        (f'File "{SITE}/naosprint/rl/train.py", line 3', 'File "naosprint/rl/train.py", line 3'),
        (f"{STDLIB}/json/decoder.py:355: bad", "json/decoder.py:355: bad"),
        (f"{SITE}/own/weights.npz", "…/weights.npz"),
        ('File "/home/ann/venv/lib/own/task.py", line 3', 'File "…/task.py", line 3'),
        (
            'to server at "10.0.0.5", port 5432 failed; at "db" (10.0.0.5), port 5432 failed',
            'to server at (address) failed; at "db" (10.0.0.5), port 5432 failed',
        ),
        (
            "no\nDETAIL: x\ny\n\nThe above was the cause\nno\n[SQL: SELECT\n1]\n(Background on it)\n\nValueError",
            "no\n\nThe above was the cause\nno\n\nValueError",
        ),
        ("7 m/s of 3/4, algorithm.gamma or/and sprint1", "7 m/s of 3/4, algorithm.gamma or/and sprint1"),
    ],
)
def test_an_error_for_users_has_no_internals(text: str, shown: str) -> None:
    assert public(text) == shown


@pytest.mark.parametrize("text", ["\n", "/a", "'/ab/", "a.b+", "DETAIL: \n", " \n", "[SQL: x"])
def test_the_time_for_a_text_grows_with_its_length(text: str) -> None:
    public(text * 100_000)  # minutes if it grew with the square
