"""The sprint tasks: where an episode ends."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class Task:
    """Describe one optimisation task.

    Every task starts the robot at ``start_x_m`` facing +x, rewards forward displacement of the torso and ends an
    episode when the torso sinks below ``min_height_m``. What differs is what else ends it.
    """

    name: str
    """The name a specification refers to."""
    summary: str
    """One line for people."""
    finish_x_m: float | None
    """World x of the finish line in metres; None when there is none."""
    max_steps: int
    """Length limit of an episode in steps of 20 ms."""
    horizon_is_terminal: bool
    """Whether reaching ``max_steps`` is part of the task; if not, it is a time limit and values are bootstrapped."""
    min_height_m: float
    """Torso height in metres below which the robot has fallen, unless the specification says otherwise."""
    start_x_m: float = -14.0
    """World x of the torso at the start in metres."""
    start_y_m: float = 0.0
    """World y of the torso at the start in metres."""


MIN_HEIGHT_M = 0.27
"""Torso height that ends an episode in the paper's main runs, metres."""

ERECT_MIN_HEIGHT_M = 0.33
"""Torso height that ends an episode in the paper's erect variant, metres."""

FINISH_X_M = 14.0
"""World x of the finish line of sprint task I, metres."""

# A robot that neither falls nor arrives would run for ever; 60 s is twice what the slowest useful walk needs.
_SPRINT1_LIMIT = 3000


def _sprints() -> tuple[Task, ...]:
    tasks = []
    for suffix, height, word in (("", MIN_HEIGHT_M, ""), ("-erect", ERECT_MIN_HEIGHT_M, ", torso kept erect")):
        tasks.append(
            Task(
                name=f"sprint1{suffix}",
                summary=f"Run 28 m to the finish line at x = 14 m{word}.",
                finish_x_m=FINISH_X_M,
                max_steps=_SPRINT1_LIMIT,
                horizon_is_terminal=False,
                min_height_m=height,
            )
        )
        tasks.append(
            Task(
                name=f"sprint2{suffix}",
                summary=f"Run as far as possible in 400 steps (8 s){word}.",
                finish_x_m=None,
                max_steps=400,
                horizon_is_terminal=True,
                min_height_m=height,
            )
        )
    return tuple(tasks)


TASKS: Mapping[str, Task] = MappingProxyType({task.name: task for task in _sprints()})
"""All tasks by name."""


def task(name: str) -> Task:
    """Return the task called ``name``.

    Raises:
        ValueError: if there is no such task; the message lists those that exist.
    """
    try:
        return TASKS[name]
    except KeyError:
        raise ValueError(f"unknown task {name!r}: choose one of {', '.join(TASKS)}") from None
