"""Tasks: what robots learn.

A task is a class: its settings, its observations, rewards, starts, ends and metrics. To add one, subclass :class:`Task`
and register the class under the entry-point group ``naosprint.tasks``; docs/how-to/own-task.md shows how.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, cast

import numpy as np
from naosim.simulator import PLAIN, STEP_S, Ability, Scene, Starts
from naospec import TaskSettings, plugins
from naospec.metrics import EPISODE_METRICS, Metric, Presentation, Result, ResultTable
from naospec.plugins import TASKS, Plugin
from typing_extensions import TypeVar

from naosprint.tasks.observations import ObservationBlock, blocks
from naosprint.tasks.starts import draw_start_poses
from naosprint.tasks.world import World
from naosprint.terms import Number, source

if TYPE_CHECKING:
    from naosim.robots import Robot
    from numpy.typing import NDArray

    from naosprint.arrays import AnyArray, BoolArray, FloatArray, IntArray
    from naosprint.tasks.episodes import Episodes, Statistics
    from naosprint.tasks.measurements import Measurement
    from naosprint.tasks.observations import Observer


Settings = TypeVar("Settings", bound=TaskSettings, default=TaskSettings, covariant=True)
"""Settings of a task, which type checkers then know: ``class Kick(Task[KickSettings])``."""


@dataclass(frozen=True)
class RewardTerm:
    """One summand of the reward.

    The reward of a step is ``reward_scale`` times the sum of weight times value over all terms.

    Attributes:
        name: name for users.
        weight: factor, negative for a penalty; a term of weight 0 is not computed.
        value: an expression, which runs compiled; or a function that is called with the rows of some robots and returns
            one number for each.
    """

    name: str
    weight: float
    value: Number | Callable[[slice], FloatArray]

    def compute(self, rows: slice) -> FloatArray:
        """Return the (k,) values of the robots ``rows``."""
        return self.value(rows)[:, 0] if isinstance(self.value, Number) else self.value(rows)


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


class Task(Plugin, Generic[Settings]):
    """A task for n robots.

    Subclasses declare the class attributes and override the methods that differ. What a task stores for each robot
    between steps is an array with one row per robot in :attr:`arrays`: such arrays are part of checkpoints, and keep
    their values for a robot that is lost.

    What a step computes is either written in :meth:`begin`, :meth:`advance` and :meth:`ended`, or made of
    :attr:`measurements` and :attr:`flags`, which these methods use by default. A task of the second kind runs compiled
    where its measurements, observation blocks and reward terms are expressions.

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
        ends_are_final: whether the task is over at its ends and its horizon, so that nothing could follow them and no
            value is estimated there.
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
    ends_are_final: bool = False
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
            others = ((name, cast("Robot", other)) for name, other in plugins.usable(plugins.ROBOTS))
            possible = [name for name, other in others if cls.supports(other)]
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

    def add_array(self, name: str, *columns: int, fill: float = 0.0) -> NDArray[Any]:
        """Return a new array of :attr:`arrays` with one row per robot; its numbers are of the type of ``fill``."""
        self.arrays[name] = array = np.full((self.n, *columns), fill)
        return array

    def stored(self, name: str) -> Number:
        """Return an array of :attr:`arrays` for expressions."""
        return source(self.arrays[name], f"task.{name}")

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return what a policy observes, in order; the robot's usual observations by default."""
        return blocks(self.world, self.world.defaults.observations)

    def critic_blocks(self) -> Sequence[ObservationBlock]:
        """Return what a critic observes besides, in training only; the torso's true height and velocity by default.

        What disturbs a robot (friction, gravity, delay) follows by itself.
        """
        return blocks(self.world, ("true_height", "true_velocity"))

    def reward_terms(self) -> Sequence[RewardTerm]:
        """Return the terms of the reward."""
        return ()

    def starts(self, count: int, seed: int, noise_deg: float) -> Starts:
        """Return at most ``count`` starts; by default the nominal pose with joints offset by up to ``noise_deg``."""
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

        It is called before a step in which some of them are :attr:`frozen`.
        """
        del rows, observer

    def skill_over(self, rows: slice | IntArray) -> BoolArray:
        """Return which of the robots ``rows`` have done what the skill is for, so that another has to take over.

        By default none: such a skill lasts until a player chooses another.
        """
        return np.zeros(len(self.world.steps[rows]), dtype=np.bool_)

    def demonstration(self, rows: slice) -> FloatArray | None:
        """Return (k, A) actions to imitate for the next step of the robots ``rows``; None if the task shows none."""
        del rows
        return None

    @property
    def growth(self) -> float | None:
        """How far what the task asks of the robots has grown, from 0 to 1; None if it does not grow."""
        return None

    def succeeded(self, rows: IntArray) -> BoolArray:
        """Return in which of (k,) robots the episode that has just ended did what the task asks for.

        Disturbances grow with it (``disturbance_growth``). By default every episode that did not fail did.
        """
        return np.ones(len(rows), dtype=np.bool_)

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
    def describe(cls) -> dict[str, object]:
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
