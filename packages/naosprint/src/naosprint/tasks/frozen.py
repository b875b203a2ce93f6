"""Policies that act inside a task without being trained: a walker that takes over after a kick, for example."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import naopolicies
import numpy as np
from naosim import robots
from naosim.robots.actuation import Actuation
from naospec import TrainingSpec, plugins, read_stored

from naosprint.tasks.base import get
from naosprint.tasks.robot_defaults import robot_defaults

if TYPE_CHECKING:
    from collections.abc import Sequence

    from naosim.robots import Robot
    from naosim.simulator import Scene

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
        policy: what acts.

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
            self.policy = kind.load_policy(
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
            self._columns[names] = self.columns(names)
        return self.policy.act(observer.observations[rows][:, self._columns[names]])

    def columns(self, names: Sequence[str], observed: Sequence[str] | None = None) -> IntArray:
        """Return where among ``names`` the policy finds what it observes, or the part ``observed`` of it.

        Raises:
            ValueError: if something is missing; the message names it.
        """
        observed = self.observations if observed is None else observed
        missing = sorted(set(observed) - set(names))
        if missing:
            named = ", ".join(missing[:_MOST_NAMED]) + (" and others" if len(missing) > _MOST_NAMED else "")
            raise ValueError(f"policy {self.name} cannot act here: it observes {named}, too")
        index = {name: column for column, name in enumerate(names)}
        return np.array([index[name] for name in observed])


@cache
def bundled(robot: str, task: str | None = None) -> dict[str, dict[str, Any]]:
    """Return the bundled policies that move this robot and were last trained for this task, or for any.

    Returns:
        By name the task's settings of each that differ from their defaults, and the task's name; no weights are read.
    """
    found = {}
    for name in naopolicies.names():
        spec = naopolicies.spec(name)
        last = (spec.get("stages") or [{}])[-1]
        tasks = ({**section, "name": section.get("name", "")} for section in (last.get("task", {}), spec["task"]))
        trained = next((each["name"] for each in tasks if each["name"]), "")
        if spec["robot"]["name"] == robot and task in {trained, None}:
            found[name] = {**spec["task"], **last.get("task", {}), "name": trained}
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


def require_teacher(name: str, robot: Robot, task: str) -> None:
    """Check that a bundled policy can show this robot its actions; no weights are read.

    Args:
        name: name of the policy.
        robot: the robot that learns, with its settings.
        task: name of the task.

    Raises:
        ValueError: naming ``algorithm.teacher``, and what can be used.
    """
    if not _acts_as(chosen(name, "algorithm.teacher", robot.name, task), robot):
        raise ValueError(
            f"algorithm.teacher: {name} has other ranges of actions than robot {robot.name} has with these settings; "
            "give the robot the same action_range_rad"
        )


def require_entries(names: Sequence[str], robot: Robot, scene: Scene) -> None:
    """Check that episodes can begin with states of bundled policies; no weights are read.

    Args:
        names: names of the policies. Their tasks may need no more than the scene, their actions have to stand for the
            same angles, and they may perceive no more than the robot that learns.
        robot: the robot that learns, with its settings.
        scene: contents of its world.

    Raises:
        ValueError: naming ``task.entry_policies``, and what can be used.
    """
    if not names:
        return
    fitting = [
        name
        for name, trained in bundled(robot.name).items()
        if get(trained["name"]).scene in scene
        and _acts_as(name, robot)
        and set(robot_defaults(_moved_by(name, robot)).observations) <= set(robot_defaults(robot).observations)
    ]
    for name in names:
        if name not in fitting:
            raise ValueError(
                f"task.entry_policies: {name!r} is no bundled policy of robot {robot.name} with these ranges of "
                f"actions and senses, for a task in this world; use {' or '.join(fitting) or 'another robot'}"
            )


def _acts_as(name: str, robot: Robot) -> bool:
    """Return whether the actions of a bundled policy stand for the same angles of a robot as of its own."""
    own, other = Actuation(robot), Actuation(_moved_by(name, robot))
    ends = np.array([-1.0, 1.0])[:, None] * np.ones(own.n_actions)
    return np.allclose(own.targets(ends)[:, own.index], other.targets(ends)[:, other.index])


def _moved_by(name: str, robot: Robot) -> Robot:
    """Return a robot with the settings of a bundled policy's training."""
    spec = naopolicies.spec(name)
    last = (spec.get("stages") or [{}])[-1]
    return robots.get(robot.name).with_parameters({**spec["robot"], **(last.get("robot") or {})})
