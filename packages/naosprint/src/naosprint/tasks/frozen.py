"""Policies that act inside a task without being trained: a walker that takes over after a kick, for example."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import naopolicies
import numpy as np
from naospec import TrainingSpec, plugins, read_stored

if TYPE_CHECKING:
    from naosprint.arrays import FloatArray, IntArray
    from naosprint.tasks.observations import Observer

_MOST_NAMED = 6
"""Most observations that a message names."""


class FrozenPolicy:
    """A bundled policy that acts on those observations of another task that have the names of its own.

    Args:
        name: name of the bundled policy.

    Attributes:
        name: its name.
        spec: the specification of the last stage of its training.
        observations: names of what it observes.

    Raises:
        ValueError: if there is no policy of this name.
    """

    def __init__(self, name: str) -> None:
        folder, manifest = naopolicies.folder(name), naopolicies.checkpoint(name)
        self.name = name
        self.spec = read_stored(TrainingSpec, manifest["spec"]).stage_specs[-1]
        self.observations: tuple[str, ...] = tuple(manifest["observations"])
        kind = plugins.load(plugins.LEARNERS, self.spec.algorithm.name)
        with np.load(folder / naopolicies.WEIGHTS) as arrays:
            self._policy = kind.load_policy(
                dict(arrays), self.spec.algorithm, observations=self.observations, actions=manifest["actions"]
            )
        self._columns: dict[tuple[str, ...], IntArray] = {}

    def act(self, observer: Observer, rows: slice | IntArray) -> FloatArray:
        """Return (k, A) actions for the robots ``rows``.

        Raises:
            ValueError: if something that it observes is missing; the message names it.
        """
        names = observer.names
        if names not in self._columns:
            missing = sorted(set(self.observations) - set(names))
            if missing:
                named = ", ".join(missing[:_MOST_NAMED]) + (" and others" if len(missing) > _MOST_NAMED else "")
                raise ValueError(f"policy {self.name} cannot act here: it observes {named}, too")
            self._columns[names] = np.array([names.index(name) for name in self.observations])
        return self._policy.act(observer.observations[rows][:, self._columns[names]])


@cache
def bundled(robot: str, task: str) -> dict[str, dict[str, Any]]:
    """Return the bundled policies that move this robot and were last trained for this task.

    Returns:
        By name the task's settings of each that differ from their defaults; no weights are read.
    """
    found = {}
    for name in naopolicies.names():
        spec = naopolicies.spec(name)
        last = (spec.get("stages") or [{}])[-1]
        tasks = ({**section, "name": section.get("name", "")} for section in (last.get("task", {}), spec["task"]))
        trained = next((each["name"] for each in tasks if each["name"]), "")
        if (spec["robot"]["name"], trained) == (robot, task):
            found[name] = {**spec["task"], **last.get("task", {})}
    return found


def chosen(name: str | None, setting: str, robot: str, task: str) -> str:
    """Return a bundled policy that moves this robot and does this task.

    Args:
        name: the policy that is wanted; None: the first that fits.
        setting: what names it in a specification.
        robot: name of the robot.
        task: name of the task.

    Raises:
        ValueError: naming the setting and the policies that can be used.
    """
    fitting = bundled(robot, task)
    name = name or next(iter(fitting), None)
    if name not in fitting:
        raise ValueError(
            f"{setting}: {name!r} is no bundled policy of robot {robot} for task {task}; "
            f"use {' or '.join(fitting) or 'another robot'}"
        )
    return name
