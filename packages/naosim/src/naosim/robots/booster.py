"""Booster T1 and K1, the robots of rcssservermj.

The numbers are those of the model files in the package ``rcsssmj``; a test compares every one of them. They are
repeated here so that robots can be listed and specifications validated where MuJoCo is not installed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import ClassVar

from pydantic import Field, ValidationInfo, field_validator

from naosim.fields import RCSSSERVERMJ
from naosim.robots.description import (
    CameraMount,
    FilledIn,
    JointDescription,
    PerceptorDescription,
    Robot,
    RobotParameters,
    Shape,
    Side,
    described,
)

FAMILY = "booster"

_HEAD = ("head_yaw", "head_pitch")
_ARM = ("shoulder_pitch", "shoulder_roll", "elbow_pitch", "elbow_yaw")
_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee_pitch", "ankle_pitch", "ankle_roll")
_WAIST = ("waist",)

GROUPS: Mapping[str, tuple[str, ...]] = MappingProxyType({"head": _HEAD, "arms": _ARM, "legs": _LEG})
"""Kinds of joints that gains can name together."""

_Joint = tuple[float, float, float]  # low rad, high rad, N m; of the left side

_T1_JOINTS: Mapping[str, _Joint] = {
    "head_yaw": (-1.57, 1.57, 7.0),
    "head_pitch": (-0.35, 1.22, 7.0),
    "shoulder_pitch": (-3.31, 1.22, 18.0),
    "shoulder_roll": (-1.74, 1.57, 18.0),
    "elbow_pitch": (-2.27, 2.27, 18.0),
    "elbow_yaw": (-2.44, 0.0, 18.0),
    "waist": (-1.57, 1.57, 30.0),
    "hip_pitch": (-1.8, 1.57, 45.0),
    "hip_roll": (-0.2, 1.57, 30.0),
    "hip_yaw": (-1.0, 1.0, 30.0),
    "knee_pitch": (0.0, 2.34, 60.0),
    "ankle_pitch": (-0.87, 0.35, 20.0),
    "ankle_roll": (-0.44, 0.44, 15.0),
}

_K1_JOINTS: Mapping[str, _Joint] = {
    "head_yaw": (-1.0, 1.0, 6.0),
    "head_pitch": (-0.349, 0.855, 6.0),
    "shoulder_pitch": (-3.316, 1.22, 14.0),
    "shoulder_roll": (-1.74, 1.57, 14.0),
    "elbow_pitch": (-2.27, 2.27, 14.0),
    "elbow_yaw": (-2.44, 0.0, 14.0),
    "hip_pitch": (-3.0, 2.21, 30.0),
    "hip_roll": (-0.4, 1.57, 35.0),
    "hip_yaw": (-1.0, 1.0, 20.0),
    "knee_pitch": (0.0, 2.23, 40.0),
    "ankle_pitch": (-0.87, 0.345, 20.0),
    "ankle_roll": (-0.345, 0.345, 20.0),
}

_NOMINAL: Mapping[str, float] = {
    "shoulder_roll": -1.3,
    "elbow_yaw": -0.5,
    "hip_pitch": -0.25,
    "knee_pitch": 0.5,
    "ankle_pitch": -0.25,
}
"""Nominal pose in radians, left side: knees slightly bent, upper arms down, forearms forward."""


def kind_of(joint: str) -> str:
    """Return the kind of a joint: its name without the side."""
    return joint.removeprefix("left_").removeprefix("right_")


class BoosterParameters(RobotParameters):
    """Motor gains and the range of actions.

    Torque = kp (target - angle) - kd speed, every 5 ms, limited to the joint's maximum torque.
    A mapping may name a group (``legs``), a kind of joint (``hip_pitch``) or one joint (``left_hip_pitch``); the more
    specific name has precedence, and what is not named keeps its default.
    """

    JOINTS: ClassVar[Mapping[str, _Joint]]
    DEFAULT_KP: ClassVar[Mapping[str, float]]
    DEFAULT_KD: ClassVar[Mapping[str, float]]

    kp: Mapping[str, float] = Field(
        default={}, validate_default=True, title="Stiffness", description="N m/rad by joint."
    )
    kd: Mapping[str, float] = Field(
        default={}, validate_default=True, title="Damping", description="N m s/rad by joint."
    )

    action_range_rad: float = Field(
        default=0.75,
        ge=0.05,
        le=4.0,
        title="Action range",
        description="Angle between the nominal pose and the target angle for an action of 1; targets stay within the "
        "joint's range.",
        json_schema_extra={"unit": "rad"},
    )

    head_pitch_rad: float = Field(
        default=0.0,
        ge=-0.3,
        le=0.85,
        title="Head pitch",
        description="Angle at which the head is held; with 0.6 the camera sees a ball at the feet.",
        json_schema_extra={"unit": "rad"},
    )

    onboard_sensing: bool = Field(
        default=False,
        title="Onboard sensing",
        description="Whether policies observe only what a real robot measures: orientation, gyroscope and joints, "
        "without the torso's position and velocity.",
    )

    def applied(self, robot: Robot) -> Robot:
        """Return the robot with range of actions and angle of the head where its description leaves them open.

        A description that has its own is kept; a setting other than the default is then refused.

        Raises:
            ValueError: if such a setting is refused, or the joints are not those of the simulator's model.
        """
        expected = tuple(joint.name for joint in _joints(self.JOINTS))
        if robot.joint_names != expected:
            raise ValueError(
                f"robot {robot.name}: joints: the simulator's model has {', '.join(expected)}; keep all of them in "
                "this order, and hold one still with actuated=False"
            )
        names = [joint.name for joint in robot.joints if joint.actuated]
        reach, pose = described(robot.action_range_rad), described(robot.nominal_rad) or {}
        if reach is None:
            reach = FilledIn(None, dict.fromkeys(names, self.action_range_rad))
        else:
            self._require_unchosen(robot, "action_range_rad", {reach[name] for name in names})
        if not pose.get("head_pitch"):
            pose = FilledIn(pose, {"head_pitch": self.head_pitch_rad} if self.head_pitch_rad else {})
        else:
            self._require_unchosen(robot, "head_pitch_rad", {pose["head_pitch"]})
        return replace(robot, action_range_rad=reach, nominal_rad=pose)

    def _require_unchosen(self, robot: Robot, name: str, own: Collection[float]) -> None:
        """Refuse a value of a setting that the robot's own angles would leave without effect."""
        chosen, usual = getattr(self, name), type(self).model_fields[name].default
        if chosen != usual and {chosen} != set(own):
            angles = ", ".join(f"{angle:g}" for angle in sorted(own))
            raise ValueError(
                f"robot {robot.name}: {name}: {chosen:g} would have no effect, since the robot's description has "
                f"{angles} rad; leave {name} out"
            )

    @field_validator("kp")
    @classmethod
    def _complete_kp(cls, value: Mapping[str, float], info: ValidationInfo) -> Mapping[str, float]:
        return cls._complete(value, info, "DEFAULT_KP", 2000.0)

    @field_validator("kd")
    @classmethod
    def _complete_kd(cls, value: Mapping[str, float], info: ValidationInfo) -> Mapping[str, float]:
        return cls._complete(value, info, "DEFAULT_KD", 100.0)

    @classmethod
    def _complete(cls, given: Mapping[str, float], info: ValidationInfo, usual: str, most: float) -> dict[str, float]:
        """Return gains by kind of joint, followed by those of single joints where these differ."""
        joints = [joint.name for joint in _joints(cls.JOINTS)]
        defaults: Mapping[str, float] = getattr(cls, usual)
        choices = f"a kind of joint ({', '.join(cls.JOINTS)}) or one joint ({joints[0]}, left_hip_pitch, ...)"
        if wrong := set(defaults) - set(cls.JOINTS) - set(joints):
            raise ValueError(f"{cls.__name__}.{usual}: there is no joint {min(wrong)!r}; name {choices}")
        if missing := set(cls.JOINTS) - set(defaults):
            raise ValueError(f"{cls.__name__}.{usual}: {min(missing)} is missing; state every kind of joint")
        # a specification's section has the robot's name, other settings are validated for a robot
        name = info.data.get("name") or (info.context or {}).get("robot")
        owner = f"robot {name}: " if name else ""
        if unknown := set(given) - set(GROUPS) - set(cls.JOINTS) - set(joints):
            raise ValueError(
                f"{owner}there is no joint {min(unknown)!r}; name a group ({', '.join(GROUPS)}), {choices}"
            )
        for key, gain in given.items():
            if not 0.0 <= gain <= most:
                raise ValueError(f"{owner}{key} must be from 0 to {most:g}, not {gain:g}")
        gains = dict(defaults)
        for group, kinds in GROUPS.items():
            if group in given:
                gains |= dict.fromkeys((kind for kind in kinds if kind in gains), float(given[group]))
        gains |= {key: float(gain) for key, gain in given.items() if key in cls.JOINTS}
        single = {joint: float(given[joint]) for joint in joints if joint in given and joint not in cls.JOINTS}
        return gains | {joint: gain for joint, gain in single.items() if gain != gains[kind_of(joint)]}

    def gains(self, joint: str) -> tuple[float, float]:
        """Return kp in N m/rad and kd in N m s/rad of one joint."""
        kind = kind_of(joint)
        return self.kp.get(joint, self.kp[kind]), self.kd.get(joint, self.kd[kind])


class T1Parameters(BoosterParameters):
    """Motor gains of the T1.

    With the defaults it stands without a policy. The ankle's stiffness is decisive: below 150 N m/rad the robot
    tips over within three seconds for any value of the other gains.
    """

    JOINTS = _T1_JOINTS
    DEFAULT_KP = MappingProxyType(
        dict.fromkeys((*_HEAD, *_ARM), 20.0)
        | {"waist": 60.0, "hip_pitch": 120.0, "hip_roll": 120.0, "hip_yaw": 80.0}
        | {"knee_pitch": 120.0, "ankle_pitch": 150.0, "ankle_roll": 40.0}
    )
    DEFAULT_KD = MappingProxyType(
        dict.fromkeys((*_HEAD, *_ARM), 0.6)
        | {"waist": 2.0, "hip_pitch": 3.0, "hip_roll": 3.0, "hip_yaw": 2.0}
        | {"knee_pitch": 3.0, "ankle_pitch": 2.0, "ankle_roll": 1.0}
    )


class K1Parameters(BoosterParameters):
    """Motor gains of the K1; with the defaults it stands without a policy."""

    JOINTS = _K1_JOINTS
    DEFAULT_KP = MappingProxyType(
        dict.fromkeys(_HEAD, 6.0)
        | dict.fromkeys(_ARM, 15.0)
        | {"hip_pitch": 100.0, "hip_roll": 100.0, "hip_yaw": 80.0}
        | {"knee_pitch": 100.0, "ankle_pitch": 100.0, "ankle_roll": 40.0}
    )
    DEFAULT_KD = MappingProxyType(
        dict.fromkeys(_HEAD, 0.1)
        | dict.fromkeys(_ARM, 0.2)
        | {"hip_pitch": 2.0, "hip_roll": 2.0, "hip_yaw": 2.0}
        | {"knee_pitch": 2.0, "ankle_pitch": 2.0, "ankle_roll": 1.0}
    )


def _joints(table: Mapping[str, _Joint]) -> tuple[JointDescription, ...]:
    """Return the joints in the simulator's order: head, arms, waist if there is one, legs."""

    def joint(kind: str, side: Side, effector: str) -> JointDescription:
        low, high, torque = table[kind]
        turned = not kind.endswith("pitch")  # turns about x or z: a mirrored posture has the opposite angle
        if side == "right" and turned:
            low, high = -high, -low
        other = {"left": "right_", "right": "left_", "centre": ""}[side]
        return JointDescription(
            name=kind if side == "centre" else f"{side}_{kind}",
            effector=effector,
            side=side,
            mirror=other + kind,
            low_rad=low + 0.0,
            high_rad=high + 0.0,
            max_torque=torque,
            sign=-1.0 if side == "right" and turned else 1.0,
            mirror_sign=-1.0 if side == "centre" and turned else 1.0,
            actuated=kind not in _HEAD,
        )

    def limb(kinds: tuple[str, ...], letter: str) -> list[JointDescription]:
        sides: tuple[Side, ...] = ("left", "right")
        return [joint(kind, side, f"{side[0]}{letter}e{k}") for side in sides for k, kind in enumerate(kinds, 1)]

    head = [joint(kind, "centre", f"he{k}") for k, kind in enumerate(_HEAD, 1)]
    waist = [joint(kind, "centre", "te1") for kind in _WAIST if kind in table]
    return (*head, *limb(_ARM, "a"), *waist, *limb(_LEG, "l"))


def _shapes(robot: str) -> tuple[Shape, ...]:
    from naosim.mujoco.shapes import shapes_of

    return shapes_of(robot)


def _robot(
    name: str,
    table: Mapping[str, _Joint],
    parameters: BoosterParameters,
    *,
    standing_height_m: float,
    beam_height_m: float,
    stiffest_contacts: float,
    camera: CameraMount,
) -> Robot:
    joints = _joints(table)
    robot = Robot(
        name=name,
        family=FAMILY,
        title=f"Booster {name.upper()}",
        joints=joints,
        nominal_rad=MappingProxyType(
            {joint.name: joint.sign * _NOMINAL[kind] for joint in joints if (kind := kind_of(joint.name)) in _NOMINAL}
        ),
        standing_height_m=standing_height_m,
        front_axis=0,
        perceptors=(
            PerceptorDescription("joint_angles", len(joints), "deg", "joint angles, 2 decimals"),
            PerceptorDescription("joint_speeds", len(joints), "deg/s", "joint speeds, 2 decimals"),
            PerceptorDescription("torso_quat", 4, "", "torso orientation w x y z in the world, 3 decimals"),
            PerceptorDescription("torso_pos", 3, "m", "torso position in the world, 3 decimals"),
            PerceptorDescription("gyro", 3, "deg/s", "angular velocity, torso frame, 2 decimals"),
            PerceptorDescription("accel", 3, "m/s^2", "acceleration with gravity, torso frame, 2 decimals"),
        ),
        parameters=parameters,
        data=MappingProxyType(
            {"model": name.upper(), "beam_height_m": beam_height_m, "stiffest_contacts": stiffest_contacts}
        ),
        load_shapes=lambda: _shapes(name.upper()),
        field=RCSSSERVERMJ,
        camera=camera,
    )
    return parameters.applied(robot)


T1 = _robot(
    "t1",
    _T1_JOINTS,
    T1Parameters(),
    standing_height_m=0.6734,
    beam_height_m=0.6735,
    stiffest_contacts=4.0,
    camera=CameraMount((0.0625, 0.0, 0.243), (0.0, 0.0, 0.06185), (0.05, 0.0, 0.12)),
)
K1 = _robot(
    "k1",
    _K1_JOINTS,
    K1Parameters(),
    standing_height_m=0.5517,
    beam_height_m=1.0,
    stiffest_contacts=1.0,
    camera=CameraMount((0.0056, 0.0, 0.2149), (0.0, 0.0, 0.033), (0.06, 0.0, 0.08)),
)
ROBOTS = (T1, K1)
