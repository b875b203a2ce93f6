"""The interface between learning algorithms and the runner.

To add an algorithm, subclass :class:`Learner`, describe it with a :class:`LearnerKind`, and register the kind under the
entry-point group ``naosprint.learners``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from naospec import LearnerSettings, TrainingSpec

    from naosprint.arrays import AnyArray, Float32Array
    from naosprint.rl.rollout import TrainingEnvironment
    from naosprint.tasks.metrics import Chart, Metric


class TrainingDivergedError(RuntimeError):
    """Loss, weight or observation that is no longer finite."""


class Learner(ABC):
    """A policy and the algorithm that trains it.

    Attributes:
        steps: environment steps collected so far.
        updates: updates so far.
    """

    steps: int
    updates: int

    @abstractmethod
    def begin(self) -> None:
        """Begin the first episodes."""

    @abstractmethod
    def act(self, observations: Float32Array) -> Float32Array:
        """Return the (n, A) mean actions for (n, D) normalized observations."""

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
        """Return the arrays that acting needs, by name."""

    @abstractmethod
    def load_policy_state(self, state: Mapping[str, AnyArray]) -> None:
        """Continue with the policy of another training; everything else is new."""

    @abstractmethod
    def state(self) -> dict[str, AnyArray]:
        """Return everything else that the next update depends on, except the environments."""

    @abstractmethod
    def load_state(self, state: Mapping[str, AnyArray], observations: Float32Array) -> None:
        """Restore what :meth:`state` returned; ``observations`` are those to act on next."""


class LearnerKind(ABC):
    """One entry of the group ``naosprint.learners``: what a specification's section ``algorithm`` can name.

    Attributes:
        name: how specifications refer to it.
        summary: one line for users.
        Parameters: its settings.
        metrics: metrics of every update.
        charts: charts of these metrics.
        several_processes: whether its learners average over ``environment.processes``.
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    Parameters: ClassVar[type[LearnerSettings]]
    metrics: ClassVar[tuple[Metric, ...]] = ()
    charts: ClassVar[tuple[Chart, ...]] = ()
    several_processes: ClassVar[bool] = False

    @abstractmethod
    def open(self, spec: TrainingSpec, environment: TrainingEnvironment) -> Learner:
        """Return a new learner for these environments."""

    def describe(self) -> dict[str, Any]:
        """Return a description of the algorithm for user interfaces, as a JSON object."""
        from dataclasses import asdict

        return {
            "name": self.name,
            "summary": self.summary,
            "metrics": [asdict(metric) for metric in self.metrics],
            "charts": [asdict(chart) for chart in self.charts],
        }
