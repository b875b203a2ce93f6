"""The controller that drives a NAO's joints to target angles, and how a robot settles at a start."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from naosim.simspark.batch import BatchSimulator, Floats

GAIN = 7.0
"""Gain of the proportional controller in 1/s: speed = GAIN * (target - angle). Paper, section IV-B."""

DROP_M = 0.015
"""Height above standing from which a robot is dropped at a start, metres."""

SETTLING_CYCLES = 60
"""Cycles for which the pose of a start is held before it counts as settled."""


def motor_speeds(targets_rad: Floats, angles_deg: Floats, max_speed: Floats) -> Floats:
    """Return the proportional controller's joint speeds.

    Args:
        targets_rad: (n, J) target angles in radians.
        angles_deg: (n, J) perceived angles in degrees.
        max_speed: (J,) limits of the joints, rad/s.

    Returns:
        (n, J) speeds in rad/s within the limits.
    """
    wanted = GAIN * (targets_rad - np.deg2rad(angles_deg))
    return np.clip(wanted, -max_speed, max_speed)


def yaw_deg(heading_rad: float) -> float:
    """Return the server's yaw of a torso that faces ``heading_rad``: yaw 0 faces +y."""
    return float(np.rad2deg(heading_rad)) - 90.0


def settle(engine: BatchSimulator, poses_rad: Floats, position_m: tuple[float, float], heading_rad: float) -> None:
    """Move every robot of ``engine`` to a position and drive it into its (n, J) pose for :data:`SETTLING_CYCLES`."""
    engine.reset()
    engine.beam((*position_m, engine.model.standing_height + DROP_M), yaw_deg(heading_rad))
    for _ in range(SETTLING_CYCLES):
        engine.step(motor_speeds(poses_rad, engine.perceptors.joint_angles, engine.model.max_speed))
