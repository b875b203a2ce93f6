"""The restricted vision of many robots: goal posts and flags, every third cycle, with the noise of the server."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from naosim.simspark import protocol
from naosim.simspark.kinematics import rotations

if TYPE_CHECKING:
    from naosim.simulator import Floats, Ints

HALF_CONE_DEG = 60.0
"""Angle from straight ahead, in both directions, at which a landmark is still seen."""

DISTANCE_SPREAD = 0.000965
"""Standard deviation of a distance, as a share of it."""

ANGLE_SPREADS_DEG = (0.1480, 0.1225)
"""Standard deviations of theta and phi, degrees."""

OFFSET_M = 0.005
"""Largest fixed error of a run along each axis of the head, metres."""

_POSITIONS = np.array([position for _, position in protocol.LANDMARKS])
_DRAWS = 32
"""Normal numbers that a robot may draw in a cycle: three for each landmark, and three for the fixed error."""

_OFFSET_DRAW = 3 * len(protocol.LANDMARKS)

_SEED = np.uint64(0x9E3779B97F4A7C15)


class LandmarkVision:
    """What n robots see of the field.

    The noise is a function of robot, run and cycle, so that it is the same after a return to a snapshot.

    Args:
        n: number of robots.
        digits: decimals of what is seen; None for all.

    Attributes:
        seen: (n, 24) distance in metres, theta and phi in degrees of each of ``protocol.LANDMARKS`` in the head's
            frame; NaN where the latest cycle shows none.
        counters: (n, 2) cycles and runs of each robot.
    """

    def __init__(self, n: int, digits: int | None) -> None:
        self.seen: Floats = np.full((n, 3 * len(_POSITIONS)), np.nan)
        self.counters: Ints = np.zeros((n, 2), dtype=np.int64)
        # robots of servers that were started at different times do not see in the same cycle
        self.counters[:, 0] = np.arange(n) % protocol.VISION_INTERVAL
        self._streams = np.arange(n)
        self._digits = digits

    def draw_by_episode(self, rows: Ints, episodes: Ints) -> None:
        """Take the noise of robots from these episodes; their next run is the episode's first."""
        self._streams[rows] = episodes
        self.counters[rows, 0] = episodes % protocol.VISION_INTERVAL
        self.counters[rows, 1] = 0

    def begin(self, rows: Ints) -> None:
        """Begin a run of the robots ``rows``: nothing is seen yet."""
        self.seen[rows] = np.nan
        self.counters[rows, 1] += 1

    def due(self, rows: Ints) -> Ints:
        """Begin a cycle of the robots ``rows`` and return those that see something in it."""
        self.seen[rows] = np.nan
        self.counters[rows, 0] += 1
        due: Ints = rows[self.counters[rows, 0] % protocol.VISION_INTERVAL == 0]
        return due

    def see(self, rows: Ints, heads: Floats) -> None:
        """Show the robots ``rows`` the landmarks.

        Args:
            rows: (k,) robots.
            heads: (k, 7) poses of their heads: position in metres and quaternion w, x, y, z, world frame.
        """
        k = len(rows)
        streams = self._streams[rows]
        cycles = self._normal(streams, self.counters[rows, 0], _OFFSET_DRAW).reshape(k, len(_POSITIONS), 3)
        offsets = self._uniform(streams, -1 - self.counters[rows, 1], 3)
        relative = np.einsum("lki,kij->klj", _POSITIONS[:, None] - heads[:, :3], rotations(heads[:, 3:7]))
        relative += (OFFSET_M * (2.0 * offsets - 1.0))[:, None]
        x, y, z = np.moveaxis(relative, -1, 0)
        polar = np.stack(
            [
                np.sqrt(x * x + y * y + z * z),
                np.rad2deg(np.arctan2(-x, y)),  # 0 straight ahead, positive to the left
                np.rad2deg(np.arctan2(z, np.hypot(x, y))),
            ],
            axis=-1,
        )
        hidden = (np.abs(polar[..., 1:]) > HALF_CONE_DEG).any(axis=-1)
        polar[..., 0] *= 1.0 + DISTANCE_SPREAD * cycles[..., 0]
        polar[..., 1:] += ANGLE_SPREADS_DEG * cycles[..., 1:]
        if self._digits is not None:
            polar = np.round(polar, self._digits)
        polar[hidden] = np.nan
        self.seen[rows] = polar.reshape(k, -1)

    def _uniform(self, rows: Ints, counts: Ints, draws: int) -> Floats:
        """Return (k, draws) numbers from 0 to 1, never 0, by SplitMix64 (Steele, Lea and Flood, 2014)."""
        with np.errstate(over="ignore"):
            keys = (rows.astype(np.uint64) << np.uint64(40)) ^ counts.astype(np.uint64)
            keys = _mixed(keys * np.uint64(_DRAWS * 2 + 1) + _SEED)[:, None] + np.arange(draws, dtype=np.uint64) * _SEED
            drawn = _mixed(keys) >> np.uint64(11)
        return np.asarray((drawn.astype(np.float64) + 0.5) * 2.0**-53)

    def _normal(self, rows: Ints, counts: Ints, draws: int) -> Floats:
        """Return (k, draws) standard normal numbers (Box and Muller, 1958)."""
        uniform = self._uniform(rows, counts, 2 * draws)
        return np.asarray(np.sqrt(-2.0 * np.log(uniform[:, :draws])) * np.cos(2.0 * np.pi * uniform[:, draws:]))


def _mixed(keys: NDArray[np.uint64]) -> NDArray[np.uint64]:
    keys = (keys ^ (keys >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    keys = (keys ^ (keys >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return keys ^ (keys >> np.uint64(31))
