"""Descriptions of robots.

A robot is plain data. Angles are in radians. A policy sees and sets joint angles in the *policy convention*, in which
the same number on the left and on the right is a symmetric posture: policy angle = ``sign`` x simulator angle.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
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

_SAME_RAD = 1e-6
"""Difference of two angles up to which they are the same: descriptions round."""


class FilledIn(Mapping[str, float]):
    """Angles by joint in which a robot's settings have filled in what its description leaves open.

    Other settings start from ``described`` again, so that they never take the earlier ones' angles for the robot's own.

    Attributes:
        described: the description's own angles; None if it has none.
    """

    def __init__(self, described: Mapping[str, float] | None, settings: Mapping[str, float]) -> None:
        self.described = described
        self._angles = {**(described or {}), **settings}

    def __getitem__(self, joint: str) -> float:
        return self._angles[joint]

    def __iter__(self) -> Iterator[str]:
        return iter(self._angles)

    def __len__(self) -> int:
        return len(self._angles)

    def __or__(self, other: Mapping[str, float]) -> dict[str, float]:
        return {**self, **other}

    def __repr__(self) -> str:
        return repr(self._angles)


def described(angles: Mapping[str, float] | None) -> Mapping[str, float] | None:
    """Return the angles by joint that a description has itself, without those that settings have filled in."""
    return angles.described if isinstance(angles, FilledIn) else angles


class RobotParameters(Section):
    """Base of a robot's settings, for example motor gains; they are part of a training's specification."""

    def applied(self, robot: Robot) -> Robot:
        """Return the robot with those fields that these settings determine; by default none.

        Raises:
            ValueError: if they do not fit the robot's description.
        """
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
        action_range_rad: angle between nominal and target for an action of 1, of every joint that a policy moves; None
            if actions span the joint's whole range.
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

    def __post_init__(self) -> None:
        """Check that joints, pose and ranges belong together.

        Raises:
            ValueError: naming robot, field and what to write.
        """
        for problem in _problems(self):
            raise ValueError(f"robot {self.name}: {problem}")

    def with_parameters(self, values: Mapping[str, object]) -> Robot:
        """Return this robot with other parameters.

        Raises:
            pydantic.ValidationError: if a value is out of range or unknown.
            ValueError: if the parameters do not fit the robot's description.
        """
        parameters = type(self.parameters).model_validate(dict(values), context={"robot": self.name})
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
        found = self.load_shapes()
        if not isinstance(found, tuple) or not all(isinstance(each, Shape) for each in found):
            raise ValueError(f"robot {self.name}: load_shapes: expected a tuple of Shape, got {found!r:.100}")
        return found

    @cached_property
    def nominal(self) -> Floats:
        """(J,) nominal pose in radians, simulator signs."""
        return np.array([self.nominal_rad.get(joint.name, 0.0) for joint in self.joints])


def _problems(robot: Robot) -> Iterator[str]:
    """Yield what is wrong with a robot's joints, and with what refers to them; later checks rely on earlier ones."""
    joints = {joint.name: joint for joint in robot.joints}
    stated: dict[str, object] = {"nominal_rad": robot.nominal_rad, "action_range_rad": robot.action_range_rad or {}}
    for field, given in stated.items():
        if not isinstance(given, Mapping):
            yield f"{field}: {given!r:.60} names no joint; write an angle for each by name"
    ranges = described(robot.action_range_rad)  # settings fill in the others again, for the joints that there are now
    if len(joints) != len(robot.joints):
        name = next(name for name in joints if robot.joint_names.count(name) > 1)
        yield f"joints: {name!r} is there twice; every joint needs a name of its own"
    if not any(joint.actuated for joint in robot.joints):
        yield "joints: none is actuated; a policy needs one at least that it moves"
    shapes: object = robot.load_shapes
    if not callable(shapes):
        yield f"load_shapes: {shapes!r:.60} is no function; write one that returns a tuple of Shape"
    if not 0.0 < robot.standing_height_m < math.inf:
        yield f"standing_height_m: {robot.standing_height_m:g} is no height; write the torso's, in metres"
    if robot.front_axis not in (0, 1, 2):
        yield f"front_axis: {robot.front_axis} is no column of a rotation; write 0, 1 or 2"
    names = ", ".join(joints)
    for joint in robot.joints:
        open_ended = joint.actuated and robot.action_range_rad is None and math.isinf(joint.high_rad - joint.low_rad)
        if open_ended or math.isnan(joint.low_rad) or math.isnan(joint.high_rad):
            yield (
                f"joints: {joint.name}: its range is {joint.low_rad:g} to {joint.high_rad:g}; write numbers, or state "
                "action_range_rad for a joint without limits"
            )
        yield from _problems_of_sides(joint, joints.get(joint.mirror), names)
    for field, angles in (("nominal_rad", robot.nominal_rad), ("action_range_rad", ranges or {})):
        for name in angles:
            if name not in joints:
                yield f"{field}: there is no joint {name!r}; its joints are {names}"
    for name, angle in robot.nominal_rad.items():
        low, high = sorted((joints[name].low_rad, joints[name].high_rad))
        if not low - _SAME_RAD <= angle <= high + _SAME_RAD:
            yield f"nominal_rad: {name}: {angle:g} is not from {low:g} to {high:g}, the joint's range in radians"
    for name, angle in (ranges or {}).items():
        if not 0.0 < angle < math.inf:
            yield f"action_range_rad: {name}: {angle:g} is no angle that an action can reach; write one above 0"
    for joint in robot.joints:
        if ranges is not None and joint.actuated and joint.name not in ranges:
            yield f"action_range_rad: {joint.name} is missing; state every joint that is actuated, or None for all"
    for perceptor in robot.perceptors:
        if perceptor.name in ("joint_angles", "joint_speeds") and perceptor.width != len(robot.joints):
            yield (
                f"perceptors: {perceptor.name} has {perceptor.width} numbers for {len(robot.joints)} joints; keep all "
                "joints of the simulator, and hold one still with actuated=False"
            )
    if robot.camera is not None:
        for name in ("head_yaw", "head_pitch"):
            if name not in joints:
                yield f"camera: it turns with the joint {name!r}, which is missing; add it, or set camera=None"
    for joint in robot.joints:
        if joint.actuated:
            yield from _problems_of_actions(robot, joint, joints[joint.mirror])


def _problems_of_sides(joint: JointDescription, partner: JointDescription | None, names: str) -> Iterator[str]:
    """Yield what is wrong with a joint's signs, and with the joint on the other side."""
    for field in ("sign", "mirror_sign"):
        if getattr(joint, field) not in (-1.0, 1.0):
            yield f"joints: {joint.name}: {field} must be 1 or -1, not {getattr(joint, field):g}"
    if partner is None:
        yield f"joints: {joint.name}: mirror: there is no joint {joint.mirror!r}; its joints are {names}"
    elif partner.mirror != joint.name:
        yield (
            f"joints: {joint.name}: its mirror is {partner.name}, whose mirror is {partner.mirror}; the two have to "
            "name each other"
        )
    elif (joint.side == partner.side) != (partner is joint) or (joint.side == "centre") != (partner is joint):
        yield (
            f"joints: {joint.name}: its side is {joint.side}, that of its mirror {partner.name} {partner.side}; a "
            "joint in the centre is its own mirror, others have one on the other side"
        )
    else:
        for field in ("mirror_sign", "actuated"):
            if getattr(joint, field) != getattr(partner, field):
                yield f"joints: {joint.name} and {partner.name}: {field} differs; write the same for both"


def _problems_of_actions(robot: Robot, joint: JointDescription, partner: JointDescription) -> Iterator[str]:
    """Yield why the same action on both sides, or its mirror image in the centre, is no mirrored posture."""
    both = joint.name if partner is joint else f"{joint.name} and {partner.name}"
    ends = sorted(joint.sign * end for end in (joint.low_rad, joint.high_rad))
    mirrored = sorted(joint.mirror_sign * partner.sign * end for end in (partner.low_rad, partner.high_rad))
    if max(abs(end - other) for end, other in zip(ends, mirrored, strict=True)) > _SAME_RAD:
        there = f"{ends[0]:g} to {ends[1]:g} is {mirrored[0]:g} to {mirrored[1]:g} in a mirror"
        yield (
            f"joints: {both}: mirrored actions are no mirrored posture: with their signs, {there}; change sign, "
            "mirror_sign, low_rad or high_rad"
        )
    if robot.action_range_rad is None:
        return  # the pose that episodes start from is not what actions are counted from
    ranges = described(robot.action_range_rad)
    if ranges is not None and abs(ranges[joint.name] - ranges[partner.name]) > _SAME_RAD:
        yield f"action_range_rad: {both}: mirrored actions are no mirrored posture; write the same for both"
    angle, other = (robot.nominal_rad.get(each.name, 0.0) * each.sign for each in (joint, partner))
    if abs(angle - joint.mirror_sign * other) > _SAME_RAD:
        yield (
            f"nominal_rad: {both}: mirrored actions are no mirrored posture: with their signs, {angle:g} is "
            f"{joint.mirror_sign * other:g} in a mirror; write a symmetric pose"
        )
