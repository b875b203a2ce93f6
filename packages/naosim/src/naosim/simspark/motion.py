"""Open-loop motions for benchmarks: a robot on its feet that keeps moving."""

from __future__ import annotations

import numpy as np

from naosim.robots.nao_model import RobotModel
from naosim.simspark.batch import Floats
from naosim.simspark.control import motor_speeds

_KNEES_BENT = (("lj3", 0.5), ("lj4", -1.0), ("lj5", 0.5))


def stepping_targets(model: RobotModel, cycle: int, n: int) -> Floats:
    """Return joint targets of a robot that shortens its legs in turn and swings its arms, shape (n, joints), rad.

    Each environment is at another phase, so that the robots do not all touch the ground at the same time.
    """
    swing = np.sin(0.5 * cycle + 0.7 * np.arange(n)) * min(1.0, cycle / 100)
    targets = np.zeros((n, len(model.joints)))
    for side, sign in (("l", 1.0), ("r", -1.0)):
        lift = np.maximum(0.0, sign * swing)
        for (name, bend), share in zip(_KNEES_BENT, (0.2, -0.4, 0.2), strict=True):
            targets[:, model.joint_index[side + name]] = bend * min(1.0, cycle / 50) + share * lift
        targets[:, model.joint_index[f"{side}aj1"]] = -1.2 + 0.4 * sign * swing
        targets[:, model.joint_index[f"{side}aj4"]] = -0.5 * sign + 0.2 * swing
    targets[:, model.joint_index["hj1"]] = 0.3 * swing
    return targets


def stepping_speeds(model: RobotModel, cycle: int, joint_angles_deg: Floats) -> Floats:
    """Return the speeds that follow `stepping_targets`, shape (n, joints), rad/s."""
    return motor_speeds(stepping_targets(model, cycle, len(joint_angles_deg)), joint_angles_deg, model.max_speed)
