"""Transitions between skills: each is entered from states in which every other ends or is interrupted.

A player changes from skill to skill in the middle of a step. The matrix has a row for what the robot did before and a
column for what it does next; a cell is the share of transitions after which it is upright and does what is commanded.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from naosim import kinds, robots
from naosim.robots.actuation import Actuation
from naosim.simulator import STEP_S, RuntimeOptions, Starts

from naosprint.tasks import get
from naosprint.tasks.ball import BallTask
from naosprint.tasks.block import SAVE, Block
from naosprint.tasks.dribble import Dribble
from naosprint.tasks.environment import Environment
from naosprint.tasks.falls import FALL
from naosprint.tasks.frozen import FrozenPolicy, bundled
from naosprint.tasks.getup import HOLD_STEPS, LIMIT_S, GetUp
from naosprint.tasks.handover import HandOver, record, record_lying
from naosprint.tasks.kick import Kick
from naosprint.tasks.statistics import wilson
from naosprint.tasks.velocity import Velocity

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from naosim.simulator import Simulator
    from naospec import TaskSettings, TrainingSpec

    from naosprint.arrays import AnyArray, BoolArray, FloatArray, IntArray

ON_COMMAND_MPS = 0.35
"""Largest error of the mean velocity with which a robot follows its command, m/s."""

SETTLED_S = 2.0
"""Time after a transition from which a robot has to do what is commanded, seconds."""

LYING = "lying"
"""Row of robots that were pushed over."""

_PUSH_MPS, _PUSH_STEPS = 4.0, 25
_MEASURED = 50  # steps over which the velocity is averaged, one second
_SETTLED = round(SETTLED_S / STEP_S)
_LIMITS = {Kick: 250, Block: 600, GetUp: round(LIMIT_S / STEP_S) + HOLD_STEPS}  # steps, where it takes longer
_PARALLEL = 64
_ENTRY_NUMBER = 5_000  # of the first episode of a transition: none of a recording has such a number


@dataclass(frozen=True)
class Skill:
    """A skill as a player uses it: a policy with a command.

    Attributes:
        name: name for users.
        policy: name of a bundled policy.
        settings: settings of its task in which the command differs from the policy's own.
    """

    name: str
    policy: str
    settings: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def acting(self) -> FrozenPolicy:
        """The policy."""
        return FrozenPolicy(self.policy)

    @property
    def spec(self) -> TrainingSpec:
        """The specification of its last stage."""
        return self.acting.spec

    @property
    def task_settings(self) -> TaskSettings:
        """Settings of its task, without disturbances."""
        return self.spec.task.for_evaluation().model_copy(update=dict(self.settings))


def _velocity(forward: float, sideways: float = 0.0, turn: float = 0.0) -> dict[str, Any]:
    """Return settings of task velocity with one command."""
    return {
        "forward_min_mps": forward, "forward_max_mps": forward, "sideways_max_mps": sideways, "turn_max_rad_s": turn,
        "stand_fraction": 0.0, "straight_fraction": 0.0, "command_steps": 100_000, "episode_steps": 100_000,
    }  # fmt: skip


def skills(robot: str, chosen: Mapping[str, str] = {}) -> tuple[Skill, ...]:  # never changed
    """Return the skills of a robot for which there are bundled policies.

    Args:
        robot: name of the robot.
        chosen: by task the policy to take instead of the first one.

    Raises:
        ValueError: if the robot has no policy that follows velocities, or a chosen one is not a policy for its task.
    """
    for task, policy in chosen.items():
        if policy not in bundled(robot, task):
            fitting = ", ".join(bundled(robot, task)) or "none"
            raise ValueError(f"{policy}: no bundled policy of robot {robot} for task {task}; there are: {fitting}")
    policies = {
        task: chosen.get(task) or next(iter(bundled(robot, task)), "")
        for task in (Velocity.name, Kick.name, Dribble.name, Block.name, GetUp.name)
    }
    if not policies[Velocity.name]:
        raise ValueError(f"--robot: {robot} has no bundled policy for task {Velocity.name}, which connects skills")
    walker = policies[Velocity.name]
    commands = {"stand": _velocity(0.0), "walk": _velocity(0.8), "run": _velocity(1.8)}
    commands |= {"sideways": _velocity(0.0, sideways=0.4), "turn": _velocity(0.3, turn=0.8)}
    return (
        *(Skill(name, walker, settings) for name, settings in commands.items()),
        *(Skill(task, policies[task]) for task in policies if task != Velocity.name and policies[task]),
    )


@dataclass(frozen=True)
class Cell:
    """What became of the transitions from one skill to another.

    Attributes:
        before: name of the skill that moved the robot.
        after: name of the skill that was entered.
        succeeded: transitions after which the robot was upright and did what is commanded.
        upright: transitions after which it was upright.
        count: transitions.
    """

    before: str
    after: str
    succeeded: int
    upright: int
    count: int

    @property
    def share(self) -> float:
        """Share that succeeded."""
        return self.succeeded / self.count

    def to_dict(self) -> dict[str, Any]:
        """Return it as a JSON object, with Wilson's interval of the share."""
        low, high = wilson(self.succeeded, self.count, 0.95)
        return {**asdict(self), "share": self.share, "interval": [low, high]}


def matrix(
    members: Sequence[Skill],
    *,
    count: int = 200,
    seed: int = 1,
    engine: str = "mujoco",
    threads: int = 2,
    tell: Callable[[str], None] = lambda text: None,
) -> Iterator[Cell]:
    """Yield a cell for every two skills, and one for getting up, which is entered by robots that lie.

    Args:
        members: the skills.
        count: transitions of a cell.
        seed: seed of states, commands and balls.
        engine: engine of the embedded simulator.
        threads: threads of the simulator.
        tell: called with what is being done.
    """
    for before in members:
        tell(f"states of {before.name}")
        with _opened(before, count, engine, threads) as simulator:
            task = get(before.spec.task.name)
            states = record(simulator, before.acting, task, before.task_settings, count, seed)
        for after in members:
            if after.spec.task.name == GetUp.name:
                continue
            tell(f"{before.name} to {after.name}")
            with _opened(after, count, engine, threads) as simulator:
                yield _transitions(simulator, before, after, states, seed)
    up = next((member for member in members if member.spec.task.name == GetUp.name), None)
    walker = next((member for member in members if member.spec.task.name == Velocity.name), None)
    if up is not None and walker is not None:
        tell(f"{LYING} to {up.name}")
        with _opened(walker, count, engine, threads) as simulator:
            pushed = walker.task_settings.model_copy(update={"push_mps": _PUSH_MPS, "push_steps": _PUSH_STEPS})
            states = record_lying(simulator, walker.acting, Velocity, pushed, count, seed)
        with _opened(up, count, engine, threads) as simulator:
            yield _transitions(simulator, replace(walker, name=LYING), up, states, seed)


class _opened:  # used like a function
    """A simulator for ``count`` transitions of a skill, which is closed afterwards."""

    def __init__(self, skill: Skill, count: int, engine: str, threads: int) -> None:
        settings = skill.spec.simulator.model_copy(update={"engine": engine})
        kind = kinds.get(settings.name)
        robot, scene = robots.configured(skill.spec.robot), get(skill.spec.task.name).scene
        self._simulator = kind.open(robot, min(_PARALLEL, count), settings, RuntimeOptions(threads=threads), scene)

    def __enter__(self) -> Simulator:
        return self._simulator

    def __exit__(self, *exception: object) -> None:
        self._simulator.close()


def _transitions(simulator: Simulator, before: Skill, after: Skill, states: HandOver, seed: int) -> Cell:
    """Enter a skill from every state, and count the robots that are upright and do what is commanded."""
    states = _acted(states, Actuation(robots.configured(before.spec.robot)), Actuation(simulator.robot))
    environment = _Entered(simulator, after, states, seed)
    succeeded, upright = np.zeros(0, dtype=np.bool_), np.zeros(0, dtype=np.bool_)
    for first in range(0, len(states), simulator.n):
        rows = np.arange(min(simulator.n, len(states) - first))
        stands, obeys = _followed(environment, after, rows, first)
        upright, succeeded = np.append(upright, stands), np.append(succeeded, stands & obeys)
    return Cell(before.name, after.name, int(succeeded.sum()), int(upright.sum()), len(states))


def _acted(states: HandOver, before: Actuation, after: Actuation) -> HandOver:
    """Return the states with actions as another policy's robot would have had to command the same angles."""
    if before.action_range_rad is None or after.action_range_rad is None:
        return states
    angles = before.nominal + states.actions * before.action_range_rad
    return HandOver(
        states.motion, np.clip((angles - after.nominal) / after.action_range_rad, -1.0, 1.0), states.velocity
    )


class _Entered(Environment):
    """Robots of a skill whose episodes begin with states of another, one after the other."""

    def __init__(self, simulator: Simulator, skill: Skill, states: HandOver, seed: int) -> None:
        task = get(skill.spec.task.name)
        super().__init__(simulator, task, task.resolve(skill.task_settings, simulator.robot), seed)
        self._entry = states
        if isinstance(self.task, BallTask):
            self.load_starts(self.task.enter(states))
        else:
            self.load_starts(Starts(np.repeat(simulator.robot.nominal[None], 2, axis=0)))

    def enter(self, rows: IntArray, first: int) -> None:
        """Begin episodes with the states from ``first``."""
        numbers = _ENTRY_NUMBER + first + np.arange(len(rows))
        if isinstance(self.task, BallTask):
            self.task.entries[rows] = first + np.arange(len(rows))
            self.restart(rows, numbers % 2, episodes=numbers)
            return
        self.restart(rows, numbers % 2, episodes=numbers)
        states = first + np.arange(len(rows))
        self._entry.begin(self.world, rows, states, np.zeros((len(rows), 3)))
        self.task.begin(rows)
        actions: FloatArray = self._entry.actions[states]
        self.world.actions[rows] = self.world.previous_actions[rows] = actions
        self.observer.begin(rows, {"velocity": self._entry.velocity[states]})


def _followed(environment: _Entered, skill: Skill, rows: IntArray, first: int) -> tuple[BoolArray, BoolArray]:
    """Return which of the robots ``rows`` are upright after a transition, and which do what is commanded."""
    task, n = environment.task, environment.n
    environment.enter(rows, first)
    active = np.zeros(n, dtype=np.bool_)
    active[rows] = True
    upright, done = active.copy(), np.zeros(n, dtype=np.bool_)
    moved: FloatArray = np.zeros((n, 2))
    for step in range(_LIMITS.get(type(task), _SETTLED + _MEASURED)):
        environment.step(skill.acting.act(environment.observer, slice(0, n)), None if active.all() else active)
        if FALL.name in environment.ends:
            upright &= ~(active & environment.ends[FALL.name])
        if isinstance(task, Velocity) and step >= _SETTLED:
            moved += (task.velocity[:, :2] - task.command[:, :2]) / _MEASURED
        if isinstance(task, Kick):
            done |= active & task.touched
        elif isinstance(task, Block):
            done |= active & environment.ends[SAVE.name]
        elif isinstance(task, GetUp):
            done |= active & task.skill_over(slice(0, n))
        active &= ~(environment.terminated | environment.lost)
        if not active.any():
            break
    if isinstance(task, Velocity):
        done = np.hypot(*moved.T) <= ON_COMMAND_MPS
    elif isinstance(task, Dribble):
        done = active & (task.share_of_speed() >= 0.5)
    return upright[rows], done[rows]


def table(cells: Sequence[Cell]) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of the matrix, shares in percent."""
    columns = list(dict.fromkeys(cell.after for cell in cells))
    shares = {(cell.before, cell.after): f"{100.0 * cell.share:.0f}" for cell in cells}
    rows = dict.fromkeys(cell.before for cell in cells)
    lines = [[before, *(shares.get((before, after), "") for after in columns)] for before in rows]
    return ["from \\ to", *columns], lines


def to_dict(cells: Sequence[Cell], members: Sequence[Skill], engine: str, seed: int) -> dict[str, Any]:
    """Return the matrix as a JSON object."""
    policies: dict[str, AnyArray | str] = {member.name: member.policy for member in members}
    return {"engine": engine, "seed": seed, "policies": policies, "cells": [cell.to_dict() for cell in cells]}
