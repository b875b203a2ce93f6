"""Small evaluations during a training, on its engine and on that of evaluations, which show a gap between them."""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from naosprint.tasks.environment import open_environment

if TYPE_CHECKING:
    from collections.abc import Callable

    from naospec import SimulatorSettings, TrainingSpec

    from naosprint.rl.policy import Policy

ROBOTS, STEPS = 8, 200
MOST_SHARE = 0.03
"""Largest share of a training's time that comparisons take."""

_FIRST_S = 1.0  # expected before the first one is measured


class EngineComparison:
    """Mean rewards of the same policy from the same starts on both engines, within a share of the training's time.

    Random numbers follow from the specification's seed and the episode; those of the training are not touched.

    Args:
        spec: specification of the training, or of its stage.
    """

    def __init__(self, spec: TrainingSpec) -> None:
        self._spec = spec
        self._needed = spec.simulator.for_evaluation() != spec.simulator
        self._spent_s = 0.0
        self._expected_s = _FIRST_S

    def compare(self, policy: Callable[[], Policy], training_s: float) -> dict[str, float]:
        """Return the metrics of a comparison; nothing where both engines are one, or before it is due.

        Args:
            policy: returns the policy.
            training_s: seconds of training so far, of which comparisons may take ``MOST_SHARE``.
        """
        if not self._needed or self._spent_s + self._expected_s > MOST_SHARE * training_s:
            return {}
        began, simulator, acting = perf_counter(), self._spec.simulator, policy()
        means = {
            "training_engine_reward": self._reward(acting, simulator),
            "evaluation_engine_reward": self._reward(acting, simulator.for_evaluation()),
        }
        self._expected_s = perf_counter() - began
        self._spent_s += self._expected_s
        return means

    def _reward(self, policy: Policy, simulator: SimulatorSettings) -> float:
        """Return the mean reward per step of the first ``STEPS`` steps of ``ROBOTS`` episodes."""
        spec = self._spec.model_copy(update={"simulator": simulator})
        environment = open_environment(spec, ROBOTS, threads=spec.runtime.simulator_threads)
        try:
            starts = environment.task.starts(ROBOTS, spec.seed, spec.task.start_noise_deg)
            environment.load_starts(starts)
            rows = np.arange(ROBOTS)
            environment.restart(rows, rows % len(starts), episodes=rows)
            active, total, steps = np.ones(ROBOTS, dtype=np.bool_), 0.0, 0
            for _ in range(STEPS):
                environment.step(policy.act(environment.observations), active)
                total += float(environment.rewards[active].sum())
                steps += int(np.count_nonzero(active))
                active &= ~(environment.terminated | environment.truncated)
                if not active.any():
                    break
        finally:
            environment.close()
        return total / steps
