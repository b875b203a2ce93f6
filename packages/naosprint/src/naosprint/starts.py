"""Draw start poses, and choose one for each episode."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from naosim.simspark import BatchSimulator

    from naosprint.actuation import Actuation
    from naosprint.arrays import FloatArray, IntArray

RUNNING_YAW_DEG = -90.0
"""Yaw of a torso that faces +x: the front of the robot is its +y."""

DROP_M = 0.015
"""Height above standing from which a robot is put down at the start, metres."""

SETTLING_CYCLES = 60
"""Cycles that the start pose is held before the first observation."""

_STREAM = 0x57A27  # keeps the draws apart from every other use of the same seed


def draw_start_poses(actuation: Actuation, count: int, noise_deg: float, seed: int) -> FloatArray:
    """Draw ``count`` start poses around the standard one.

    Every joint that a policy moves is offset by an angle drawn uniformly from [-noise_deg, noise_deg]; the neck is not.
    Without noise there is only one start pose, and only one is returned.

    Returns:
        (count, J) target angles in radians; (1, J) without noise.
    """
    pose = actuation.start_pose()
    if noise_deg == 0.0:
        return pose[None].copy()
    poses = np.repeat(pose[None], count, axis=0)
    rng = np.random.default_rng([_STREAM, seed])
    offsets = rng.uniform(-noise_deg, noise_deg, (count, actuation.n_actions))
    poses[:, actuation.index] += np.deg2rad(offsets)
    return poses


def choose_starts(seed: int, count: int, environments: IntArray, episodes: IntArray) -> IntArray:
    """Choose a start for each of some environments, each in its so-many-th episode.

    The choice is a hash of seed, environment and episode (the finaliser of splitmix64), so there is no generator state
    to keep and an environment's starts do not depend on when the others fall.

    Args:
        seed: any seed.
        count: number of starts to choose from.
        environments: (k,) indices of the environments.
        episodes: (k,) number of each environment's episode.

    Returns:
        (k,) indices in [0, count).
    """
    with np.errstate(over="ignore"):
        key = np.full(len(environments), seed, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        key = key + environments.astype(np.uint64) * np.uint64(0xD1B54A32D192ED03)
        key = key + episodes.astype(np.uint64) * np.uint64(0x8CB92BA72F3D8DD7)
        key = (key ^ (key >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        key = (key ^ (key >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        key = key ^ (key >> np.uint64(31))
    return (key % np.uint64(count)).astype(np.int64)


def settle(
    engine: BatchSimulator, actuation: Actuation, poses_rad: FloatArray, position: tuple[float, float, float]
) -> None:
    """Put every robot of ``engine`` at ``position`` facing +x and drive it into its (n, J) pose for 60 cycles."""
    engine.reset()
    engine.beam(np.array(position), RUNNING_YAW_DEG)
    for _ in range(SETTLING_CYCLES):
        engine.step(actuation.speeds(poses_rad, engine.perceptors.joint_angles))
