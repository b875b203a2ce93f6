"""Random numbers without generator state, so that a robot's draws do not depend on the other robots."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from naosprint.arrays import FloatArray, IntArray


def hashed(seed: int, *keys: IntArray) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
    """Return one 64-bit hash for each row of the keys (the finalizer of splitmix64).

    Args:
        seed: any seed.
        keys: one to three arrays of (k,) integers.
    """
    factors = (0xD1B54A32D192ED03, 0x8CB92BA72F3D8DD7, 0xAEF17502108EF2D9)
    key: np.ndarray[tuple[int], np.dtype[np.uint64]] = np.full(
        len(keys[0]), seed * 0x9E3779B97F4A7C15 % 2**64, dtype=np.uint64
    )
    for values, factor in zip(keys, factors, strict=False):
        key += values.astype(np.uint64) * np.uint64(factor)
    key = (key ^ (key >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    key = (key ^ (key >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return key ^ (key >> np.uint64(31))


def uniform(seed: int, rows: IntArray, draws: IntArray, count: int) -> FloatArray:
    """Return (k, count) numbers from [0, 1), those of robot ``rows[i]`` in its ``draws[i]``-th draw."""
    columns = [hashed(seed, rows, draws, np.full(len(rows), column)) for column in range(count)]
    return np.stack(columns, axis=1).astype(np.float64) / 2.0**64
