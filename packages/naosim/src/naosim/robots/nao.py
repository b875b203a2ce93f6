"""The NAO robots of rcssserver3d, types 0 to 4, as descriptions; :mod:`naosim.robots.nao_model` has their bodies.

Policies see and set angles in the convention of the paper's code: pitch joints count as on the real NAO (hips forward
is negative, knees bent is positive) and the right side is mirrored, so that the same number on both sides is a
symmetric posture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from naosim.robots import nao_model
from naosim.robots.description import (
    JointDescription,
    PerceptorDescription,
    Robot,
    RobotParameters,
    Shape,
    Side,
)

FAMILY = "nao"

START_POSE_DEG: Mapping[str, float] = {"aj1": 90.0, "aj3": -90.0, "aj4": -90.0, "lj3": -30.0, "lj4": 60.0, "lj5": -30.0}
"""The nominal pose in degrees, in the policies' convention and without the side's letter; other joints are at 0."""

_SIDES: Mapping[str, Side] = {"l": "left", "r": "right"}
_REVERSED_PITCH = frozenset({"aj1", "lj3", "lj4", "lj5"})
_LATERAL = frozenset({"aj2", "aj3", "aj4", "lj2", "lj6"})
_FOOT = "centre of pressure (m) and force (N) in the foot's frame; NaN without contact"
_PERCEPTORS = (
    PerceptorDescription("gyro", 3, "deg/s", "angular velocity in the torso's frame"),
    PerceptorDescription("accel", 3, "m/s^2", "proper acceleration in the torso's frame, (0, 0, 9.81) at rest"),
    PerceptorDescription("foot_left", 6, "m, N", _FOOT),
    PerceptorDescription("foot_right", 6, "m, N", _FOOT),
)
_VISION = PerceptorDescription(
    "vision",
    24,
    "m, deg",
    "distance, theta and phi of the four goal posts and four flags in the head's frame; NaN for those not in sight, "
    "and in two of three steps",
)


class NaoParameters(RobotParameters):
    """Settings of a NAO."""

    onboard_sensing: bool = Field(
        default=False,
        title="Onboard sensing",
        description="Whether policies observe only what a player perceives: the torso's yaw and height are estimated "
        "from gyroscope, accelerometer, joint angles, foot contacts and vision.",
    )
    ground_velocity: bool = Field(
        default=False,
        title="Ground velocity",
        description="Whether policies also observe the torso's forward and lateral velocity on the field, from the "
        "differences of its true positions.",
    )

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.onboard_sensing and self.ground_velocity:
            raise ValueError("ground_velocity: a robot with onboard_sensing does not perceive it; set one of the two")
        return self

    def applied(self, robot: Robot) -> Robot:
        """Return the robot with its perceptors: an onboard robot has vision."""
        perceptors = tuple(each for each in robot.perceptors if each != _VISION)
        return replace(robot, perceptors=(*perceptors, _VISION) if self.onboard_sensing else perceptors)


def _side(name: str) -> Side:
    return _SIDES.get(name[0], "centre")


def _joint(joint: nao_model.Joint) -> JointDescription:
    side, kind = _side(joint.name), joint.name[1:]
    low, high = (float(np.deg2rad(limit)) for limit in (joint.low_deg, joint.high_deg))
    turned = side == "right" and kind in _LATERAL
    return JointDescription(
        name=joint.name,
        effector=joint.effector,
        side=side,
        mirror=joint.name if side == "centre" else {"l": "r", "r": "l"}[joint.name[0]] + kind,
        low_rad=low,
        high_rad=high,
        max_speed=joint.max_speed,
        max_torque=nao_model.MOTOR_TORQUE,
        sign=-1.0 if turned or (side != "centre" and kind in _REVERSED_PITCH) else 1.0,
        mirror_sign=-1.0 if side == "centre" and joint.axis[2] else 1.0,  # the neck's yaw
        actuated=side != "centre",
    )


def _shapes(robot_type: int) -> tuple[Shape, ...]:
    bodies = nao_model.model(robot_type).bodies
    return tuple(
        Shape(body.name, body.shape.kind, body.shape.size, _side(body.limb) if body.limb else "centre")
        for body in bodies
    )


def _robot(robot_type: int) -> Robot:
    model = nao_model.model(robot_type)
    joints = tuple(_joint(joint) for joint in model.joints)
    angles = {j.name: j.sign * float(np.deg2rad(START_POSE_DEG.get(j.name[1:], 0.0))) for j in joints if j.actuated}
    return Robot(
        name=f"{FAMILY}-{robot_type}",
        family=FAMILY,
        title=f"NAO type {robot_type}: {model.title}",
        joints=joints,
        nominal_rad={name: angle for name, angle in angles.items() if angle},
        standing_height_m=model.standing_height,
        front_axis=1,
        perceptors=(PerceptorDescription("joint_angles", len(joints), "deg", "in joint order"), *_PERCEPTORS),
        parameters=NaoParameters(),
        data={"robot_type": robot_type},
        load_shapes=lambda: _shapes(robot_type),
    )


NAO_0, NAO_1, NAO_2, NAO_3, NAO_4 = (_robot(robot_type) for robot_type in nao_model.ROBOT_TYPES)


def model_of(robot: Robot) -> nao_model.RobotModel:
    """Return the bodies, joints and geometry of a NAO.

    Raises:
        ValueError: if the robot is not a NAO.
    """
    if robot.family != FAMILY:
        raise ValueError(f"{robot.name}: expected a robot of family {FAMILY!r}, got {robot.family!r}")
    return nao_model.model(robot.data["robot_type"])
