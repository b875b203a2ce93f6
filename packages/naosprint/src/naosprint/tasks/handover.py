"""Hand-over states: robots that another policy moves, caught in the middle of a step.

Skills that follow each other begin where the one before ends: at speed, on one foot, with a command on its way to the
motors. A task records such states when its starts are drawn, with the policy that comes before it, and begins its
episodes from them. Other seeds give other states, so evaluations see none of those that a training saw.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from naosim.simulator import Ability, RobotMotion, Starts
from naospec import TaskSettings
from naospec.sections import PlainName
from pydantic import Field

from naosprint.tasks.base import Task, get
from naosprint.tasks.environment import Environment
from naosprint.tasks.starts import draw_start_poses
from naosprint.terms import Store, given, source
from naosprint.terms.randomness import uniform

if TYPE_CHECKING:
    from collections.abc import Sequence

    from naosim.simulator import Simulator

    from naosprint.arrays import FloatArray, IntArray
    from naosprint.tasks.frozen import FrozenPolicy
    from naosprint.tasks.observations import ObservationBlock
    from naosprint.tasks.world import World

    _State = tuple[RobotMotion, FloatArray, FloatArray]
    """Motion of one robot, its latest action, and its perceived velocity."""

STATES_PER_RUN = 8
"""States that are recorded of one run."""

_FIRST, _APART = 60, 40  # steps before the first state of a run, and between two
_STREAM = 0x4A4D
_LEAST_HEIGHT, _LEAST_UPRIGHT = 0.8, 0.8
_FALL_STEPS, _LYING_STEPS = 600, 50
_LYING_HEIGHT = 0.45


class EntrySettings(TaskSettings):
    """Settings of tasks whose episodes begin with states of other policies."""

    entry_policies: tuple[PlainName, ...] = Field(
        default=(),
        max_length=7,
        title="Entry policies",
        description="Bundled policies of the robot with whose states episodes begin, too, in the middle of a step or "
        "where their skill ends: from the steps of another one a policy may fall. Before a ball as often as with the "
        "walker's.",
        json_schema_extra={"needs": Ability.MOVING},
    )
    handover_states: int = Field(
        default=1024,
        ge=8,
        le=100_000,
        title="Hand-over states",
        description="States of other policies that episodes begin with; recorded when a training or evaluation begins.",
    )


@dataclass(frozen=True)
class HandOver:
    """k states in which a policy is interrupted.

    Attributes:
        motion: poses, velocities and pending commands; the torsos face +x at the world's origin.
        actions: (k, A) latest actions.
        velocity: (k, 3) perceived velocity in the torso's frame, which takes two perceptions; 0 for robots that do not
            perceive it.
    """

    motion: RobotMotion
    actions: FloatArray
    velocity: FloatArray

    def __len__(self) -> int:
        """Return the number of states."""
        return len(self.actions)

    def begin(self, world: World, rows: IntArray, states: IntArray, places: FloatArray) -> None:
        """Put the (k,) robots ``rows`` into (k,) states, at (k, 3) x, y and heading."""
        chosen = _chosen(self.motion, states)
        world.set_motion(rows, _turned(chosen, places[:, 2], places[:, :2]))


class Entries:
    """States that the episodes of robots begin with, and what the policy before leaves behind.

    Args:
        world: the robots.

    Attributes:
        states: the states; they follow from settings and seed.
        numbers: (n,) number of the state of each robot's episode; part of checkpoints.
    """

    states: HandOver

    def __init__(self, world: World) -> None:
        self._world = world
        self.numbers: IntArray = np.zeros(world.n, dtype=np.int64)
        self._actions: FloatArray = np.zeros((world.n, world.actuation.n_actions))
        self._velocity: FloatArray = np.zeros((world.n, 3))

    def put(self, rows: IntArray, numbers: IntArray, places: FloatArray) -> None:
        """Put the (k,) robots ``rows`` into states, at (k, 3) x, y and heading."""
        self.numbers[rows] = numbers
        self.states.begin(self._world, rows, numbers, places)
        self._actions[rows], self._velocity[rows] = self.states.actions[numbers], self.states.velocity[numbers]

    def stand(self, rows: IntArray) -> None:
        """Note that the (k,) robots ``rows`` begin with a start, not with a state."""
        self._actions[rows] = self._velocity[rows] = 0.0

    def velocity(self, row: int) -> FloatArray:
        """Return the (3,) velocity that the robot ``row`` perceived in its state, in the torso's frame."""
        velocity: FloatArray = self.states.velocity[self.numbers[row]]
        return velocity

    def last_actions(self) -> list[Store]:
        """Return what restores the latest actions, so that an episode continues the motion."""
        return [Store(each, begin=source(self._actions)) for each in (self._world.action, self._world.previous_action)]

    def moving(self, velocity: ObservationBlock) -> Store:
        """Return what begins the observed velocity with that of the state."""
        begin = given("entry_velocity", source(self._velocity))
        return Store(source(velocity.arrays["velocity"], "velocity"), begin=begin)


def record_own(simulator: Simulator, policy: FrozenPolicy, count: int, seed: int, **settings: int) -> HandOver:
    """Record states of a policy in the task that it was trained for, undisturbed, see :func:`record`."""
    own = policy.spec.task.for_evaluation()
    if isinstance(own, EntrySettings):  # its own episodes begin as they do without other policies
        own = own.model_copy(update={"entry_policies": ()})
    return record(simulator, policy, get(own.name), own.model_copy(update=settings), count, seed)


def joined(several: Sequence[HandOver]) -> HandOver:
    """Return the states of several policies as one."""
    return HandOver(
        _together([each.motion for each in several]),
        np.concatenate([each.actions for each in several]),
        np.concatenate([each.velocity for each in several]),
    )


def record(
    simulator: Simulator, policy: FrozenPolicy, task: type[Task], settings: TaskSettings, count: int, seed: int
) -> HandOver:
    """Run a policy and return ``count`` of its states.

    Those of a task whose skill ends by itself are the states in which it ends, one a run; those of another task are
    several of each run, at random moments. They follow from seed and number; the number of the simulator's robots does
    not matter. Robots that have fallen are left out, so there can be fewer states.

    Args:
        simulator: robots to run; their starts are replaced.
        policy: moves them.
        task: the task that commands the policy.
        settings: settings of that task.
        count: number of states.
        seed: seed of starts, commands and moments.

    Raises:
        ValueError: if the policy falls before one of its states can be recorded.
    """
    environment = Environment(simulator, task, task.resolve(settings, simulator.robot), seed)
    by_itself = task.skill_over is not Task.skill_over
    n, runs = simulator.n, count if by_itself else -(-count // STATES_PER_RUN)
    if by_itself or task.starts is not Task.starts:
        starts = environment.task.starts(64, seed, settings.start_noise_deg)
    else:
        starts = Starts(draw_start_poses(environment.actuation, 64, settings.start_noise_deg, seed))
    environment.load_starts(_first(starts, max(n, runs)))  # robots settle in each, also in those of no run
    names = environment.observer.names
    velocity = [names.index(name) for name in (f"velocity_{axis}" for axis in "xyz") if name in names]
    found: dict[int, _State] = {}
    for first in range(0, runs, n):
        numbers = np.arange(first, min(first + n, runs))
        rows = np.arange(len(numbers))
        environment.restart(rows, numbers % len(starts), episodes=numbers)
        moments = _moments(numbers, seed)
        active = np.zeros(n, dtype=np.bool_)
        active[rows] = True
        for step in range(1, (environment.task.max_steps if by_itself else int(moments.max())) + 1):
            environment.step(policy.act(environment.observer, slice(0, n)), None if active.all() else active)
            active &= ~(environment.terminated | environment.lost)
            world = environment.world
            if by_itself:
                due = np.flatnonzero(active & environment.task.skill_over(slice(0, n)))
                active[due], which = False, np.zeros(len(due), dtype=np.int64)
            else:
                due, which = np.nonzero(moments == step)
            standing = (by_itself | active[due]) & (world.rotation(due)[:, 2, 2] > _LEAST_UPRIGHT)
            standing &= world.position(due)[:, 2] > _LEAST_HEIGHT * simulator.robot.standing_height_m
            due, which = due[standing], which[standing]
            if len(due):
                motion, seen = simulator.motion(due), np.zeros((len(due), 3))
                seen[:, : len(velocity)] = environment.observations[due][:, velocity]
                for k, (row, moment) in enumerate(zip(due.tolist(), which.tolist(), strict=True)):
                    state = _chosen(motion, np.array([k])), world.actions[row].copy(), seen[k].copy()
                    found[int(numbers[row]) * STATES_PER_RUN + moment] = state
            if not active.any():
                break
    kept = [found[number] for number in sorted(found)][:count]
    if not kept:
        raise ValueError(f"policy {policy.name} falls before a state of it can be recorded")
    return _assembled(kept)


def record_lying(
    simulator: Simulator, policy: FrozenPolicy, task: type[Task], settings: TaskSettings, count: int, seed: int
) -> HandOver:
    """Run a policy whose robots are pushed over, and return up to ``count`` states of robots that lie.

    Each is taken a second after the fall, in which the policy has gone on as if nothing had happened. The arguments
    are those of :func:`record`; the settings have to contain the pushes.

    Raises:
        ValueError: if no robot falls.
    """
    environment = Environment(simulator, task, task.resolve(settings, simulator.robot), seed)
    n = simulator.n
    environment.load_starts(Starts(draw_start_poses(environment.actuation, 64, settings.start_noise_deg, seed)))
    kept: list[_State] = []
    for first in range(0, count, n):
        numbers = np.arange(first, min(first + n, count))
        rows = np.arange(len(numbers))
        environment.restart(rows, numbers % 64, episodes=numbers)
        since = np.zeros(n, dtype=np.int64)  # steps on the ground
        for _ in range(_FALL_STEPS):
            environment.step(policy.act(environment.observer, slice(0, n)))
            low = environment.world.position(slice(0, n))[:, 2] < _LYING_HEIGHT * simulator.robot.standing_height_m
            since = np.where(low | (since > 0), since + 1, 0)
            due = rows[since[rows] == _LYING_STEPS]
            if len(due):
                motion = simulator.motion(due)
                kept += [
                    (_chosen(motion, np.array([k])), environment.world.actions[row].copy(), np.zeros(3))
                    for k, row in enumerate(due.tolist())
                ]
    if not kept:
        raise ValueError(f"policy {policy.name} does not fall")
    return _assembled(kept)


def _assembled(kept: Sequence[_State]) -> HandOver:
    """Return states as arrays, turned to +x and moved to the origin."""
    motion = _together([motion for motion, *_ in kept])
    back = -_yaw(motion.torso_wxyz)
    home = replace(motion, torso_m=motion.torso_m * (0.0, 0.0, 1.0))
    return HandOver(
        _turned(home, back, np.zeros((len(kept), 2))),
        np.array([actions for _, actions, _ in kept]),
        np.array([velocity for *_, velocity in kept]),
    )


def _moments(numbers: IntArray, seed: int) -> IntArray:
    """Return the (k, STATES_PER_RUN) steps of runs after which their states are taken."""
    moments = [
        _FIRST + _APART * k + (_APART * uniform(seed + _STREAM, numbers, np.full(len(numbers), k), 1)[:, 0])
        for k in range(STATES_PER_RUN)
    ]
    return np.stack(moments, axis=1).astype(np.int64)


def _together(motions: Sequence[RobotMotion]) -> RobotMotion:
    return RobotMotion(
        **{each.name: np.concatenate([getattr(motion, each.name) for motion in motions]) for each in fields(motions[0])}
    )


def _first(starts: Starts, count: int) -> Starts:
    """Return the first ``count`` starts."""
    places, turned = starts.places()[:count], starts.orientations
    return Starts(
        starts.poses_rad[:count], places[:, :2], places[:, 2], orientations=None if turned is None else turned[:count]
    )


def _chosen(motion: RobotMotion, states: IntArray) -> RobotMotion:
    return RobotMotion(**{each.name: getattr(motion, each.name)[states] for each in fields(motion)})


def _yaw(quaternions: FloatArray) -> FloatArray:
    w, x, y, z = quaternions.T
    return np.asarray(np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z)))


def _turned(motion: RobotMotion, angles: FloatArray, offsets: FloatArray) -> RobotMotion:
    """Return motion turned by (k,) angles about the vertical through the origin, then moved by (k, 2) metres."""
    cosine, sine = np.cos(angles), np.sin(angles)
    vectors = np.stack([motion.torso_m, motion.torso_mps, motion.torso_rad_s])
    x, y = vectors[..., 0].copy(), vectors[..., 1].copy()
    vectors[..., 0], vectors[..., 1] = cosine * x - sine * y, sine * x + cosine * y
    vectors[0, :, :2] += offsets
    half_cosine, half_sine = np.cos(angles / 2.0), np.sin(angles / 2.0)
    w, x, y, z = motion.torso_wxyz.T
    quaternion = [
        half_cosine * w - half_sine * z,
        half_cosine * x - half_sine * y,
        half_cosine * y + half_sine * x,
        half_cosine * z + half_sine * w,
    ]
    place, velocity, spin = vectors
    return replace(motion, torso_m=place, torso_wxyz=np.stack(quaternion, axis=1), torso_mps=velocity, torso_rad_s=spin)
