"""Tasks: what robots learn.

A task is a class: its settings, its observations, rewards, starts, ends and metrics. To add one, subclass :class:`Task`
and register the class under the entry-point group ``naosprint.tasks``; docs/how-to/own-task.md shows how.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Generic, cast

import numpy as np
from naosim import robots
from naosim.robots.actuation import Actuation
from naosim.simulator import PLAIN, STEP_S, Ability, Scene, Starts
from naospec import TaskSettings, plugins
from naospec.metrics import EPISODE_METRICS, Metric, Presentation, Result, ResultTable
from naospec.plugins import TASKS, Plugin
from typing_extensions import TypeVar

from naosprint.tasks.robot_defaults import RobotDefaults, robot_defaults

if TYPE_CHECKING:
    from naosim.robots import Robot
    from naosim.simulator import BodyState, RobotMotion, Simulator

    from naosprint.arrays import AnyArray, BoolArray, FloatArray, IntArray
    from naosprint.tasks.compiled import Operation
    from naosprint.tasks.episodes import Episodes, Statistics
    from naosprint.tasks.measurements import Measurement
    from naosprint.tasks.observations import ObservationBlock, Observer


Settings = TypeVar("Settings", bound=TaskSettings, default=TaskSettings, covariant=True)
"""Settings of a task, which type checkers then know: ``class Kick(Task[KickSettings])``."""


@dataclass(frozen=True)
class RewardTerm:
    """One summand of the reward.

    The reward of a step is ``reward_scale`` times the sum of weight times value over all terms.

    Attributes:
        name: name for users.
        weight: factor, negative for a penalty; a term of weight 0 is not computed.
        value: called with the rows of some robots, returns one number for each.
        operation: its compiled form, if it has one.
    """

    name: str
    weight: float
    value: Callable[[slice], FloatArray]
    operation: Operation | None = None


@dataclass(frozen=True)
class End:
    """One reason for which an episode ends.

    Attributes:
        name: key of the rate in evaluations.
        title: name for users.
        failure: whether nothing can follow it, so that the value after it is 0; otherwise the value of what would have
            followed can be estimated.
    """

    name: str
    title: str
    failure: bool = False


class World:
    """State of the robots for tasks and observation blocks; all arrays have one row per robot.

    Attributes:
        n: number of robots.
        robot: their description.
        actuation: how actions become joint targets.
        steps: (n,) steps of each robot's episode so far.
        streams: (n,) whose random numbers each robot gets: its own in a training, those of its episode in an
            evaluation, whose results then do not depend on the number of robots.
        actions: (n, A) actions of the latest step, in [-1, 1]; zero at the start of an episode.
        previous_actions: (n, A) those of the step before.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.n = simulator.n
        self.robot: Robot = simulator.robot
        self.actuation = Actuation(simulator.robot)
        self.steps: IntArray = np.zeros(self.n, dtype=np.int64)
        self.streams: IntArray = np.arange(self.n)
        self.actions: FloatArray = np.zeros((self.n, self.actuation.n_actions))
        self.previous_actions: FloatArray = np.zeros((self.n, self.actuation.n_actions))

    @cached_property
    def defaults(self) -> RobotDefaults:
        """The robot's observations and fall heights unless the task differs.

        Raises:
            ValueError: if no package states them.
        """
        return robot_defaults(self.robot)

    @property
    def perceptors(self) -> Mapping[str, FloatArray]:
        """Perceptors by name."""
        return self.simulator.perceptors

    def position(self, rows: slice | IntArray) -> FloatArray:
        """Return the (k, 3) true torso positions in metres."""
        return self.simulator.truth.torso_position[rows]

    def rotation(self, rows: slice | IntArray) -> FloatArray:
        """Return the (k, 3, 3) true rotations from the torso's frame into the world's."""
        return self.simulator.truth.torso_rotation[rows]

    @property
    def bodies(self) -> Mapping[str, BodyState]:
        """True motion of the bodies that the task's scene names: torso, feet and ball."""
        return self.simulator.truth.bodies

    @property
    def contacts(self) -> Mapping[str, FloatArray]:
        """By part of the robot, (n,) share of the latest step in which the ball touched it."""
        return self.simulator.truth.contacts

    def place_ball(
        self,
        rows: IntArray,
        position_m: FloatArray,
        velocity_mps: FloatArray | None = None,
        spin_rad_s: FloatArray | None = None,
    ) -> None:
        """Place the ball of the (k,) robots ``rows`` at (k, 3), at rest or with (k, 3) velocities and spins.

        Raises:
            ValueError: if the task's scene has no ball.
        """
        self.simulator.place_ball(rows, position_m, velocity_mps, spin_rad_s)

    def motion(self, rows: IntArray) -> RobotMotion:
        """Return poses and velocities of the (k,) robots ``rows``.

        Raises:
            ValueError: if the simulator's robots can begin at rest only.
        """
        return self.simulator.motion(rows)

    def set_motion(self, rows: IntArray, motion: RobotMotion) -> None:
        """Give the (k,) robots ``rows`` these poses and velocities, instead of rest, to begin with.

        Raises:
            ValueError: if the simulator's robots can begin at rest only.
        """
        self.simulator.set_motion(rows, motion)

    def torque_share(self, rows: slice | IntArray) -> FloatArray:
        """Return the (k,) mean over the joints of the squared share of its torque limit that each motor applies.

        Raises:
            ValueError: if the simulator does not report motor torques.
        """
        torques = self.simulator.torque_shares(rows)
        return np.asarray(np.square(torques).mean(axis=1))

    def yaw(self, rows: slice | IntArray) -> FloatArray:
        """Return the (k,) angles in radians from the world's +x to the torso's front, counter-clockwise."""
        front = self.robot.front_axis
        rotation = self.rotation(rows)
        return np.asarray(np.arctan2(rotation[:, 1, front], rotation[:, 0, front]))


class Task(Plugin, Generic[Settings]):
    """A task for n robots.

    Subclasses declare the class attributes and override the methods that differ. What a task stores for each robot
    between steps is an array with one row per robot in :attr:`arrays`: such arrays are part of checkpoints, and keep
    their values for a robot that is lost.

    What a step computes is either written in :meth:`begin`, :meth:`advance` and :meth:`ended`, or made of
    :attr:`measurements` and :attr:`flags`, which these methods use by default. A task of the second kind runs compiled
    where its observation blocks and reward terms have a compiled form, too.

    Attributes:
        name: how specifications refer to it; equal to the entry point's name.
        version: raise it when the task changes so that results no longer compare; a worker runs only the versions that
            it has.
        summary: one line for users.
        Parameters: its settings.
        scene: contents of its world besides the robot, for example a ball; a specification with a simulator that lacks
            them is refused.
        needs: abilities that the simulator has to have, whatever the settings; see :mod:`naospec.abilities`.
        metrics: what is measured of an episode, besides its reward and length.
        results: what only evaluations report, so that a study can optimize it.
        ends: reasons for which an episode ends.
        presentation: where metrics are shown.
        max_steps: length limit of an episode in steps.
        horizon_is_terminal: whether reaching ``max_steps`` belongs to the task; otherwise it is a time limit.
        trace: names of what :meth:`trace_row` returns in evaluations.
        frozen: (n,) robots in which :meth:`take_over` replaces the next action, so that there is nothing to learn from
            it; None if there are none.
        measurements: what it takes of every step, in order.
        flags: for each of ``ends``, (n,) robots that the latest step brought there.
    """

    plugin_group: ClassVar[str] = TASKS
    name: ClassVar[str]
    version: ClassVar[int] = 1
    summary: ClassVar[str]
    Parameters: ClassVar[type[TaskSettings]] = TaskSettings
    scene: ClassVar[Scene] = PLAIN
    needs: ClassVar[frozenset[Ability]] = frozenset()
    metrics: ClassVar[tuple[Metric, ...]] = ()
    results: ClassVar[tuple[Metric, ...]] = ()
    ends: ClassVar[tuple[End, ...]] = ()
    presentation: ClassVar[Presentation] = Presentation()
    max_steps: int = 1000
    horizon_is_terminal: bool = False
    trace: ClassVar[tuple[str, ...]] = ()
    frozen: BoolArray | None = None

    # for specifications

    @classmethod
    def supports(cls, robot: Robot) -> bool:
        """Return whether this robot can do the task."""
        del robot
        return True

    @classmethod
    def demonstrates(cls, robot: Robot) -> bool:
        """Return whether :meth:`demonstration` shows actions to this robot; by default if a task overrides it."""
        del robot
        return cls.demonstration is not Task.demonstration

    @classmethod
    def resolve(cls, parameters: Settings, robot: Robot) -> Settings:  # type: ignore[misc] # a task gets its own
        """Return the settings with those that depend on the robot filled in.

        Raises:
            ValueError: if the robot cannot do it; the message names the setting.
        """
        if not cls.supports(robot):
            possible = [name for name in robots.names() if cls.supports(robots.get(name))]
            raise ValueError(
                f"task: {cls.name} is not possible with robot {robot.name}; use another task, or one of the robots "
                f"{', '.join(possible)}"
            )
        return parameters

    # for environments

    def __init__(self, parameters: Settings, world: World, seed: int = 0) -> None:
        self.parameters = parameters
        self.seed = seed
        self.world = world
        self.robot = world.robot
        self.n = world.n
        self.arrays: dict[str, AnyArray] = {}
        self.measurements: Sequence[Measurement] = ()
        self.flags: Sequence[BoolArray] = ()

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return what a policy observes, in order; the robot's usual observations by default."""
        from naosprint.tasks.observations import blocks

        return blocks(self.world, self.world.defaults.observations)

    def critic_blocks(self) -> Sequence[ObservationBlock]:
        """Return what a critic observes besides, in training only; the torso's true height and velocity by default.

        What disturbs a robot (friction, gravity, delay) follows by itself.
        """
        from naosprint.tasks.observations import blocks

        return blocks(self.world, ("true_height", "true_velocity"))

    def reward_terms(self) -> Sequence[RewardTerm]:
        """Return the terms of the reward."""
        return ()

    def starts(self, count: int, seed: int, noise_deg: float) -> Starts:
        """Return at most ``count`` starts; by default the nominal pose with joints offset by up to ``noise_deg``."""
        from naosprint.tasks.starts import draw_start_poses

        return Starts(draw_start_poses(self.world.actuation, count, noise_deg, seed), self.start_position())

    def start_position(self) -> tuple[float, float]:
        """Return x and y of the torso at the start, metres."""
        return (0.0, 0.0)

    def place(self, rows: IntArray) -> None:
        """Place what an episode of the robots ``rows`` begins with besides their start, for example the ball.

        It is called right after the start, before :meth:`begin`.
        """
        del rows

    def begin(self, rows: IntArray) -> None:
        """Reset what is stored for the robots ``rows``, whose episode begins now."""
        for measurement in self.measurements:
            measurement.begin(rows)

    def advance(self, rows: slice) -> None:
        """Update what is stored for the robots ``rows`` after a step, before anything else is computed."""
        for measurement in self.measurements:
            measurement.update(rows)

    def ended(self, rows: slice) -> Sequence[BoolArray]:
        """Return for each of :attr:`ends` which of the robots ``rows`` reached it."""
        return [flag[rows] for flag in self.flags]

    def take_over(self, rows: slice, observer: Observer) -> None:
        """Replace ``world.actions`` of those robots ``rows`` in which another policy acts now, by the observations.

        It is called before a step of tasks that set :attr:`frozen`.
        """
        del rows, observer

    def skill_over(self, rows: slice | IntArray) -> BoolArray:
        """Return which of the robots ``rows`` have done what the skill is for, so that another has to take over.

        A skill that goes on until another takes over does not override it.
        """
        return np.zeros(len(self.world.steps[rows]), dtype=np.bool_)

    def demonstration(self, rows: slice) -> FloatArray | None:
        """Return (k, A) actions to imitate for the next step of the robots ``rows``; None if the task shows none."""
        del rows
        return None

    def measure(self, rows: IntArray) -> FloatArray:
        """Return the (k, M) live :attr:`metrics` of the episodes of the robots ``rows``, which have just ended."""
        return np.zeros((len(rows), 0))

    # evaluation

    def trace_row(self, rows: IntArray) -> FloatArray:
        """Return (k, C) numbers of the present step to keep for :meth:`summarize`, as :attr:`trace` names them."""
        return np.zeros((len(rows), 0))

    def summarize(self, episodes: Episodes, statistics: Statistics) -> tuple[Sequence[Result], Sequence[ResultTable]]:
        """Return the results of an evaluation, the most important first, and tables of results.

        Args:
            episodes: every step of every episode.
            statistics: turns samples into results with confidence intervals.
        """
        del episodes, statistics
        return (), ()

    @classmethod
    def describe(cls) -> dict[str, Any]:
        """Return a description of the task for user interfaces, as a JSON object."""
        from dataclasses import asdict, replace

        return {
            "name": cls.name,
            "version": cls.version,
            "summary": cls.summary,
            "metrics": [asdict(metric) for metric in (*EPISODE_METRICS, *cls.metrics)],
            "results": [asdict(replace(metric, live=False)) for metric in cls.results],
            "ends": [asdict(end) for end in cls.ends],
            **asdict(cls.presentation),
        }


def names() -> tuple[str, ...]:
    """Return the names of all tasks that installed packages offer, sorted."""
    return plugins.names(plugins.TASKS)


def get(name: str) -> type[Task]:
    """Return the task of this name.

    Raises:
        naospec.plugins.UnknownPluginError: if no package offers it; the message lists the available ones.
        naospec.plugins.BrokenPluginError: if it cannot be loaded, or is not a subclass of :class:`Task` of that name.
    """
    return cast("type[Task]", plugins.load(plugins.TASKS, name))


def seconds(steps: FloatArray | IntArray) -> FloatArray:
    """Return the duration of a number of steps in seconds."""
    return np.asarray(steps, dtype=np.float64) * STEP_S
