"""Random numbers without generator state, so that a robot's draws do not depend on the other robots."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from naosprint import _compiled

if TYPE_CHECKING:
    from naosprint.arrays import BoolArray, Float32Array, FloatArray, IntArray


def hashed(seed: int, *keys: IntArray) -> np.ndarray[tuple[int, ...], np.dtype[np.uint64]]:
    """Return one 64-bit hash for each element of the keys (the finalizer of splitmix64).

    Args:
        seed: any seed.
        keys: one to three arrays of integers, of shapes that broadcast.
    """
    factors = (0xD1B54A32D192ED03, 0x8CB92BA72F3D8DD7, 0xAEF17502108EF2D9)
    key = np.array(seed * 0x9E3779B97F4A7C15 % 2**64, dtype=np.uint64)
    for values, factor in zip(keys, factors, strict=False):
        key = key + values.astype(np.uint64) * np.uint64(factor)
    key = (key ^ (key >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    key = (key ^ (key >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return key ^ (key >> np.uint64(31))


def uniform(seed: int, rows: IntArray, draws: IntArray, count: int) -> FloatArray:
    """Return (k, count) numbers from [0, 1), those of stream ``rows[i]`` in its ``draws[i]``-th draw.

    The stream is the number of the robot in a training, and of the episode in an evaluation: see ``World.streams``.
    """
    return hashed(seed, rows[:, None], draws[:, None], np.arange(count)).astype(np.float64) / 2.0**64


def normal(seed: int, streams: IntArray, draws: IntArray, count: int) -> FloatArray:
    """Return (k, count) normally distributed numbers, those of stream ``streams[i]`` in its ``draws[i]``-th draw.

    Each is the sum of twelve uniform numbers, so that it has the same bits on every processor and is at most 6.
    """
    numbers: FloatArray = np.empty((len(streams), count))
    _compiled.normal(seed % 2**64, streams, draws, numbers)
    return numbers


def add_normal(
    values: FloatArray, deviations: FloatArray, where: BoolArray, seed: int, streams: IntArray, draws: IntArray
) -> None:
    """Add what :func:`normal` returns to some rows of (k, W) values, in place.

    Args:
        values: contiguous, and changed.
        deviations: (k,) standard deviations.
        where: (k,) rows that are changed.
        seed: any seed.
        streams: (k,) as for :func:`normal`.
        draws: (k,) as for :func:`normal`.
    """
    _compiled.add_normal(values, deviations, where, seed % 2**64, streams, draws)


class Normals:
    """Normal numbers of an evaluation's exploration, by seed and episode: what a policy draws from.

    Args:
        seed: the evaluation's seed.
        streams: (n,) episode of each robot, which the caller updates.
        steps: (n,) steps of each robot's episode.
    """

    def __init__(self, seed: int, streams: IntArray, steps: IntArray) -> None:
        self._seed, self._streams, self._steps = seed, streams, steps

    def standard_normal(self, size: tuple[int, ...], dtype: type[np.float32] = np.float32) -> Float32Array:
        """Return (n, A) numbers, a row for each robot, for the present step."""
        return normal(self._seed, self._streams, self._steps, size[1]).astype(dtype)
