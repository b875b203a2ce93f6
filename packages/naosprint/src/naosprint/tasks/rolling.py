"""How far and where a ball rolls on rcssservermj, and how to launch it so that it stops at a point.

MuJoCo's rolling friction acts along the world's x and y axes, so a ball swerves toward the field's diagonals: one that
is launched 20 degrees from the x axis stops 31 degrees from it, and rolls farther than along the axis. The swerve
comes late, when the ball is slow. ``ball_data/rolls.json`` contains rolls in the exact engine; a test repeats some.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from naosprint.terms import Number, interpolated

if TYPE_CHECKING:
    from naosprint.arrays import BoolArray, FloatArray, IntArray

SLIDES = 7.0 / 5.0
"""Speed of a ball without spin, as a multiple of that with which it rolls once it no longer slides."""

_QUARTER = np.pi / 2.0
_ROUNDS = 50  # the distance grows with the speed to the power 1.5 to 2, so each brings the speed closer
_POWER_MPS, _POWER_PASSES_M = 4.0, 7.0
_TURNS = 0.028  # largest turn of a ball while it slides, radians
_PATH_S, _PATH_STEPS, _PATH_M, _PATH_DEG = 0.02, 250, 12.0, 80.0  # of the table of paths
_DIFFERENCE_MPS, _DIFFERENCE = 0.2, np.radians(4.0)  # for derivatives of the stops
_TABLE = Path(__file__).with_name("ball_data") / "rolls.json"


@cache
def table() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return (S,) speeds in m/s, (D,) launch directions in radians, (S, D) distances in metres and directions."""
    found = json.loads(_TABLE.read_bytes())
    speeds, directions = np.array(found["speeds_mps"]), np.radians(found["directions_deg"])
    return speeds, directions, np.array(found["distance_m"]), np.radians(found["stop_deg"])


def roll(velocity: Number, spin: Number, radius_m: float) -> Number:
    """Return the velocity (x, y) with which a ball of this velocity and spin rolls once it no longer slides.

    Sliding friction keeps the angular momentum about the contact: v' = (5 v + 2 r (w x up)) / 7 for a uniform sphere.
    """
    return (velocity[:2] * 5.0 + spin[[1, 0]] * (2.0 * radius_m) * [1.0, -1.0]) / 7.0


def stop(speed: FloatArray, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far balls roll, in metres, and in which direction from their start they stop.

    Args:
        speed: (k,) speeds of rolling balls, m/s.
        direction: (k,) directions in radians, counter-clockwise from the field's +x axis.
    """
    speeds, directions, distances, turned = table()
    axis = np.round(direction / _QUARTER) * _QUARTER
    aside = direction - axis
    row, column = _place(speeds, speed), _place(directions, np.abs(aside))
    # below the slowest roll of the table distances grow with the square of the speed
    slow = np.square(np.minimum(speed / speeds[0], 1.0))
    return slow * _between(distances, row, column), axis + np.sign(aside) * _between(turned, row, column)


def straight(speed: Number) -> Number:
    """Return how far a ball of this speed rolls along the field's x axis, metres."""
    speeds, _, distances, _ = table()
    return interpolated(speed, [0.0, *speeds.tolist()], [0.0, *distances[:, 0].tolist()])


def speed_of(distance_m: Number) -> Number:
    """Return the speed of a ball that rolls so far along the field's x axis, m/s."""
    speeds, _, distances, _ = table()
    return interpolated(distance_m, [0.0, *distances[:, 0].tolist()], [0.0, *speeds.tolist()])


def launch(distance_m: FloatArray, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (k,) speeds in m/s and directions with which balls have to roll off to stop at (k,) distances.

    Args:
        distance_m: (k,) distances.
        direction: (k,) directions of the points where they stop, radians, counter-clockwise from the field's +x axis.
    """
    distances, directions, speeds, aims = launches()
    axis = np.round(direction / _QUARTER) * _QUARTER
    aside = direction - axis
    row, column = _place(distances, distance_m), _place(directions, np.abs(aside))
    return _between(speeds, row, column), axis + np.sign(aside) * _between(aims, row, column)


def aim(speed: FloatArray, ahead_m: FloatArray, aside_m: FloatArray, slides: BoolArray | None = None) -> FloatArray:
    """Return the (k,) directions in which to launch balls so that they pass (k,) points, radians, 80 degrees at most.

    Directions are counted from an axis of the field, along which a point is ``ahead_m`` and to whose left ``aside_m``
    metres away.

    Args:
        speed: (k,) speeds with which the balls roll, and get there, m/s.
        ahead_m: (k,) distances along the axis, up to 12.
        aside_m: (k,) distances to the left of it.
        slides: (k,) balls that slide at first, faster by `SLIDES`, and meanwhile turn to a diagonal; by default none.
    """
    speeds, directions, lines, passed = paths()
    row, line, target = _place(speeds, speed), _place(lines, ahead_m), np.abs(aside_m)
    direction = np.arctan2(target, ahead_m)
    for _ in range(8):
        column = _place(directions, direction)
        near, far = (_between(passed, row, column, line[0] + i) for i in (0, 1))
        target = target + np.abs(aside_m) - ((1.0 - line[1]) * near + line[1] * far)
        direction = np.arctan2(np.maximum(target, 0.0), ahead_m)
    if slides is not None:
        direction = direction - slides * _TURNS * np.sin(4.0 * direction)
    return np.sign(aside_m) * direction


def power_aim(direction: FloatArray) -> FloatArray:
    """Return the directions in which to kick balls as far as possible so that they pass points in (k,) directions.

    All directions are radians, counter-clockwise from the field's +x axis. The points are 7 m away and the balls as
    fast as kicks of a T1, which slide at first.
    """
    axis = np.round(direction / _QUARTER) * _QUARTER
    aside = direction - axis
    return np.asarray(axis + np.sign(aside) * np.interp(np.abs(aside), launches()[1], power_aims()))


@cache
def power_aims() -> FloatArray:
    """Return `power_aim` of the directions of `launches`."""
    directions = launches()[1]
    speed, slides = np.full_like(directions, _POWER_MPS), np.ones(len(directions), dtype=np.bool_)
    return aim(speed, _POWER_PASSES_M * np.cos(directions), _POWER_PASSES_M * np.sin(directions), slides)


@cache
def paths() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return (S,) speeds, (D,) directions, (L,) distances ahead, and (L, S, D) how far aside balls are there, metres.

    How a ball slows down follows from where it stops: what it still rolls is a function of its velocity alone, so that
    this function's derivative along the path is the velocity.
    """
    speeds, directions = np.linspace(1.0, 6.0, 21), np.radians(np.arange(0.0, _PATH_DEG + 1.0, 4.0))
    lines = np.arange(0.0, _PATH_M + 0.1, 0.5)
    speed, direction = (each.ravel() for each in np.meshgrid(speeds, directions, indexing="ij"))
    shape = len(lines), *(len(speeds), len(directions))
    passed: FloatArray = np.zeros((len(lines), len(speed)))
    place: FloatArray = np.zeros((len(speed), 2))
    for _ in range(_PATH_STEPS):
        slower, turned = _rates(speed, direction)
        before, moved = place, 0.5 * _PATH_S * _vector(speed, direction)
        speed = np.maximum(speed + _PATH_S * slower, 0.02)
        direction = direction + _PATH_S * turned
        place = place + moved + 0.5 * _PATH_S * _vector(speed, direction)
        # where the path crosses the lines of this step; lines beyond get the path's end
        for i in np.flatnonzero(lines > before[:, 0].min()).tolist():
            share = np.clip((lines[i] - before[:, 0]) / np.maximum(place[:, 0] - before[:, 0], 1e-9), 0.0, 1.0)
            crossing = before[:, 1] + share * (place[:, 1] - before[:, 1])
            passed[i] = np.where(before[:, 0] < lines[i], crossing, passed[i])
    return speeds, directions, lines, passed.reshape(shape)


def _rates(speed: FloatArray, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how (k,) speeds and directions of rolling balls change, m/s^2 and rad/s."""
    low, high = np.maximum(speed - _DIFFERENCE_MPS, 0.5 * speed), np.minimum(speed + _DIFFERENCE_MPS, table()[0][-1])
    by_speed = (_rest(high, direction) - _rest(low, direction)) / (high - low)[:, None]
    by_direction = (_rest(speed, direction + _DIFFERENCE) - _rest(speed, direction - _DIFFERENCE)) / (2.0 * _DIFFERENCE)
    rates = np.linalg.solve(np.stack([by_speed, by_direction], axis=2), -_vector(speed, direction)[:, :, None])
    return rates[:, 0, 0], rates[:, 1, 0]


def _rest(speed: FloatArray, direction: FloatArray) -> FloatArray:
    """Return the (k, 2) ways that balls roll until they stop."""
    return _vector(*stop(speed, direction))


def _vector(length: FloatArray, direction: FloatArray) -> FloatArray:
    return np.stack([length * np.cos(direction), length * np.sin(direction)], axis=1)


@cache
def launches() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return distances and directions of stops, and for each pair of them the speed and direction of the launch."""
    distances, directions = np.linspace(0.2, 14.0, 139), np.radians(np.arange(46.0))
    shape = len(distances), len(directions)
    far, direction = (each.ravel() for each in np.meshgrid(distances, directions, indexing="ij"))
    speed, aim = _inverse(far, direction)
    return distances, directions, speed.reshape(shape), aim.reshape(shape)


def _inverse(distance_m: FloatArray, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the arguments for which :func:`stop` returns (k,) distances and directions."""
    fastest, axis = table()[0][-1], np.round(direction / _QUARTER) * _QUARTER
    speed, aim = np.full_like(distance_m, 2.0), np.array(direction)
    for _ in range(_ROUNDS):
        reached, found = stop(speed, aim)
        speed = np.clip(speed * np.sqrt(distance_m / np.maximum(reached, 1e-6)), 1e-3, fastest)
        aim = axis + np.clip(aim + 0.7 * (direction - found) - axis, -0.5 * _QUARTER, 0.5 * _QUARTER)
    return speed, aim


def _place(grid: FloatArray, values: FloatArray) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], FloatArray]:
    """Return in which interval of a grid values are, and where in it, 0 to 1."""
    # np.clip takes three times as long for the few values of an episode's start
    index = np.minimum(np.maximum(grid.searchsorted(values) - 1, 0), len(grid) - 2)
    low = grid[index]
    return index, np.minimum(np.maximum((values - low) / (grid[index + 1] - low), 0.0), 1.0)


def _between(values: FloatArray, row: tuple, column: tuple, *first: IntArray) -> FloatArray:  # type: ignore[type-arg]
    """Return a table's values between its rows and columns, bilinearly; of more dimensions at the first indices."""
    (i, s), (j, t) = row, column
    near = (1.0 - t) * values[*first, i, j] + t * values[*first, i, j + 1]
    far = (1.0 - t) * values[*first, i + 1, j] + t * values[*first, i + 1, j + 1]
    return np.asarray((1.0 - s) * near + s * far)
