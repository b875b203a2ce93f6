"""Start poses, and which of them an episode begins with."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from naosprint.terms.randomness import hashed

if TYPE_CHECKING:
    from naosim.robots.actuation import Actuation

    from naosprint.arrays import FloatArray, IntArray

_STREAM = 0x57A27  # keeps the draws apart from every other use of the same seed


def draw_start_poses(actuation: Actuation, count: int, noise_deg: float, seed: int) -> FloatArray:
    """Draw ``count`` start poses around the nominal one.

    Every joint that a policy moves is offset by an angle drawn uniformly from [-noise_deg, noise_deg]. Without noise
    there is only one start pose, and only one is returned.

    Returns:
        (count, J) target angles in radians, simulator order and signs; (1, J) without noise.
    """
    pose = actuation.robot.nominal
    if noise_deg == 0.0:
        return pose[None].copy()
    poses = np.repeat(pose[None], count, axis=0)
    rng = np.random.default_rng([_STREAM, seed])
    offsets = rng.uniform(-noise_deg, noise_deg, (count, actuation.n_actions))
    poses[:, actuation.index] += np.deg2rad(offsets)
    return poses


def choose_starts(seed: int, count: int, environments: IntArray, episodes: IntArray) -> IntArray:
    """Choose a start for each of some environments.

    The choice is a hash of seed, environment and episode number, so there is no generator state to keep, and an
    environment's starts do not depend on when the others fall.

    Args:
        seed: any seed.
        count: number of starts to choose from.
        environments: (k,) indices of the environments.
        episodes: (k,) number of each environment's episode.

    Returns:
        (k,) indices in [0, count).
    """
    return (hashed(seed, environments, episodes) % np.uint64(count)).astype(np.int64)
