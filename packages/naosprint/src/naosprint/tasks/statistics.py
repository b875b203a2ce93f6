"""Confidence intervals."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from naosprint.arrays import FloatArray

_BLOCK = 4_000_000  # indices drawn at once, to bound memory


def spread(values: FloatArray) -> float | None:
    """Return the standard deviation of (k,) values; None of a single one."""
    return float(values.std()) if len(values) > 1 else None


def bootstrap_mean(
    values: FloatArray, *, confidence: float, resamples: int, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the percentile bootstrap interval of the mean of (k,) values, k at least 1."""
    k = len(values)
    per_block = max(1, _BLOCK // k)
    means = np.concatenate(
        [
            values[rng.integers(k, size=(min(per_block, resamples - done), k))].mean(axis=1)
            for done in range(0, resamples, per_block)
        ]
    )
    tail = (1.0 - confidence) / 2.0
    low, high = np.quantile(means, [tail, 1.0 - tail])
    return float(low), float(high)


def wilson(successes: int, trials: int, confidence: float) -> tuple[float, float]:
    """Return Wilson's score interval of a proportion; ``trials`` is at least 1. Wilson (1927)."""
    z = NormalDist().inv_cdf(0.5 + confidence / 2.0)
    p = successes / trials
    centre = (p + z * z / (2 * trials)) / (1 + z * z / trials)
    reach = z / (1 + z * z / trials) * math.sqrt(p * (1 - p) / trials + z * z / (4 * trials * trials))
    # the ends are exact at 0 and 1, where rounding would miss them
    low = 0.0 if successes == 0 else centre - reach
    high = 1.0 if successes == trials else centre + reach
    return low, high


def median_ranks(n: int, confidence: float) -> tuple[int, int]:
    """Return the indices of the sorted n values, n at least 1, between which the median lies.

    The number of values below the median is binomial; its normal approximation is used. Conover (1999), section 3.2.
    """
    reach = NormalDist().inv_cdf(0.5 + confidence / 2.0) * math.sqrt(n) / 2.0
    return max(0, math.ceil(n / 2.0 - reach) - 1), min(n - 1, math.ceil(n / 2.0 + reach) - 1)
