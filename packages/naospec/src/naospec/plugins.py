"""Robots, simulators, tasks and learners that installed packages offer, found through entry points.

A package offers one by an entry point in its metadata, whose name is the name that specifications use::

    [project.entry-points."naosprint.tasks"]
    run-backwards = "naosprint_backwards:RunBackwards"
"""

from __future__ import annotations

import threading
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

ROBOTS = "naosim.robots"
SIMULATORS = "naosim.simulators"
TASKS = "naosprint.tasks"
LEARNERS = "naosprint.learners"
ROBOT_DEFAULTS = "naosprint.robots"

_NOUNS = {ROBOTS: "robot", SIMULATORS: "simulator", TASKS: "task", LEARNERS: "algorithm"}


# Python refuses an import where threads import modules that need each other. Reentrant: plug-ins load others.
_LOADING = threading.RLock()


class UnknownPluginError(ValueError):
    """Reference to a robot, simulator, task or learner that no installed package offers."""


class BrokenPluginError(RuntimeError):
    """Entry point that cannot be loaded, or whose name is taken twice."""


@cache
def _entries(group: str) -> dict[str, EntryPoint]:
    found: dict[str, EntryPoint] = {}
    for entry in entry_points(group=group):
        other = found.get(entry.name)
        if other is not None and other.value != entry.value:
            raise BrokenPluginError(
                f"{group}: {entry.name!r} is offered twice, as {other.value} and {entry.value}; uninstall one of them"
            )
        found[entry.name] = entry
    return found


def names(group: str) -> tuple[str, ...]:
    """Return the names that a group offers, sorted."""
    return tuple(sorted(_entries(group)))


@cache
def load(group: str, name: str) -> Any:
    """Return what a group offers under ``name``.

    Raises:
        UnknownPluginError: if there is nothing of that name; the message lists the available ones.
        BrokenPluginError: if it cannot be imported.
    """
    entry = _entries(group).get(name)
    if entry is None:
        raise UnknownPluginError(
            f"unknown {_NOUNS.get(group, group)} {name!r}: choose one of {', '.join(names(group)) or 'none'}"
        )
    try:
        with _LOADING:
            return entry.load()
    except Exception as error:
        package = entry.dist.name if entry.dist is not None else entry.value
        raise BrokenPluginError(
            f"{name}: package {package} offers it as {entry.value}, which cannot be loaded: {error}"
        ) from error
