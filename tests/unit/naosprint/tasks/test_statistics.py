"""Confidence intervals against known values and by simulation."""

from __future__ import annotations

import numpy as np
import pytest
from naospec.metrics import Metric
from naosprint.tasks.episodes import Statistics
from naosprint.tasks.statistics import bootstrap_mean, median_ranks, wilson


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        # Newcombe (1998), table I, method 3
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_gives_published_intervals(successes: int, trials: int, low: float, high: float) -> None:
    """The score interval of four published examples."""
    assert wilson(successes, trials, 0.95) == pytest.approx((low, high), abs=5e-5)


def test_wilson_reaches_the_ends() -> None:
    """Never below 0 or above 1."""
    assert wilson(0, 7, 0.95)[0] == 0.0
    assert wilson(7, 7, 0.95)[1] == 1.0


def test_bootstrap_covers_the_mean_as_often_as_it_says() -> None:
    """Of many samples, about 90 in 100 give an interval that contains the true mean."""
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(300):
        low, high = bootstrap_mean(rng.normal(5.0, 2.0, 60), confidence=0.9, resamples=300, rng=rng)
        hits += low <= 5.0 <= high
    assert 0.84 < hits / 300 < 0.95


def test_bootstrap_of_one_value_is_that_value() -> None:
    """There is nothing to resample."""
    interval = bootstrap_mean(np.array([3.0]), confidence=0.95, resamples=100, rng=np.random.default_rng(0))
    assert interval == (3.0, 3.0)


def test_a_single_value_has_neither_interval_nor_spread() -> None:
    """One of no width would say that it is certain; two values have both."""
    metric, statistics = Metric("reach", "Reach"), Statistics(0.95, 100, 0)
    for find in (statistics.mean, statistics.median):
        one, two = find(metric, [3.0]), find(metric, [3.0, 5.0])
        assert (one.value, one.low, one.high, one.episodes) == (3.0, 3.0, 3.0, 1)
        assert (one.interval, one.sd) == (None, None)
        assert two.interval == (3.0, 5.0)
    assert statistics.mean(metric, [3.0, 5.0]).sd == 1.0


def test_bootstrap_works_in_blocks() -> None:
    """A sample too large to resample at once still gets all its resamples."""
    values = np.random.default_rng(1).normal(size=300_000)
    low, high = bootstrap_mean(values, confidence=0.95, resamples=100, rng=np.random.default_rng(0))
    assert low < values.mean() < high
    assert high - low == pytest.approx(2 * 1.96 / np.sqrt(300_000), rel=0.4)


def test_the_median_lies_between_its_ranks_as_often_as_stated() -> None:
    assert median_ranks(1, 0.95) == (0, 0)
    rng = np.random.default_rng(2)
    for n in (15, 60, 201):
        low, high = median_ranks(n, 0.9)
        ordered = np.sort(rng.exponential(size=(2000, n)), axis=1)
        covered = (ordered[:, low] <= np.log(2.0)) & (np.log(2.0) <= ordered[:, high])
        assert 0.86 < covered.mean() < 0.96
