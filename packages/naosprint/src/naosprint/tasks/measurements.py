"""Measurements: what tasks take of every step, in arrays with one row per robot.

Reward terms, ends and metrics use the arrays. Tasks list their measurements in ``Task.measurements``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from naosprint.terms import Number, Store, absolute, constant, source
from naosprint.terms.expressions import sources

if TYPE_CHECKING:
    from naosprint.arrays import AnyArray, BoolArray, FloatArray, IntArray
    from naosprint.tasks.world import World


class Measurement(ABC):
    """Something that a task takes of every step."""

    @abstractmethod
    def begin(self, rows: IntArray) -> None:
        """Reset the robots ``rows``, whose episode begins now."""

    @abstractmethod
    def update(self, rows: slice) -> None:
        """Measure the robots ``rows`` after a step."""


class StoredNumbers(Measurement):
    """Expressions, stored one after the other: a measurement that runs compiled.

    Args:
        stores: what is stored, in order.
    """

    def __init__(self, stores: Sequence[Store]) -> None:
        self.stores = tuple(stores)

    @property
    def is_whole(self) -> bool:
        """Whether the stores are all that it does: a subclass may do more in Python."""
        mine = type(self)
        return mine.begin is StoredNumbers.begin and mine.update is StoredNumbers.update

    def begin(self, rows: IntArray) -> None:
        """Store what an episode begins with."""
        for store in self.stores:
            store.apply(store.begin, rows)

    def update(self, rows: slice) -> None:
        """Store what follows from the step."""
        for store in self.stores:
            store.apply(store.update, rows)


def kept(parts: Sequence[tuple[str, Sequence[Store] | None]], saved: Sequence[AnyArray]) -> dict[str, AnyArray]:
    """Return the arrays in which stores keep something from one step to the next, besides those that are saved already.

    An array that each step writes before anything reads it keeps nothing, such as a flag.

    Args:
        parts: names and stores of what a step computes, in order; None for code in Python, which may read any array.
        saved: arrays that are saved already.

    Returns:
        Arrays by the name of their part and the number of their store.
    """
    read: list[AnyArray] = []
    written: list[AnyArray] = []
    for _, stores in parts:
        if stores is None:
            break
        for store in stores:
            if store.update is not None:
                array = store.target.array
                read += [each.array for each in sources(store.update)]
                if not any(np.may_share_memory(array, each) for each in read):
                    written.append(array)
    found: dict[str, AnyArray] = {}
    for name, stores in parts:
        for number, store in enumerate(stores or ()):
            array = store.target.array
            if not any(_contains(each, array) for each in (*saved, *written, *found.values())):
                found[f"{name}.{number}"] = array
    return found


def _contains(array: AnyArray, part: AnyArray) -> bool:
    """Return whether a part, such as a column, is the array or lies in it."""
    (first, end), (low, high) = np.lib.array_utils.byte_bounds(array), np.lib.array_utils.byte_bounds(part)
    return array is part or (array.flags.c_contiguous and first <= low and high <= end)


class Displacement(StoredNumbers):
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
        self.now: FloatArray = np.zeros(world.n)
        self.start: FloatArray = np.zeros(world.n)
        self.change: FloatArray = np.zeros(world.n)
        position, now = world.true_position[axis], source(self.now)
        super().__init__(
            [
                Store(source(self.start), begin=position),
                Store(source(self.change), update=position - now),
                Store(now, begin=position, update=position),
            ]
        )


class Deviation(StoredNumbers):
    """Distance of the torso from the line along the x axis at ``y_m``.

    Attributes:
        now: (n,) latest value in metres.
        change: (n,) difference that the latest step made.
    """

    def __init__(self, world: World, y_m: float) -> None:
        self.now: FloatArray = np.zeros(world.n)
        self.change: FloatArray = np.zeros(world.n)
        aside, now = absolute(world.true_position[1] - y_m), source(self.now)
        super().__init__([Store(source(self.change), update=aside - now), Store(now, begin=aside, update=aside)])


class _Flag(StoredNumbers):
    """Whether something holds after a step.

    Attributes:
        flag: (n,) whether it does.
    """

    def __init__(self, n: int, holds: Number) -> None:
        self.flag: BoolArray = np.zeros(n, dtype=np.bool_)
        super().__init__([Store(source(self.flag), begin=constant(0.0), update=holds)])


class Below(_Flag):
    """Whether the torso is below a height.

    Attributes:
        flag: (n,) whether it is.
    """

    def __init__(self, world: World, height_m: float) -> None:
        super().__init__(world.n, world.true_position[2] < height_m)


class Beyond(_Flag):
    """Whether a value exceeds a limit, unless another flag is set.

    Args:
        value: (n,) values, measured before.
        limit: the limit.
        unless: (n,) flags, measured before.

    Attributes:
        flag: (n,) whether it does.
    """

    def __init__(self, value: FloatArray, limit: float, unless: BoolArray) -> None:
        super().__init__(len(value), (source(value) > limit) & ~source(unless))
