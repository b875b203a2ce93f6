"""Identifiers."""

from __future__ import annotations

import re

import pytest
from naojobs.ids import PATTERN, new_id, same_id


def test_ids_are_unlike_and_fit_their_pattern() -> None:
    ids = [new_id("job") for _ in range(10_000)]
    assert len(set(ids)) == len(ids)
    assert all(re.fullmatch(PATTERN, item) for item in ids)


def test_ids_sort_by_time(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([10**15, 10**15 + 10**6, 1_700_000_000 * 10**9, 1_900_000_000 * 10**9, 4_000_000_000 * 10**9])
    monkeypatch.setattr("naojobs.ids.time.monotonic_ns", lambda: next(times))
    ids = [new_id("job") for _ in range(5)]
    assert ids == sorted(ids)


def test_one_thing_of_another_has_its_digits() -> None:
    checkpoint = new_id("ckpt")
    assert same_id("eval", checkpoint) == same_id("eval", checkpoint) == f"eval_{checkpoint.removeprefix('ckpt_')}"
    assert re.fullmatch(PATTERN, same_id("eval", checkpoint))
