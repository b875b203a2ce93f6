"""Running normalization of observations and rewards."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from naosprint import _compiled

if TYPE_CHECKING:
    from collections.abc import Mapping

    from naosprint.arrays import AnyArray, BoolArray, Float32Array, FloatArray
    from naosprint.mirror import Mirror
    from naosprint.rl.processes import Processes

EPSILON = 1e-8
"""Added to variances before their root is taken."""

STATISTICS = ("observation_mean", "observation_variance", "observation_counts")
"""Names of a normalizer's arrays with one number per observation, which a policy keeps."""

COUNT = "observation_count"
"""Name of its largest number of samples, which a policy keeps, too."""

CRITIC = "critic_"
"""Before the names of a policy's statistics of what only the critic observes."""

REWARD_CLIP = 10.0
"""Largest magnitude of a normalized reward."""

NO_SAMPLES = 1e-4
"""Weight of mean 0 and variance 1 before the first sample."""

GUESSED_SAMPLES = 1000.0
"""Weight of guessed moments: enough for the first steps, and outweighed by the samples of a few updates."""

_ALL = slice(None)


class RunningMoments:
    """Mean and variance of a stream of samples.

    Batches are merged by the parallel formula of Chan, Golub and LeVeque (1979). The start counts as 1e-4 samples of
    mean 0 and variance 1, so there is no division by zero.

    Args:
        width: numbers in a sample.
        mirror: if given, the moments are those of the samples and their mirror images together.
        threads: address of a simulator's threads; see ``naosim.simulator.NativeHandle``.

    Attributes:
        mean: (width,) mean.
        variance: (width,) variance.
        count: (width,) number of samples of each; an observation that joins a policy later has fewer.
        compiled: what changes these arrays.
    """

    def __init__(self, width: int, mirror: Mirror | None = None, threads: int = 0) -> None:
        self.mean: FloatArray = np.zeros(width)
        self.variance: FloatArray = np.ones(width)
        self.count: FloatArray = np.full(width, NO_SAMPLES)
        index, sign = (None, None) if mirror is None else (mirror.index, mirror.sign)
        self.compiled = _compiled.Moments(self.mean, self.variance, self.count, index, sign, threads)

    def update(self, batch: FloatArray) -> None:
        """Merge (k, width) samples."""
        self.compiled.merge(batch)

    def sums(self) -> FloatArray:
        """Return the sums over the samples: (3, width) of ones, of the samples and of their squares."""
        count = self.count
        return np.stack([count, count * self.mean, count * (self.variance + np.square(self.mean))])

    def load_sums(self, sums: FloatArray) -> None:
        """Take over what :meth:`sums` returned."""
        self.load(sums[1] / sums[0], np.maximum(sums[2] / sums[0] - np.square(sums[1] / sums[0]), 0.0), sums[0])

    def load(self, mean: AnyArray, variance: AnyArray, count: AnyArray) -> None:
        """Take over these moments."""
        self.mean[:], self.variance[:], self.count[:] = mean, variance, count


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
        threads: address of a simulator's threads; see ``naosim.simulator.NativeHandle``.
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
        threads: int = 0,
    ) -> None:
        self.observation_moments = RunningMoments(width, mirror, threads)
        self.return_moments = RunningMoments(1)
        self._returns: FloatArray = np.zeros(n)
        self._observations = observations
        self._clip = observation_clip
        self._rewards = rewards
        self.gamma = gamma
        self._note_merged()

    def _note_merged(self) -> None:
        """Note what all processes have in common."""
        self._merged = {"observation": self.observation_moments.sums(), "return": self.return_moments.sums()}

    def update_observations(self, observations: FloatArray) -> None:
        """Merge (k, width) raw observations into the statistics."""
        if self._observations:
            self.observation_moments.update(observations)

    def observations(self, observations: FloatArray) -> Float32Array:
        """Return (k, width) raw observations as the policy sees them."""
        out = np.empty(observations.shape, np.float32)
        if self._observations:
            self.observation_moments.compiled.standardize(observations, self._clip, out)
        else:
            out[:] = observations
        return out

    def observe(self, observations: FloatArray, out: Float32Array) -> bool:
        """Merge (k, width) raw observations and write them to ``out`` as the policy sees them.

        Returns:
            Whether all of them are finite.
        """
        if self._observations:
            compiled = self.observation_moments.compiled
            compiled.merge(observations)
            return compiled.standardize(observations, self._clip, out)
        out[:] = observations
        return bool(np.isfinite(out).all())

    def rewards(
        self, rewards: FloatArray, dones: BoolArray, rows: slice = _ALL, out: Float32Array | None = None
    ) -> Float32Array:
        """Merge (k,) raw rewards of the environments ``rows``; return them as the learner sees them."""
        if out is None:
            out = np.empty(rewards.shape, np.float32)
        if self._rewards:
            compiled, returns = self.return_moments.compiled, self._returns[rows]
            compiled.scale_rewards(returns, rewards, dones, self.gamma, REWARD_CLIP, out)
        else:
            out[:] = rewards
        return out

    def merge(self, processes: Processes) -> None:
        """Merge what each process has seen since the last call, so that all have the same statistics."""
        if processes.size == 1:
            return
        for name, moments in (("observation", self.observation_moments), ("return", self.return_moments)):
            moments.load_sums(self._merged[name] + processes.sum(moments.sums() - self._merged[name]))
        self._note_merged()

    def state(self) -> dict[str, AnyArray]:
        """Return all statistics."""
        seen, returned = self.observation_moments, self.return_moments
        return {
            "observation_mean": seen.mean.copy(),
            "observation_variance": seen.variance.copy(),
            "observation_count": seen.count.max(keepdims=True),
            "observation_counts": seen.count.copy(),
            "return_mean": returned.mean.copy(),
            "return_variance": returned.variance.copy(),
            "return_count": returned.count.copy(),
            "returns": self._returns.copy(),
        }

    def load_state(self, state: Mapping[str, AnyArray]) -> None:
        """Restore what :meth:`state` returned."""
        self.load_statistics(state)
        self._returns = np.array(state["returns"], dtype=np.float64)

    def load_statistics(self, state: Mapping[str, AnyArray]) -> None:
        """Restore only the statistics, which do not depend on the number of environments."""
        self.observation_moments.load(*(state[name] for name in STATISTICS))
        self.return_moments.load(*(state[f"return_{part}"] for part in ("mean", "variance", "count")))
        self._note_merged()


def with_counts(policy: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Return a policy's arrays with the number of samples of each observation.

    A file has a single number where all are the same, and so does every file of earlier versions.
    """
    mean, _, counts = STATISTICS
    single = {
        part + counts: np.repeat(policy.get(COUNT, ()), np.size(policy[part + mean]))
        for part in ("", CRITIC)
        if part + mean in policy
    }
    return {**single, **policy}
