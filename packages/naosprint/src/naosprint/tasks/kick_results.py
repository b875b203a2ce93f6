"""Results of kicks: what became of the balls of an evaluation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from naosim.simulator import STEP_S
from naospec.metrics import Metric, Result, ResultTable

from naosprint.tasks import rolling
from naosprint.tasks.ball import components, principal
from naosprint.tasks.episodes import rate_metric

if TYPE_CHECKING:
    from naosprint.arrays import BoolArray
    from naosprint.tasks.episodes import Episodes, Statistics

CORRIDORS_M = (2.0, 3.5, 5.0)
"""Lengths of the corridors that a kick has to pass."""

CORRIDOR_HALF_M = 0.5
"""Half the corridors' width, metres."""

GOAL_M, GOAL_HALF_M = 8.0, 1.83
"""Distance of a goal, and half its width, metres."""

UPRIGHT_S = 3.0
"""Time after the touch at which a robot has to be upright, seconds."""

CONTACT = rate_metric("contact_rate", "Touches", "Fraction of episodes in which the ball is touched.")
LAUNCH_ERROR = Metric(
    "launch_error_deg",
    "Launch error",
    "°",
    "Angle between commanded and actual direction of the ball's roll; 180 for a miss.",
    1,
    "lower",
)
ROLL = Metric(
    "roll_m", "Roll", "m", "Distance that the kick lets the ball roll straight along an axis of the field.", 1
)
ROLL_ERROR = Metric(
    "roll_error",
    "Roll error",
    "%",
    "Difference from the commanded roll as a share of it; 0 for power kicks.",
    0,
    "lower",
)
UPRIGHT_RATE = rate_metric(
    "upright_rate", "Upright after 3 s", "Fraction of the kicks 3 s after which the robot stands.", live=False
)
STOP_ERROR = Metric(
    "stop_error_deg",
    "Direction error",
    "°",
    "Median angle between the commanded point and where the ball stops.",
    1,
    "lower",
    live=False,
)
STOP_ERROR_90 = Metric(
    "stop_error_90_deg",
    "Direction error, 90th percentile",
    "°",
    "Error that nine of ten kicks stay below.",
    1,
    "lower",
    live=False,
)
DISTANCE = Metric(
    "kick_distance_m", "Distance", "m", "Distance from the ball's start to where it stops.", 2, live=False
)
POWER = Metric(
    "power_distance_m",
    "Distance of power kicks",
    "m",
    "Mean distance of the kicks that are to go as far as possible.",
    2,
    "higher",
    live=False,
)
DISTANCE_ERROR = Metric(
    "distance_error",
    "Distance error",
    "%",
    "Median difference from commanded distances of 2 to 6 m, as a share.",
    1,
    "lower",
    live=False,
)
CORRIDOR = rate_metric(
    "corridor_rate",
    "Through the corridor",
    "Fraction of the kicks that are to go at least so far, stay within a corridor of 1 m, and leave the robot upright.",
    live=False,
)
CORRIDOR_5 = rate_metric(
    "corridor_5_rate", "Corridor of 5 m", "Fraction of those kicks through a corridor of 5 m.", live=False
)
GOAL = rate_metric(
    "goal_rate",
    "Into a goal 8 m away",
    "Fraction of the kicks that are to go at least 8 m, cross the line of a goal of 3.66 m there, and leave the robot "
    "upright.",
    live=False,
)
METRICS = (CONTACT, LAUNCH_ERROR, ROLL, ROLL_ERROR)
"""What trainings report, too."""

RESULTS = (UPRIGHT_RATE, CORRIDOR_5, STOP_ERROR, STOP_ERROR_90, DISTANCE_ERROR, GOAL, POWER, DISTANCE)
"""What only evaluations report."""


class Kicks:
    """What became of the balls of an evaluation.

    Attributes:
        aligned: (episodes,) whether the start was aligned.
    """

    def __init__(self, episodes: Episodes) -> None:
        self._paths = [trace[:, :2] - trace[0, :2] for trace in episodes.trace]
        first = np.array([trace[0] for trace in episodes.trace])
        self._direction, self._distance, self.aligned = first[:, 3], first[:, 4], first[:, 5] > 0.0
        touched = np.array([trace[-1, 2] > 0.0 for trace in episodes.trace])
        moment = np.array([int(np.argmax(trace[:, 2] > 0.0)) for trace in episodes.trace])
        late = episodes.steps - moment >= UPRIGHT_S / STEP_S
        self._touched, self._upright = touched, touched & (late | ~episodes.ends["fallen"])
        self._along, self._across = zip(
            *(
                components(np.array(direction), path)
                for direction, path in zip(self._direction, self._paths, strict=True)
            ),
            strict=True,
        )
        # an episode may end before the ball does, such as with a fall
        last = np.array([trace[-1, 7:9] for trace in episodes.trace])
        further, way = rolling.stop(np.hypot(*last.T), np.arctan2(last[:, 1], last[:, 0]))
        ends = np.array([path[-1] for path in self._paths]) + further[:, None] * np.stack([np.cos(way), np.sin(way)], 1)
        self._rolled = np.hypot(*ends.T)
        self._error = np.degrees(np.abs(principal(np.arctan2(ends[:, 1], ends[:, 0]) - self._direction)))
        self._power = np.isinf(self._distance)

    def passed(self, length: float, chosen: BoolArray) -> BoolArray:
        """Return which of the chosen kicks of at least this distance pass the corridor."""
        return np.array(
            [self._passes(i, length) for i in np.flatnonzero(chosen & (self._distance >= length)).tolist()],
            dtype=np.bool_,
        )

    def scored(self, chosen: BoolArray) -> BoolArray:
        """Return which of the chosen kicks of at least 8 m cross a goal's line there."""
        far = np.flatnonzero(chosen & (self._distance >= GOAL_M)).tolist()
        return np.array([self._scores(i) for i in far], dtype=np.bool_)

    def _scores(self, i: int) -> bool:
        beyond = np.flatnonzero(self._along[i] >= GOAL_M)
        return bool(len(beyond) and self._upright[i] and abs(self._across[i][beyond[0]]) <= GOAL_HALF_M)

    def _passes(self, i: int, length: float) -> bool:
        beyond = np.flatnonzero(self._along[i] >= length)
        if not len(beyond) or not self._upright[i]:
            return False
        return bool(np.abs(self._across[i][: beyond[0] + 1]).max() <= CORRIDOR_HALF_M)

    def results(self, chosen: BoolArray, statistics: Statistics) -> tuple[Result, ...]:
        """Return the results of the chosen kicks."""
        kicked = chosen & self._touched
        errors = self._error[kicked]
        middle = kicked & (self._distance >= 2.0) & (self._distance <= 6.0)
        asked = np.abs(self._rolled[middle] / self._distance[middle] - 1.0)
        worst = float(np.percentile(errors, 90)) if len(errors) else None
        return (
            statistics.rate(CONTACT, self._touched[chosen]),
            statistics.rate(UPRIGHT_RATE, self._upright[kicked]),
            statistics.rate(CORRIDOR_5, self.passed(CORRIDORS_M[-1], chosen)),
            statistics.median(STOP_ERROR, errors),
            Result(STOP_ERROR_90, worst, episodes=len(errors)),
            statistics.median(DISTANCE_ERROR, asked),
            statistics.rate(GOAL, self.scored(chosen)),
            statistics.mean(POWER, self._rolled[kicked & self._power]),
            statistics.mean(DISTANCE, self._rolled[kicked]),
        )

    def corridors(self, statistics: Statistics) -> ResultTable:
        """Return a table of the corridors that aligned and other kicks pass."""
        classes = {"Aligned": self.aligned, "Other": ~self.aligned}
        return ResultTable(
            "corridors",
            "Corridors by start",
            "Fraction of the kicks of at least this distance that pass a corridor of 1 m and leave the robot upright.",
            Metric("corridor_m", "Corridor", "m", digits=1),
            CORRIDORS_M,
            {
                title: tuple(statistics.rate(CORRIDOR, self.passed(length, chosen)) for length in CORRIDORS_M)
                for title, chosen in classes.items()
                if chosen.any()
            },
        )
