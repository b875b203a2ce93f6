"""Results of following a commanded velocity."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
from naosim.simulator import STEP_S
from naospec.metrics import Metric

from naosprint.tasks.commands import SETTLING_S
from naosprint.tasks.episodes import rate_metric
from naosprint.tasks.falls import FALL_RATE

if TYPE_CHECKING:
    from collections.abc import Iterator

    from naospec.metrics import Result

    from naosprint.arrays import BoolArray, FloatArray, IntArray
    from naosprint.tasks.episodes import Episodes, Statistics

SETTLED_S = 2.0
"""Time after which speed and error are measured in evaluations, seconds."""

STOP_S, STOP_FROM_MPS, STOPPED_MPS = 1.5, 1.0, 0.3
"""Time within which a robot has to stop, s; command from which it has to, m/s; and speed of one that has, m/s."""

_STOP_MEAN_S = 0.2  # the speed at that time is a mean over these seconds before it

ERROR = Metric(
    "velocity_error_mps", "Velocity error", "m/s", "Mean distance between commanded and actual velocity.", 2, "lower"
)
SPEED = Metric("forward_mps", "Forward speed", "m/s", "Mean speed in the commanded heading.", 2)
SETTLED_SPEED = Metric(
    "forward_settled_mps",
    "Forward speed after 2 s",
    "m/s",
    "Mean speed in the commanded heading after two seconds.",
    2,
    live=False,
)
RMSE = Metric(
    "rmse_mps", "RMSE", "m/s", "Root mean square error of the velocity after two seconds.", 3, "lower", live=False
)
RMSE_WHOLE = Metric(
    "rmse_whole_mps",
    "RMSE, start included",
    "m/s",
    "Root mean square error of the velocity over the whole episode.",
    3,
    "lower",
    live=False,
)
RMSE_SETTLED = Metric(
    "rmse_settled_mps",
    "Settled RMSE",
    "m/s",
    "Root mean square error of the velocity from one second after each new command on.",
    3,
    "lower",
    live=False,
)
STOP_RATE = rate_metric(
    "stop_rate",
    "Stops within 1.5 s",
    "Fraction of the commands to stand, after a forward command of 1 m/s or more, that bring the robot below 0.3 m/s "
    "within 1.5 s; a fall is none.",
    live=False,
)
MEDIAN_SPEED = Metric(
    "median_forward_mps",
    "Median forward speed after 2 s",
    "m/s",
    "Median over the episodes of the mean forward speed after two seconds; 0 where an episode is shorter.",
    2,
    live=False,
)
MEDIAN_RMSE = Metric(
    "median_rmse_mps",
    "Median RMSE",
    "m/s",
    "Median over the episodes of the RMSE after two seconds.",
    3,
    "lower",
    live=False,
)
MEDIAN_RMSE_WHOLE = Metric(
    "median_rmse_whole_mps",
    "Median RMSE, start included",
    "m/s",
    "Median over the episodes of the RMSE over the whole episode.",
    3,
    "lower",
    live=False,
)
MEDIAN_DRIFT = Metric(
    "median_drift_m", "Median drift", "m", "Median over the episodes of the drift.", 2, "lower", live=False
)
TURN_RMSE = Metric(
    "turn_rmse_rad_s",
    "Turn RMSE",
    "rad/s",
    "Root mean square error of the turn rate after two seconds.",
    3,
    "lower",
    live=False,
)
DRIFT = Metric("drift_m", "Drift", "m", "Distance from the commanded path at the end.", 2, "lower", live=False)
UPRIGHT = rate_metric("upright_rate", "Upright", "Fraction of episodes without a fall.", live=False)
FLIGHT = Metric(
    "flight_share",
    "Both feet off the ground",
    "%",
    "Fraction of the time with both feet off the ground.",
    1,
    live=False,
)
FLIGHT_RATE = rate_metric(
    "flight_rate",
    "Episodes with flight",
    "Fraction of episodes in which both feet are off the ground for two successive contact measurements.",
    live=False,
)


RESULTS = (
    RMSE,
    RMSE_WHOLE,
    TURN_RMSE,
    SETTLED_SPEED,
    DRIFT,
    MEDIAN_SPEED,
    MEDIAN_RMSE,
    MEDIAN_RMSE_WHOLE,
    MEDIAN_DRIFT,
    UPRIGHT,
    FLIGHT,
    FLIGHT_RATE,
    RMSE_SETTLED,
    STOP_RATE,
)
"""What only evaluations report."""


def applied(trace: FloatArray) -> FloatArray:
    """Return a (T, 8) trace in which the command of each step is the one that the robot had in it, not the next."""
    trace = trace.copy()
    trace[1:, 3:6] = trace[:-1, 3:6].copy()
    return trace


def _changes(trace: FloatArray) -> IntArray:
    """Return the samples of a (T, 8) trace with which a new command begins, the start among them."""
    return np.concatenate(([0], 1 + np.flatnonzero((trace[1:, 3:6] != trace[:-1, 3:6]).any(axis=1))))


def _follows(trace: FloatArray) -> BoolArray:
    """Return which samples of a (T, 8) trace come ``SETTLING_S`` after a new command or later."""
    changes, samples = _changes(trace), np.arange(len(trace))
    since = samples - changes[np.searchsorted(changes, samples, side="right") - 1]
    return np.asarray(since >= round(SETTLING_S / STEP_S))


def _stops(trace: FloatArray, fallen: bool) -> Iterator[bool]:
    """Yield for each command to stand of a (T, 8) trace that had to stop the robot whether it did.

    Left out are commands that the next one, or the episode's end without a fall, follows within ``STOP_S``.
    """
    changes = _changes(trace)
    steps, mean = round(STOP_S / STEP_S), round(_STOP_MEAN_S / STEP_S)
    for number in range(1, len(changes)):
        first, is_last = changes[number], number == len(changes) - 1
        end = len(trace) if is_last else changes[number + 1]
        if trace[first, 3:6].any() or trace[first - 1, 3] < STOP_FROM_MPS:
            continue
        if end - first >= steps:
            velocity = trace[first + steps - mean : first + steps, :2].mean(axis=0)
            yield bool(np.hypot(*velocity) < STOPPED_MPS)
        elif is_last and fallen:
            yield False


def _root_mean_square(errors: list[FloatArray]) -> FloatArray:
    """Return the root mean square length of the errors of each episode that has some."""
    return _finite([np.sqrt(np.square(each).sum(axis=1).mean()) for each in errors if len(each)])


def _finite(values: list[float]) -> FloatArray:
    array: FloatArray = np.array(values, dtype=np.float64)
    return np.asarray(array[np.isfinite(array)])


def followed(episodes: Episodes, statistics: Statistics) -> tuple[Result, ...]:
    """Return how well the command was followed in the episodes of an evaluation."""
    settled, fallen = round(SETTLED_S / STEP_S), episodes.ends["fallen"]
    traces = list(map(applied, episodes.trace))
    errors = [trace[:, :3] - trace[:, 3:6] for trace in traces]
    rmse = _root_mean_square([each[settled:, :2] for each in errors])
    rmse_whole = _root_mean_square([each[1:, :2] for each in errors])
    rmse_settled = _root_mean_square([each[_follows(trace), :2] for each, trace in zip(errors, traces, strict=True)])
    speed = [trace[settled:, 0].mean() if len(trace) > settled else np.nan for trace in traces]
    drift = np.array([abs(trace[-1, 6]) for trace in traces])
    stops = chain.from_iterable(map(_stops, traces, fallen.tolist()))
    return (
        statistics.mean(RMSE, rmse),
        statistics.mean(RMSE_WHOLE, rmse_whole),
        statistics.mean(TURN_RMSE, _root_mean_square([each[settled:, 2:] for each in errors])),
        statistics.mean(SPEED, np.array([trace[1:, 0].mean() for trace in traces])),
        statistics.mean(SETTLED_SPEED, _finite(speed)),
        statistics.mean(DRIFT, drift),
        statistics.median(MEDIAN_SPEED, np.nan_to_num(speed)),
        statistics.median(MEDIAN_RMSE, rmse),
        statistics.median(MEDIAN_RMSE_WHOLE, rmse_whole),
        statistics.median(MEDIAN_DRIFT, drift),
        statistics.rate(UPRIGHT, ~fallen),
        statistics.rate(FALL_RATE, fallen),
        statistics.mean(FLIGHT, np.array([flags[1:].mean() for flags in episodes.airborne])),
        statistics.rate(FLIGHT_RATE, np.array([trace[1:, 7].any() for trace in traces])),
        statistics.mean(RMSE_SETTLED, rmse_settled),
        statistics.rate(STOP_RATE, np.array(list(stops), dtype=np.bool_)),
    )
