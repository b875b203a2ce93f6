"""Recorded episodes of an evaluation, and the statistics of their results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from naospec.metrics import Better, Metric, Result

from naosprint.tasks.statistics import bootstrap_mean, median_ranks, spread, wilson

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from naosprint.arrays import BoolArray, FloatArray


def rate_metric(
    name: str,
    title: str,
    description: str,
    better: Better | None = "higher",
    *,
    live: bool = True,
    families: tuple[str, ...] | None = None,
) -> Metric:
    """Return a metric that is the fraction of the episodes for which something is true."""
    return Metric(name, title, "%", description, 1, better, "rate", live, families)


@dataclass(frozen=True)
class Episodes:
    """Every step of every episode of an evaluation; index 0 of an episode is its start.

    Attributes:
        x, y, height: per episode (samples,) torso position in metres.
        up: per episode (samples,) upward component of the torso's z axis.
        feet: per episode (samples, 2) upward force on left and right foot in newtons.
        airborne: per episode (samples,) whether neither foot touches the ground.
        trace: per episode (samples, C) what the task keeps of each step.
        ends: (episodes,) by name of an end: whether the episode ended so.
        max_steps: length limit of an episode in steps.
    """

    x: list[FloatArray]
    y: list[FloatArray]
    height: list[FloatArray]
    up: list[FloatArray]
    feet: list[FloatArray]
    airborne: list[BoolArray]
    trace: list[FloatArray]
    ends: Mapping[str, BoolArray]
    max_steps: int

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.x)

    @property
    def steps(self) -> FloatArray:
        """(episodes,) lengths in steps."""
        return np.array([len(x) - 1 for x in self.x], dtype=np.float64)


class Statistics:
    """Results with confidence intervals from samples of episodes.

    Args:
        confidence: level of the intervals.
        resamples: resamples of a bootstrap interval.
        seed: seed of the resampling.
    """

    def __init__(self, confidence: float, resamples: int, seed: int) -> None:
        self.confidence = confidence
        self._resamples = resamples
        self._rng = np.random.default_rng([0xB007, seed])

    def mean(self, metric: Metric, values: FloatArray | Sequence[float]) -> Result:
        """Return mean, spread, extremes and the bootstrap interval of the mean of one value per episode.

        A single value has neither spread nor interval: resampled, it would only repeat itself.
        """
        values = np.asarray(values, dtype=np.float64)
        if not len(values):
            return Result(metric, None)
        # drawn in any case: the intervals of other results do not depend on how many values this one has
        interval = bootstrap_mean(values, confidence=self.confidence, resamples=self._resamples, rng=self._rng)
        return Result(
            metric,
            float(values.mean()),
            sd=spread(values),
            interval=interval if len(values) > 1 else None,
            low=float(values.min()),
            high=float(values.max()),
            episodes=len(values),
        )

    def median(self, metric: Metric, values: FloatArray | Sequence[float]) -> Result:
        """Return the median of one value per episode, with the interval between two of the sorted values, if any."""
        ordered = np.sort(np.asarray(values, dtype=np.float64))
        n = len(ordered)
        if not n:
            return Result(metric, None)
        low, high = median_ranks(n, self.confidence)
        return Result(
            metric,
            float(np.median(ordered)),
            interval=(float(ordered[low]), float(ordered[high])) if n > 1 else None,
            low=float(ordered[0]),
            high=float(ordered[-1]),
            episodes=n,
        )

    def rate(self, metric: Metric, flags: BoolArray) -> Result:
        """Return the fraction of true values, with Wilson's interval."""
        count, n = int(flags.sum()), len(flags)
        if not n:
            return Result(metric, None)
        interval = wilson(count, n, self.confidence)
        return Result(metric, count / n, interval=interval, count=count, episodes=n)
