"""Descriptions of robots.

A robot is plain data. Angles are in radians. A policy sees and sets joint angles in the *policy convention*, in which
the same number on the left and on the right is a symmetric posture: policy angle = ``sign`` x simulator angle.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np
from naospec.plugins import ROBOTS, Plugin
from naospec.sections import Section
from numpy.typing import NDArray

from naosim.fields import RCSSSERVER3D, Field

Floats = NDArray[np.float64]
Side = Literal["left", "right", "centre"]
ShapeKind = Literal["box", "sphere", "capsule", "cylinder"]


class RobotParameters(Section):
    """Base of a robot's settings, for example motor gains; they are part of a training's specification."""

    def applied(self, robot: Robot) -> Robot:
        """Return the robot with those fields that these settings determine; by default none."""
        return robot


@dataclass(frozen=True)
class JointDescription:
    """One joint, in the simulator's own signs.

    Attributes:
        name: its name in observations, actions and perceptors.
        effector: its name in commands of the network protocol.
        side: which side of the body it is on.
        mirror: the joint on the other side; itself if it is in the centre.
        mirror_sign: factor of the policy angle in a mirrored posture: 1 for joints with a partner; -1 for joints in the
            centre that turn about the vertical or the forward axis.
        sign: policy angle = sign x simulator angle.
        low_rad, high_rad: range of the simulator angle.
        max_speed: rad/s; infinite where the robot has no limit.
        max_torque: N m.
        actuated: whether a policy moves it; others are held at their nominal angle.
    """

    name: str
    effector: str
    side: Side
    mirror: str
    low_rad: float
    high_rad: float
    max_speed: float = float("inf")
    max_torque: float = float("inf")
    sign: float = 1.0
    mirror_sign: float = 1.0
    actuated: bool = True


@dataclass(frozen=True)
class Shape:
    """One rigid part as it is drawn.

    Attributes:
        name: name of the part.
        kind: box, sphere, capsule or cylinder (the latter two along their z axis).
        size_m: box: full lengths x, y, z. Sphere: radius, 0, 0. Capsule and cylinder: radius, length, 0.
        side: which side of the body it is on.
    """

    name: str
    kind: ShapeKind
    size_m: tuple[float, float, float]
    side: Side = "centre"


@dataclass(frozen=True)
class CameraMount:
    """Where the camera is: on a head that the joints ``head_yaw`` and ``head_pitch`` turn, in this order.

    Attributes:
        yaw_m: joint ``head_yaw``, torso's frame, metres.
        pitch_m: joint ``head_pitch``, frame of what the yaw turns.
        camera_m: the camera, frame of the head; it looks along x.
    """

    yaw_m: tuple[float, float, float]
    pitch_m: tuple[float, float, float]
    camera_m: tuple[float, float, float]


@dataclass(frozen=True)
class PerceptorDescription:
    """One perceptor: a named array of measurements.

    Attributes:
        name: key in ``Simulator.perceptors``.
        width: numbers in it.
        unit: their unit.
        description: frame and meaning.
    """

    name: str
    width: int
    unit: str
    description: str = ""


@dataclass(frozen=True)
class Robot(Plugin):
    """Description of one robot.

    Attributes:
        name: how specifications refer to it, for example ``nao-0`` or ``t1``.
        family: robots that share simulators, for example ``nao`` or ``booster``.
        title: name for users.
        joints: all joints, in the order of commands and joint perceptors.
        nominal_rad: simulator angle of each joint in the pose from which episodes start, by joint name; 0 if missing.
        standing_height_m: torso height with straight legs, soles on the ground.
        front_axis: column of the torso's rotation matrix that points to the robot's front.
        perceptors: what it perceives.
        action_range_rad: half the range of the target angle around nominal for an action of 1; None if actions span the
            joint's whole range.
        parameters: its settings.
        data: further data for simulators of its family, for example the number of a type.
        load_shapes: returns :attr:`shapes`; called on first use.
        field: its league's field.
        camera: where its camera is; None if it does not see the ball.
    """

    plugin_group: ClassVar[str] = ROBOTS
    name: str
    family: str
    title: str
    joints: tuple[JointDescription, ...]
    nominal_rad: Mapping[str, float]
    standing_height_m: float
    front_axis: int
    perceptors: tuple[PerceptorDescription, ...]
    action_range_rad: Mapping[str, float] | None = None
    parameters: RobotParameters = dataclasses.field(default_factory=RobotParameters)
    data: Mapping[str, Any] = dataclasses.field(default_factory=lambda: MappingProxyType({}))
    load_shapes: Callable[[], tuple[Shape, ...]] = dataclasses.field(default=tuple, repr=False, compare=False)
    field: Field = RCSSSERVER3D
    camera: CameraMount | None = None

    def with_parameters(self, values: Mapping[str, object]) -> Robot:
        """Return this robot with other parameters.

        Raises:
            pydantic.ValidationError: if a value is out of range or unknown.
        """
        parameters = type(self.parameters).model_validate(dict(values))
        return parameters.applied(replace(self, parameters=parameters))

    def describe(self) -> dict[str, object]:
        """Return a description of the robot for user interfaces, as a JSON object."""
        return {
            "name": self.name,
            "family": self.family,
            "title": self.title,
            "joints": list(self.joint_names),
            "standing_height_m": self.standing_height_m,
            "front_axis": self.front_axis,
            "field": {**dataclasses.asdict(self.field), "lines": self.field.lines()},
        }

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of all joints in order."""
        return tuple(joint.name for joint in self.joints)

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """The robot as it is drawn, in the order of ``Simulator.bodies()``; empty if it cannot be drawn."""
        return self.load_shapes()

    @cached_property
    def nominal(self) -> Floats:
        """(J,) nominal pose in radians, simulator signs."""
        return np.array([self.nominal_rad.get(joint.name, 0.0) for joint in self.joints])
