"""Offer the sprint task as one Gymnasium environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from naospec import TrainingSpec

from naosprint.environment import open_batch
from naosprint.starts import draw_start_poses

if TYPE_CHECKING:
    from naosprint.arrays import FloatArray


class SprintEnv(gymnasium.Env["FloatArray", "FloatArray"]):
    """Run one robot; observations and rewards are raw.

    Args:
        spec: task, robot, simulator, sensors, start noise and reward scale are taken from it; the defaults if None.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - Gymnasium declares it so

    def __init__(self, spec: TrainingSpec | None = None) -> None:
        self.spec_ = spec or TrainingSpec()
        self._batch = open_batch(self.spec_, 1, task=self.spec_.task_definition, threads=1)
        width = len(self._batch.observer.names)
        n_actions = self._batch.actuation.n_actions
        self.observation_space = spaces.Box(-np.inf, np.inf, (width,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (n_actions,), np.float64)
        self.render_mode = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begin an episode and return its first observation; the start pose is drawn from the environment's seed."""
        super().reset(seed=seed, options=options)
        draw = int(self.np_random.integers(2**31))
        self._batch.load_starts(draw_start_poses(self._batch.actuation, 1, self.spec_.start_noise_deg, draw))
        return self._batch.observations[0].copy(), {}

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Take one step of 20 ms with (A,) target angles in [-1, 1] of each joint's range."""
        batch = self._batch
        observations = batch.step(np.asarray(action, dtype=np.float64)[None])
        info: dict[str, Any] = {"distance_m": float(batch.displacement[0]), "fallen": bool(batch.fallen[0])}
        if batch.lost[0]:
            info["server_lost"] = batch.simulator.loss_reason(0)
        return (
            observations[0].copy(),
            float(batch.rewards[0]),
            bool(batch.terminated[0]),
            bool(batch.truncated[0]),
            info,
        )

    def close(self) -> None:
        """Close the simulator."""
        self._batch.close()
