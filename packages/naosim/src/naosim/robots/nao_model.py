"""The five NAO robot types of rcssserver3d as data: bodies, joints, limits, speeds, masses, geometry and names.

Everything else (engine, observations, protocol, drawings) reads these tables. Frames are axis-parallel at angles 0:
x to the robot's right, y to its front, z up; lengths in metres, masses in kilograms, speeds in radians per second.

Source: rcssserver3d 0.7's robot description and its table of heterogeneous types.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]

MAX_JOINT_SPEED = 3.14159265 * 351.77 / 180.0
"""Speed limit of every joint but the heterogeneous ankles, rad/s."""

MOTOR_TORQUE = 10.0
"""Largest torque of every joint motor, N m."""

CYCLE_S = 0.02
"""Simulated time of one server cycle, s."""


@dataclass(frozen=True)
class BodyShape:
    """Geometry of a body; `collides` is whether it can touch the ground."""

    kind: Literal["box", "sphere", "capsule"]
    """A capsule lies along z."""
    size: Vector
    """Box: full lengths. Sphere: (radius, 0, 0). Capsule: (radius, length of the cylinder, 0)."""
    collides: bool = True


@dataclass(frozen=True)
class Joint:
    """Hinge: `body` turns about `axis` relative to `parent`."""

    name: str
    """Perceptor name, e.g. `llj3`."""
    effector: str
    """Effector name, e.g. `lle3`."""
    body: str
    parent: str
    anchor: Vector
    """Anchor in the body's own frame."""
    axis: Vector
    """Unit axis in the body's own frame."""
    low_deg: float
    high_deg: float
    max_speed: float
    """rad/s."""


@dataclass(frozen=True)
class Body:
    """Rigid part."""

    name: str
    mass: float
    shape: BodyShape
    offset: Vector
    """Centre relative to the torso's centre at angles 0."""
    limb: str | None = None
    """`rarm`, `larm`, `rleg`, `lleg`: the effectors that the self-collision rule freezes together."""

    @property
    def inertia(self) -> Vector:
        """Return the principal moments of inertia of a solid of this shape, kg m^2."""
        m, (a, b, c) = self.mass, self.shape.size
        if self.shape.kind == "box":
            return (m / 12 * (b * b + c * c), m / 12 * (a * a + c * c), m / 12 * (a * a + b * b))
        if self.shape.kind == "sphere":
            return (0.4 * m * a * a,) * 3
        cylinder, caps = math.pi * a * a * b, 4 / 3 * math.pi * a**3
        m1, m2 = m * cylinder / (cylinder + caps), m * caps / (cylinder + caps)
        across = m1 * (a * a / 4 + b * b / 12) + m2 * (0.4 * a * a + 0.375 * a * b + 0.25 * b * b)
        return (across, across, (m1 * 0.5 + m2 * 0.4) * a * a)


@dataclass(frozen=True)
class RobotModel:
    """Bodies, joints and sensors of one robot type."""

    robot_type: int
    title: str
    bodies: tuple[Body, ...]
    """Torso first, parents before children."""
    joints: tuple[Joint, ...]
    """In the order of commands and joint perceptors."""
    collision_pairs: tuple[tuple[str, str], ...]
    """Box pairs that the self-collision rule checks."""
    touch_sensors: tuple[tuple[str, str], ...]
    """Force resistance perceptors: (name, body)."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Return the perceptor names in joint order."""
        return tuple(joint.name for joint in self.joints)

    @property
    def joint_index(self) -> dict[str, int]:
        """Return the position of each joint by perceptor name."""
        return {joint.name: k for k, joint in enumerate(self.joints)}

    @property
    def body_names(self) -> tuple[str, ...]:
        """Return the body names in state order."""
        return tuple(body.name for body in self.bodies)

    @property
    def body_index(self) -> dict[str, int]:
        """Return the position of each body by name."""
        return {body.name: k for k, body in enumerate(self.bodies)}

    @property
    def low_deg(self) -> NDArray[np.float64]:
        """Return the joints' lower stops, shape (joints,), degrees."""
        return np.array([joint.low_deg for joint in self.joints])

    @property
    def high_deg(self) -> NDArray[np.float64]:
        """Return the joints' upper stops, shape (joints,), degrees."""
        return np.array([joint.high_deg for joint in self.joints])

    @property
    def max_speed(self) -> NDArray[np.float64]:
        """Return the joints' speed limits, shape (joints,), rad/s."""
        return np.array([joint.max_speed for joint in self.joints])

    @property
    def mass(self) -> float:
        """Return the total mass, kg."""
        return sum(body.mass for body in self.bodies)

    @property
    def standing_height(self) -> float:
        """Return the height of the torso's centre over the soles at angles 0, m."""
        return max(body.shape.size[2] / 2 - body.offset[2] for body in self.bodies if body.name.endswith("foot"))


@dataclass(frozen=True)
class _Variant:
    title: str
    hip_x: float = 0.055
    thigh_z: float = -0.04
    ankle_z: float = -0.055
    elbow_y: float = 0.07
    ankle_pitch_speed: float = MAX_JOINT_SPEED
    ankle_roll_speed: float = MAX_JOINT_SPEED
    toe_length: float = 0.0


_VARIANTS = (
    _Variant("standard"),
    _Variant("longer legs and arms", thigh_z=-0.05832, ankle_z=-0.07332, elbow_y=0.10664),
    _Variant("fast ankle pitch, slow ankle roll", ankle_pitch_speed=8.80667, ankle_roll_speed=3.47234),
    _Variant(
        "longest legs and arms, wider hip",
        hip_x=0.072954143,
        thigh_z=-0.067868424,
        ankle_z=-0.082868424,
        elbow_y=0.125736848,
    ),
    _Variant("toes", toe_length=0.035517656),
)

ROBOT_TYPES = tuple(range(len(_VARIANTS)))
"""The known robot types."""


def _box(x: float, y: float, z: float) -> BodyShape:
    return BodyShape("box", (x, y, z))


def _bead(radius: float = 0.01) -> BodyShape:
    return BodyShape("sphere", (radius, 0.0, 0.0), collides=False)


def _plus(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def _decimal(value: float) -> float:
    """Round as the server's scene language rounds every result: six significant digits of single precision."""
    return float(f"{np.float32(value):.6g}")


def _build(robot_type: int) -> RobotModel:
    variant = _VARIANTS[robot_type]
    bodies: list[Body] = []
    joints: dict[str, Joint] = {}
    offsets: dict[str, Vector] = {}

    def body(name: str, mass: float, shape: BodyShape, offset: Vector, limb: str | None = None) -> None:
        bodies.append(Body(name, mass, shape, offset, limb))
        offsets[name] = offset

    def hinge(
        name: str,
        effector: str,
        own: str,
        parent: str,
        anchor: Vector,
        axis: Vector,
        limits: tuple[float, float],
        speed: float = MAX_JOINT_SPEED,
    ) -> None:
        length = math.sqrt(sum(c * c for c in axis))
        unit = (axis[0] / length, axis[1] / length, axis[2] / length)
        joints[name] = Joint(name, effector, own, parent, anchor, unit, *limits, speed)

    body("torso", 1.2171, _box(0.1, 0.1, 0.18), (0.0, 0.0, 0.0))
    body("neck", 0.05, BodyShape("capsule", (0.015, 0.08, 0.0)), (0.0, 0.0, 0.09))
    body("head", 0.35, BodyShape("sphere", (0.065, 0.0, 0.0)), (0.0, 0.0, 0.155))
    hinge("hj1", "he1", "neck", "torso", (0, 0, 0), (0, 0, 1), (-120, 120))
    hinge("hj2", "he2", "head", "neck", (0, 0, -0.005), (1, 0, 0), (-45, 45))

    def mirrored(right: tuple[float, float], side: str) -> tuple[float, float]:
        return right if side == "r" else (-right[1], -right[0])

    for s, lr in (("r", 1.0), ("l", -1.0)):
        arm = f"{s}arm"
        shoulder = (lr * 0.098, 0.0, 0.075)
        upper = _plus(shoulder, (lr * 0.01, 0.02, 0.0))
        elbow = _plus(upper, (-lr * 0.01, variant.elbow_y, 0.009))
        body(f"{s}shoulder", 0.07, _bead(), shoulder, arm)
        body(f"{s}upperarm", 0.15, _box(0.07, 0.08, 0.06), upper, arm)
        body(f"{s}elbow", 0.035, _bead(), elbow, arm)
        body(f"{s}lowerarm", 0.2, _box(0.05, 0.11, 0.05), _plus(elbow, (0.0, 0.05, 0.0)), arm)
        j, e = f"{s}aj", f"{s}ae"
        hinge(f"{j}1", f"{e}1", f"{s}shoulder", "torso", (0, 0, 0), (1, 0, 0), (-120, 120))
        hinge(
            f"{j}2", f"{e}2", f"{s}upperarm", f"{s}shoulder", (-lr * 0.01, -0.02, 0), (0, 0, 1), mirrored((-95, 1), s)
        )
        hinge(f"{j}3", f"{e}3", f"{s}elbow", f"{s}upperarm", (0, 0, 0), (0, 1, 0), (-120, 120))
        hinge(f"{j}4", f"{e}4", f"{s}lowerarm", f"{s}elbow", (0, -0.05, 0), (0, 0, 1), mirrored((-1, 90), s))

    toe = _decimal(variant.toe_length)
    foot_length, toe_share = _decimal(0.16 - toe), _decimal(0.5 * _decimal(toe / 0.16))
    foot_mass, toe_mass = _decimal(0.2 * _decimal(1 - toe_share)), _decimal(0.2 * toe_share)
    for s, lr in (("r", 1.0), ("l", -1.0)):
        leg = f"{s}leg"
        hip = (lr * variant.hip_x, -0.01, -0.115)
        thigh = _plus(hip, (0.0, 0.01, variant.thigh_z))
        shank = _plus(thigh, (0.0, 0.005, -0.125))
        ankle = _plus(shank, (0.0, -0.01, variant.ankle_z))
        foot = _plus(ankle, (0.0, foot_length / 2 - 0.05, -0.04))
        body(f"{s}hip1", 0.09, _bead(), hip, leg)
        body(f"{s}hip2", 0.125, _bead(), hip, leg)
        body(f"{s}thigh", 0.275, _box(0.07, 0.07, 0.14), thigh, leg)
        body(f"{s}shank", 0.225, _box(0.08, 0.07, 0.11), shank, leg)
        body(f"{s}ankle", 0.125, _bead(), ankle, leg)
        body(f"{s}foot", foot_mass, _box(0.08, foot_length, 0.02), foot, leg)
        j, e = f"{s}lj", f"{s}le"
        hinge(f"{j}1", f"{e}1", f"{s}hip1", "torso", (0, 0, 0), (-0.7071, 0, lr * 0.7071), (-90, 1))
        hinge(f"{j}2", f"{e}2", f"{s}hip2", f"{s}hip1", (0, 0, 0), (0, 1, 0), mirrored((-45, 25), s))
        hinge(f"{j}3", f"{e}3", f"{s}thigh", f"{s}hip2", (0, -0.01, -variant.thigh_z), (1, 0, 0), (-25, 100))
        hinge(f"{j}4", f"{e}4", f"{s}shank", f"{s}thigh", (0, -0.01, 0.045), (1, 0, 0), (-130, 1))
        hinge(f"{j}5", f"{e}5", f"{s}ankle", f"{s}shank", (0, 0, 0), (1, 0, 0), (-45, 75), variant.ankle_pitch_speed)
        hinge(
            f"{j}6", f"{e}6", f"{s}foot", f"{s}ankle", (0, -0.03, 0.035), (0, 1, 0), mirrored((-25, 45), s),
            variant.ankle_roll_speed,
        )  # fmt: skip
        if toe:
            body(f"{s}toe", toe_mass, _box(0.08, toe, 0.01), _plus(foot, (0.0, 0.08, -0.005)), leg)
            hinge(f"{j}7", f"{e}7", f"{s}toe", f"{s}foot", (0, _decimal(-toe / 2), -0.005), (1, 0, 0), (-1, 70))

    order = ["hj1", "hj2"]
    order += [f"{s}aj{k}" for s in "lr" for k in range(1, 5)]
    order += [f"{s}lj{k}" for s in "lr" for k in range(1, 8 if toe else 7)]

    boxes = [b.name for b in bodies if b.shape.kind == "box"]
    apart = {frozenset(pair) for s in "rl" for pair in (("torso", f"{s}thigh"), (f"{s}thigh", f"{s}shank"))}
    apart |= {frozenset(pair) for s in "rl" for pair in ((f"{s}shank", f"{s}foot"), (f"{s}foot", f"{s}toe"))}
    pairs = tuple((a, b) for k, a in enumerate(boxes) for b in boxes[k + 1 :] if frozenset((a, b)) not in apart)
    sensors = (("rf", "rfoot"), ("lf", "lfoot")) + ((("rf1", "rtoe"), ("lf1", "ltoe")) if toe else ())
    return RobotModel(robot_type, variant.title, tuple(bodies), tuple(joints[name] for name in order), pairs, sensors)


@cache
def model(robot_type: int) -> RobotModel:
    """Return the table of a robot type, 0 to 4.

    Raises:
        ValueError: the type is unknown.
    """
    if isinstance(robot_type, bool) or robot_type not in ROBOT_TYPES:
        raise ValueError(f"robot_type: {robot_type!r} is unknown; use one of {', '.join(map(str, ROBOT_TYPES))}")
    return _build(int(robot_type))
