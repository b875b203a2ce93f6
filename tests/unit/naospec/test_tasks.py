"""Test the table of tasks."""

from __future__ import annotations

import dataclasses

import pytest
from naospec import TASKS, task


def test_task_one_has_a_finish_line_and_task_two_a_horizon() -> None:
    """The two sprint tasks of the paper end where it says."""
    assert task("sprint1").finish_x_m == 14.0
    assert not task("sprint1").horizon_is_terminal
    assert task("sprint2").finish_x_m is None
    assert task("sprint2").max_steps == 400
    assert task("sprint2").horizon_is_terminal


def test_erect_variants_differ_in_height_alone() -> None:
    """An erect task is its sibling with a higher limit."""
    for name in ("sprint1", "sprint2"):
        upright = dataclasses.asdict(task(f"{name}-erect"))
        plain = dataclasses.asdict(task(name))
        assert (plain["min_height_m"], upright["min_height_m"]) == (0.27, 0.33)
        differing = {key for key in plain if plain[key] != upright[key]}
        assert differing == {"name", "summary", "min_height_m"}


def test_table_is_keyed_by_name() -> None:
    """A task is found under its own name."""
    assert all(name == entry.name for name, entry in TASKS.items())


def test_unknown_task_lists_the_known() -> None:
    """The message says what exists."""
    with pytest.raises(ValueError, match="sprint1, sprint2"):
        task("swim")
