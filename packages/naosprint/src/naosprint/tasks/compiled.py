"""Compiled forms of observation blocks, measurements and reward terms.

A task's step runs compiled, on the simulator's threads, where every part of it has a compiled form, and in Python
otherwise; the bits are the same. A part that is made of the project's own blocks and measurements has one; to add an
operation, see packages/naosprint/cpp/operations.cpp.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from naosprint import _compiled
    from naosprint.arrays import AnyArray


@dataclass(frozen=True)
class Operation:
    """Compiled form of a part of a task.

    Attributes:
        name: operation in packages/naosprint/cpp/operations.cpp.
        arrays: its arrays by name, one row per robot; the same ones as long as the environment exists.
        numbers: its constants by name.
        function: address of a function of another module, if it needs one.
    """

    name: str
    arrays: Mapping[str, AnyArray]
    numbers: Mapping[str, Sequence[float]] = field(default_factory=dict)
    function: int = 0

    def build(self) -> _compiled.Operation:
        """Return the object that computes it.

        Raises:
            ValueError: if there is no such operation, or an argument does not fit.
        """
        from naosprint import _compiled

        numbers = {name: [float(value) for value in values] for name, values in self.numbers.items()}
        return _compiled.Operation(self.name, dict(self.arrays), numbers, self.function)


def columns(
    source: AnyArray,
    index: Sequence[int] | None = None,
    *,
    factor: float = 1.0,
    signs: Sequence[float] | None = None,
    offset: float = 0.0,
    missing: bool = False,
) -> Operation:
    """Return an operation for columns of an array.

    Args:
        source: (n, width) or (n,) array.
        index: which columns; all by default.
        factor: factor of all values.
        signs: further factor of each chosen column.
        offset: subtracted after that.
        missing: whether NaN, which stands for a missing value, becomes 0.
    """
    chosen = range(source.size // len(source)) if index is None else index
    numbers: dict[str, Sequence[float]] = {
        "index": list(chosen),
        "sign": [1.0] * len(chosen) if signs is None else list(signs),
        "factor": [factor],
        "offset": [offset],
        "missing": [float(missing)],
    }
    return Operation("columns", {"source": source}, numbers)


def joint_angles(source: AnyArray, index: Sequence[int], signs: Sequence[float]) -> Operation:
    """Return an operation for angles or speeds of joints, in radians and the policy convention, from degrees."""
    return columns(source, index, factor=np.pi / 180.0, signs=signs)
