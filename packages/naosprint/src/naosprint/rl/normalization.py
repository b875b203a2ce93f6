"""Running normalization of observations and rewards."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from naosprint.arrays import AnyArray, BoolArray, Float32Array, FloatArray
    from naosprint.mirror import Mirror

EPSILON = 1e-8
"""Added to variances before their root is taken."""

REWARD_CLIP = 10.0
"""Largest magnitude of a normalized reward."""

_ALL = slice(None)


class RunningMoments:
    """Mean and variance of a stream of samples.

    Batches are merged by the parallel formula of Chan, Golub and LeVeque (1979). The start counts as 1e-4 samples of
    mean 0 and variance 1, so there is no division by zero.

    Args:
        width: numbers in a sample.
        mirror: if given, the moments are those of the samples and their mirror images together.
    """

    def __init__(self, width: int, mirror: Mirror | None = None) -> None:
        self._mirror = mirror
        self.mean: FloatArray = np.zeros(width)
        self.variance: FloatArray = np.ones(width)
        self.count = 1e-4

    def update(self, batch: FloatArray) -> None:
        """Merge (k, width) samples."""
        k = len(batch)
        mean = batch.mean(axis=0)
        centred = batch - mean
        squares = np.einsum("ij,ij->j", centred, centred)
        if self._mirror is not None:
            image = self._mirror.apply(mean)
            half_gap = 0.5 * (mean - image)
            squares = 0.5 * (squares + squares[self._mirror.index]) + k * half_gap * half_gap
            mean = 0.5 * (mean + image)
        total = self.count + k
        delta = mean - self.mean
        self.mean = self.mean + delta * (k / total)
        self.variance = (self.variance * self.count + squares + delta * delta * (self.count * k / total)) / total
        self.count = total


class Normalizer:
    """Standardization of observations, and scaling of rewards by the spread of the discounted return.

    Args:
        n: environments.
        width: observations.
        observations: whether observations are standardized; otherwise they pass unchanged.
        observation_clip: largest magnitude of a standardized observation.
        rewards: whether rewards are scaled.
        gamma: discount factor of the return whose spread is estimated; may change during a training.
        mirror: if given, observations are standardized alike on both sides.
    """

    def __init__(
        self,
        n: int,
        width: int,
        *,
        observations: bool,
        observation_clip: float,
        rewards: bool,
        gamma: float,
        mirror: Mirror | None = None,
    ) -> None:
        self.observation_moments = RunningMoments(width, mirror)
        self.return_moments = RunningMoments(1)
        self._returns: FloatArray = np.zeros(n)
        self._observations = observations
        self._clip = observation_clip
        self._rewards = rewards
        self.gamma = gamma

    def update_observations(self, observations: FloatArray) -> None:
        """Merge (k, width) raw observations into the statistics."""
        if self._observations:
            self.observation_moments.update(observations)

    def observations(self, observations: FloatArray) -> Float32Array:
        """Return (k, width) raw observations as the policy sees them."""
        if not self._observations:
            return observations.astype(np.float32)
        moments = self.observation_moments
        scaled = (observations - moments.mean) / np.sqrt(moments.variance + EPSILON)
        clipped: Float32Array = np.clip(scaled, -self._clip, self._clip).astype(np.float32)
        return clipped

    def rewards(self, rewards: FloatArray, dones: BoolArray, rows: slice = _ALL) -> Float32Array:
        """Merge (k,) raw rewards of the environments ``rows`` and return them as the learner sees them."""
        if not self._rewards:
            return rewards.astype(np.float32)
        returns = self._returns[rows]
        returns *= self.gamma
        returns += rewards
        self.return_moments.update(returns[:, None])
        scaled = rewards / np.sqrt(self.return_moments.variance[0] + EPSILON)
        returns[dones] = 0.0
        clipped: Float32Array = np.clip(scaled, -REWARD_CLIP, REWARD_CLIP).astype(np.float32)
        return clipped

    def state(self) -> dict[str, AnyArray]:
        """Return all statistics."""
        seen, returned = self.observation_moments, self.return_moments
        return {
            "observation_mean": seen.mean.copy(),
            "observation_variance": seen.variance.copy(),
            "observation_count": np.array([seen.count]),
            "return_mean": returned.mean.copy(),
            "return_variance": returned.variance.copy(),
            "return_count": np.array([returned.count]),
            "returns": self._returns.copy(),
        }

    def load_state(self, state: Mapping[str, AnyArray]) -> None:
        """Restore what :meth:`state` returned."""
        self.load_statistics(state)
        self._returns = np.array(state["returns"], dtype=np.float64)

    def load_statistics(self, state: Mapping[str, AnyArray]) -> None:
        """Restore only the statistics, which do not depend on the number of environments."""
        for moments, name in ((self.observation_moments, "observation"), (self.return_moments, "return")):
            moments.mean = np.array(state[f"{name}_mean"], dtype=np.float64)
            moments.variance = np.array(state[f"{name}_variance"], dtype=np.float64)
            moments.count = float(np.asarray(state[f"{name}_count"], dtype=np.float64)[0])
