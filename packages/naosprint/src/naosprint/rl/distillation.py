"""Distillation: a policy learns the actions of another one that observes more than it does (Chen et al., 2020)."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from naosprint.rl.imitation import ImitatingPPO
from naosprint.rl.ppo import PPO
from naosprint.tasks.frozen import FrozenPolicy
from naosprint.tasks.observations import PAST, TOLD

if TYPE_CHECKING:
    from collections.abc import Mapping

    from naospec import TrainingSpec

    from naosprint.arrays import AnyArray, BoolArray, FloatArray
    from naosprint.rl.rollout import TrainingEnvironment
    from naosprint.tasks.observations import Observer


class Teacher:
    """A bundled policy that acts on what policy and critic observe, and remembers the steps before by itself.

    Args:
        name: name of the bundled policy.
        observer: observations of n robots.

    Attributes:
        memory: (n, D) what it observed last, with the earlier steps that it observes, too.

    Raises:
        ValueError: if neither policy nor critic observes something that it does.
    """

    def __init__(self, name: str, observer: Observer) -> None:
        self._policy = FrozenPolicy(name)
        names = self._policy.observations
        present = [each for each in names if PAST not in each]
        there = (*observer.names, *observer.critic_names)
        # what a critic is told is what the teacher knew, where a policy estimates it
        seen = [TOLD + each if TOLD + each in there else each for each in present]
        self._columns = self._policy.columns(there, seen)
        self._steps = len(names) // len(present)
        self.memory: FloatArray = np.zeros((len(observer.observations), len(names)))

    def act(self, observations: FloatArray, rows: slice, first: BoolArray) -> FloatArray:
        """Return (k, A) actions for the (k, D + C) observations of the robots ``rows``; call it at every step.

        Args:
            observations: what policy and critic observe.
            rows: the robots.
            first: (k,) whose episode begins, so that there is nothing to remember.
        """
        seen, memory = observations[:, self._columns], self.memory[rows]
        width = seen.shape[1]
        memory[:, width:] = memory[:, :-width].copy()
        memory[:, :width] = seen
        memory[first] = np.tile(seen[first], self._steps)
        return self._policy.policy.act(memory)


class DistillingPPO(ImitatingPPO):
    """PPO whose demonstrations are the actions of ``algorithm.teacher``.

    Raises:
        ValueError: if the teacher observes something that is not observed here.
    """

    own_state: ClassVar[tuple[str, ...]] = (*PPO.own_state, "teacher")

    def __init__(self, spec: TrainingSpec, environment: TrainingEnvironment) -> None:
        super().__init__(spec, environment)
        self.teacher = Teacher(self.settings.teacher or "", environment.environment.observer)

    def _require_demonstrations(self) -> None:
        """Need none of the task."""

    def _demonstrated(self, group: slice) -> FloatArray:
        inner = self.environment.environment
        return self.teacher.act(inner.observations[group], group, inner.steps[group] == 0)

    def state(self) -> dict[str, AnyArray]:
        """Return what PPO does, and what the teacher remembers."""
        return {**super().state(), "teacher": self.teacher.memory.copy()}

    def load_state(self, state: Mapping[str, AnyArray], *, new_episodes: bool) -> None:
        """Restore what :meth:`state` returned; see :meth:`Learner.load_state`."""
        super().load_state(state, new_episodes=new_episodes)
        self.teacher.memory[:] = state["teacher"]
