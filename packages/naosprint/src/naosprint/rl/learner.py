"""The interface between learning algorithms and the runner.

To add an algorithm, subclass :class:`Learner`, describe it with a :class:`LearnerKind`, and register the kind under the
entry-point group ``naosprint.learners``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar, cast

from naospec import plugins
from naospec.plugins import LEARNERS, Plugin

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from naosim.robots import Robot
    from naospec import LearnerSettings, TrainingSpec
    from naospec.metrics import Chart, Metric

    from naosprint.arrays import AnyArray
    from naosprint.rl.policy import Policy
    from naosprint.rl.rollout import TrainingEnvironment


class TrainingDivergedError(RuntimeError):
    """Loss, weight or observation that is no longer finite."""


class Learner(ABC):
    """A policy and the algorithm that trains it.

    The environments yield raw observations and rewards; what the learner normalizes is part of its own state.

    Attributes:
        steps: environment steps collected so far.
        updates: updates so far.
        own_state: names of the arrays of :meth:`state` that differ among the processes of one training.
    """

    steps: int
    updates: int
    own_state: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def begin(self) -> None:
        """Begin the first episodes."""

    @abstractmethod
    def collect(self, stop: Callable[[], bool] = lambda: False) -> bool:
        """Collect one rollout.

        Args:
            stop: called before every step; once it returns true, the rollout is discarded.

        Returns:
            Whether the rollout is complete.

        Raises:
            TrainingDivergedError: if an observation is not finite.
        """

    @abstractmethod
    def update(self) -> dict[str, float]:
        """Improve the policy with the rollout, and return the metrics that the kind declares.

        Raises:
            TrainingDivergedError: if the loss or a weight is no longer finite.
        """

    @abstractmethod
    def policy_state(self) -> dict[str, AnyArray]:
        """Return the arrays that acting and another training need; :meth:`LearnerKind.load_policy` reads them."""

    @abstractmethod
    def load_policy_state(self, state: Mapping[str, AnyArray]) -> None:
        """Continue with the policy of another training; everything else is new."""

    def adapt_policy(
        self,
        state: Mapping[str, AnyArray],
        *,
        observations: tuple[Sequence[str], Sequence[str]],
        actions: tuple[Sequence[str], Sequence[str]],
        critic: tuple[Sequence[str], Sequence[str]],
    ) -> Mapping[str, AnyArray]:
        """Return the policy of another training rearranged for this one's observations, actions and settings.

        Args:
            state: what :meth:`policy_state` returned there.
            observations: names of the observations, of the other training and of this one.
            actions: the same for the actions.
            critic: the same for what only a critic observes; none of the other training if they are not known.

        Raises:
            ValueError: if the algorithm cannot do this; by default it can if observations and actions are the same.
        """
        del critic
        if (tuple(observations[0]), tuple(actions[0])) == (tuple(observations[1]), tuple(actions[1])):
            return state
        differing = sorted({*observations[0], *actions[0]} ^ {*observations[1], *actions[1]})
        names = ", ".join(differing[:8]) or "the same in another order"
        raise ValueError(
            f"its policy has other observations or actions ({names}), to which this algorithm cannot adapt it; "
            "use the same robot and task"
        )

    def upgraded_state(self, state: Mapping[str, AnyArray]) -> Mapping[str, AnyArray]:
        """Return what :meth:`state` of an earlier version returned as this version's."""
        return state

    def jumps(self, before: TrainingSpec, steps: int) -> list[str]:
        """Return in words what changes at once because this training has another total of steps than ``before``.

        Args:
            before: specification of the training that is extended, or shortened.
            steps: its steps so far.
        """
        del before, steps
        return []

    @abstractmethod
    def state(self) -> dict[str, AnyArray]:
        """Return everything else that the next update depends on, except the environments."""

    @abstractmethod
    def load_state(self, state: Mapping[str, AnyArray], *, new_episodes: bool) -> None:
        """Restore what :meth:`state` returned.

        Args:
            state: the arrays.
            new_episodes: whether all environments are at the start of an episode, instead of where they were then.
        """


class LearnerKind(ABC, Plugin):
    """One entry of the group ``naosprint.learners``: what a specification's section ``algorithm`` can name.

    Attributes:
        name: how specifications refer to it.
        summary: one line for users.
        Parameters: its settings.
        metrics: metrics of every update.
        charts: charts of these metrics.
        several_processes: whether its learners average over ``environment.processes``.
    """

    plugin_group: ClassVar[str] = LEARNERS
    name: ClassVar[str]
    summary: ClassVar[str]
    Parameters: ClassVar[type[LearnerSettings]]
    metrics: ClassVar[tuple[Metric, ...]] = ()
    charts: ClassVar[tuple[Chart, ...]] = ()
    several_processes: ClassVar[bool] = False

    @abstractmethod
    def open(self, spec: TrainingSpec, environment: TrainingEnvironment) -> Learner:
        """Return a new learner for these environments."""

    @abstractmethod
    def load_policy(
        self,
        state: Mapping[str, AnyArray],
        settings: LearnerSettings,
        *,
        observations: Sequence[str],
        actions: Sequence[str],
    ) -> Policy:
        """Return a trained policy.

        Args:
            state: what :meth:`Learner.policy_state` returned; read from a file, so not to be trusted.
            settings: the algorithm's settings.
            observations: names of the observations.
            actions: names of the actions.

        Raises:
            ValueError: naming the first array that does not fit. A missing one may raise KeyError.
        """

    def require(self, settings: LearnerSettings, robot: Robot, task: str) -> None:
        """Check what the settings name against robot and task, before a job is accepted; by default nothing.

        Args:
            settings: the algorithm's settings.
            robot: the robot, with its settings.
            task: name of the task.

        Raises:
            ValueError: naming the setting, and what can be used.
        """
        del settings, robot, task

    def describe(self) -> dict[str, object]:
        """Return a description of the algorithm for user interfaces, as a JSON object."""
        from dataclasses import asdict

        return {
            "name": self.name,
            "summary": self.summary,
            "metrics": [asdict(metric) for metric in self.metrics],
            "charts": [asdict(chart) for chart in self.charts],
        }


def learner_kind(name: str) -> LearnerKind:
    """Return the algorithm of this name.

    Raises:
        naospec.plugins.UnknownPluginError: if no package offers it; the message lists the available ones.
        naospec.plugins.BrokenPluginError: if it cannot be loaded, or is not a LearnerKind of that name.
    """
    return cast("LearnerKind", plugins.load(plugins.LEARNERS, name))
