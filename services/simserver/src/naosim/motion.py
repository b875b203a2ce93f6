"""Open-loop motions for benchmarks: a robot on its feet that keeps moving."""

from __future__ import annotations

import numpy as np

from naosim.batch import Floats
from naosim.robots import RobotModel

GAIN = 7.0
"""Proportional gain from joint error (rad) to speed (rad/s)."""


def stepping_targets(model: RobotModel, cycle: int, n: int) -> Floats:
    """Return joint targets of a robot that steps on the spot with bent knees, shape (n, joints), rad.

    Each environment is at another phase, so a batch does not touch the ground in unison.
    """
    phase = 0.15 * cycle + 0.1 * np.arange(n)[:, None] + np.arange(len(model.joints))[None, :]
    targets = 0.12 * np.sin(phase)
    targets[:, :2] = 0.0
    for side in "lr":
        targets[:, model.joint_index[f"{side}lj3"]] += 0.5
        targets[:, model.joint_index[f"{side}lj4"]] -= 1.0
        targets[:, model.joint_index[f"{side}lj5"]] += 0.5
    return targets


def stepping_speeds(model: RobotModel, cycle: int, joint_angles_deg: Floats) -> Floats:
    """Return the speeds that follow `stepping_targets`, shape (n, joints), rad/s."""
    error = stepping_targets(model, cycle, len(joint_angles_deg)) - np.deg2rad(joint_angles_deg)
    return np.clip(GAIN * error, -model.max_speed, model.max_speed)
