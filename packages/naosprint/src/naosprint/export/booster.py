"""Data for agents on rcssservermj besides the policy: motor gains and start."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from naosim.robots.booster import FAMILY

from naosprint.tasks import rolling

if TYPE_CHECKING:
    from naosim.robots import Robot
    from naosim.robots.booster import BoosterParameters
    from naospec import SimulatorSettings

    from naosprint.arrays import AnyArray
    from naosprint.tasks.kick_settings import KickSettings

__all__ = ["FAMILY", "arrays", "controller", "kick_arrays"]


def _gains(robot: Robot) -> list[tuple[float, float]]:
    """Return kp in N m/rad and kd in N m s/rad of every joint."""
    parameters: BoosterParameters = robot.parameters  # type: ignore[assignment]
    return [parameters.gains(name) for name in robot.joint_names]


def controller(robot: Robot) -> dict[str, dict[str, float]]:
    """Return the controller in the robot's motors: torque = kp times (target - angle) - kd times speed."""
    stiffness, damping = zip(*_gains(robot), strict=True)
    return {
        "kp_nm_per_rad": dict(zip(robot.joint_names, stiffness, strict=True)),
        "kd_nms_per_rad": dict(zip(robot.joint_names, damping, strict=True)),
    }


def arrays(robot: Robot, simulator: SimulatorSettings) -> dict[str, AnyArray]:
    """Return the arrays that only Booster robots have.

    ``camera_m`` has the places of head yaw, head pitch and camera, each in the frame before it.

    ``kp`` and ``kd`` have a row per joint. ``settling_cycles`` is the number of cycles for which a robot holds the
    start pose after a beam.
    """
    kp, kd = zip(*_gains(robot), strict=True)
    return {
        "model": np.array(robot.data["model"]),
        "kp": np.array(kp),
        "kd": np.array(kd),
        "settling_cycles": np.array(simulator.model_dump()["settle_steps"]),
        **({} if (camera := robot.camera) is None else {"camera_m": np.array([*vars(camera).values()])}),
    }


def kick_arrays(task: KickSettings) -> dict[str, AnyArray]:
    """Return how to launch a ball so that it stops at a point, and when the walker takes over."""
    names = ("launch_distances_m", "launch_directions", "launch_speeds", "launch_aims")
    launches = dict(zip(names, rolling.launches(), strict=True))
    return {**launches, "power_aims": rolling.power_aims(), "takeover_steps": np.array(task.takeover_steps)}
