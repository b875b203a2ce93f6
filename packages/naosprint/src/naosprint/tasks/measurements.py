"""Measurements: what tasks take of every step, in arrays with one row per robot.

Reward terms, ends and metrics use the arrays. Tasks list their measurements in ``Task.measurements``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np

from naosprint.tasks.compiled import Operation

if TYPE_CHECKING:
    from naosprint.arrays import BoolArray, FloatArray, IntArray
    from naosprint.tasks.base import World


class Measurement(ABC):
    """Something that a task takes of every step.

    Attributes:
        operation: its compiled form, if it has one.
    """

    operation: Operation | None = None

    @abstractmethod
    def begin(self, rows: IntArray) -> None:
        """Reset the robots ``rows``, whose episode begins now."""

    @abstractmethod
    def update(self, rows: slice) -> None:
        """Measure the robots ``rows`` after a step."""


class Displacement(Measurement):
    """Coordinate of the torso.

    Args:
        world: the robots.
        axis: 0 for x, 1 for y, 2 for z.

    Attributes:
        now: (n,) latest value in metres.
        start: (n,) value at the start of the episode.
        change: (n,) difference that the latest step made.
    """

    def __init__(self, world: World, axis: int = 0) -> None:
        self._world, self._axis = world, axis
        self.now: FloatArray = np.zeros(world.n)
        self.start: FloatArray = np.zeros(world.n)
        self.change: FloatArray = np.zeros(world.n)
        position = world.simulator.truth.torso_position
        self.operation = Operation(
            "displacement",
            {"position": position, "now": self.now, "start": self.start, "change": self.change},
            {"axis": [axis]},
        )

    def begin(self, rows: IntArray) -> None:
        """Store where the robots start."""
        self.now[rows] = self.start[rows] = self._world.position(rows)[:, self._axis]

    def update(self, rows: slice) -> None:
        """Compute how far the step went."""
        now = self._world.position(rows)[:, self._axis]
        self.change[rows] = now - self.now[rows]
        self.now[rows] = now


class Deviation(Measurement):
    """Distance of the torso from the line along the x axis at ``y_m``.

    Attributes:
        now: (n,) latest value in metres.
        change: (n,) difference that the latest step made.
    """

    def __init__(self, world: World, y_m: float) -> None:
        self._world, self._y = world, y_m
        self.now: FloatArray = np.zeros(world.n)
        self.change: FloatArray = np.zeros(world.n)
        arrays = {"position": world.simulator.truth.torso_position, "now": self.now, "change": self.change}
        self.operation = Operation("deviation", arrays, {"y": [y_m]})

    def begin(self, rows: IntArray) -> None:
        """Store how far aside the robots start."""
        self.now[rows] = np.abs(self._world.position(rows)[:, 1] - self._y)

    def update(self, rows: slice) -> None:
        """Compute how far aside the step went."""
        now = np.abs(self._world.position(rows)[:, 1] - self._y)
        self.change[rows] = now - self.now[rows]
        self.now[rows] = now


class Below(Measurement):
    """Whether the torso is below a height.

    Attributes:
        flag: (n,) whether it is.
    """

    def __init__(self, world: World, height_m: float) -> None:
        self._world, self._height = world, height_m
        self.flag: BoolArray = np.zeros(world.n, dtype=np.bool_)
        arrays = {"position": world.simulator.truth.torso_position, "flag": self.flag}
        self.operation = Operation("below", arrays, {"height": [height_m]})

    def begin(self, rows: IntArray) -> None:
        """Reset the flags."""
        self.flag[rows] = False

    def update(self, rows: slice) -> None:
        """Compare the heights."""
        self.flag[rows] = self._world.position(rows)[:, 2] < self._height


class Beyond(Measurement):
    """Whether a value exceeds a limit, unless another flag is set.

    Args:
        value: (n,) values, measured before.
        limit: the limit.
        unless: (n,) flags, measured before.

    Attributes:
        flag: (n,) whether it does.
    """

    def __init__(self, value: FloatArray, limit: float, unless: BoolArray) -> None:
        self._value, self._limit, self._unless = value, limit, unless
        self.flag: BoolArray = np.zeros(len(value), dtype=np.bool_)
        self.operation = Operation("beyond", {"value": value, "unless": unless, "flag": self.flag}, {"limit": [limit]})

    def begin(self, rows: IntArray) -> None:
        """Reset the flags."""
        self.flag[rows] = False

    def update(self, rows: slice) -> None:
        """Compare the values."""
        self.flag[rows] = (self._value[rows] > self._limit) & ~self._unless[rows]
