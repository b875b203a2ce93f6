"""Positions of followers, and filters of jobs."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from naojobs.models import Job
from naosprint_api.queries import JobFilter, Position
from sqlalchemy import select

NUMBER = st.integers(0, 10**17)


@given(NUMBER, NUMBER, NUMBER)
def test_a_position_survives_the_way_to_the_client_and_back(metrics: int, logs: int, events: int) -> None:
    position = Position(metrics, logs, events)
    assert Position.parse(str(position)) == position


@pytest.mark.parametrize(
    "text", ["", "1", "1-2", "1-2-3-4", "a-b-c", "--", "1--2", "-1-2-3", "1-2-" + "9" * 30, "\u0663-1-1"]
)
def test_anything_else_is_none(text: str) -> None:
    assert Position.parse(text) is None


def test_a_search_reads_no_specification() -> None:
    """The names of task and robot are columns of their own; a specification takes longer to read than all the rest."""
    condition = str(JobFilter(text="kick").apply(select(Job.id)).whereclause)  # type: ignore[arg-type]
    assert "jobs.spec" not in condition
    for column in ("name", "id", "tags", "task", "robot"):
        assert f"jobs.{column}" in condition
