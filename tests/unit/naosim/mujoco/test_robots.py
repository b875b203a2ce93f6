"""The descriptions of T1 and K1 agree with the installed models, and their mirror convention with the physics."""

from __future__ import annotations

import copy
import dataclasses
import subprocess
import sys
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from naosim import robots
from naosim.mujoco.world import MujocoWorld, library, world_of
from naosim.robots import Robot
from naosim.robots.actuation import Actuation
from naosim.robots.booster import K1, T1, BoosterParameters, T1Parameters
from pydantic import ValidationError

BOTH = pytest.mark.parametrize("robot", [T1, K1], ids=lambda robot: robot.name)


@BOTH
def test_every_number_is_the_models(robot: Robot) -> None:
    world = world_of(robot)
    model = world.model
    assert len(robot.joints) == world.joints == model.njnt - 2
    for index, joint in enumerate(robot.joints):
        theirs = model.joint(index + 2)
        name = theirs.name.split("-", 1)[1].removeprefix("AA").lower()
        assert name in (joint.name, "a" + joint.name)
        for kind, actuator in enumerate(("tau", "pos", "vel")):
            assert model.actuator(3 * index + kind).name.endswith(f"-{joint.effector}_{actuator}")
            assert model.actuator_trnid[3 * index + kind, 0] == index + 2
        assert tuple(theirs.range) == (joint.low_rad, joint.high_rad)
        assert tuple(model.jnt_actfrcrange[index + 2]) == (-joint.max_torque, joint.max_torque)
        about_y = bool(theirs.axis[1] == 1.0)
        assert (joint.mirror_sign == -1.0) == (joint.side == "centre" and not about_y)
        assert (joint.sign == -1.0) == (joint.side == "right" and not about_y)
        assert joint.low_rad <= robot.nominal[index] <= joint.high_rad
    assert model.qpos0[world.torso + 2] == robot.data["beam_height_m"]
    kp, kd = model.actuator_gainprm[1::3, 0], model.actuator_gainprm[2::3, 0]
    assert [(p, d) for p, d in zip(kp, kd, strict=True)] == [robot.parameters.gains(n) for n in robot.joint_names]  # type: ignore[attr-defined]


@BOTH
def test_standing_height_is_that_of_straight_legs(robot: Robot) -> None:
    mujoco = library()
    world = world_of(robot)
    data = world.new_data()
    data.qpos[world.torso :] = 0.0
    data.qpos[world.torso + 3] = 1.0
    mujoco.mj_kinematics(world.model, data)
    boxes = [geom for geom in world.geoms if "foot" in world.model.body(world.model.geom_bodyid[geom]).name]
    assert len(boxes) == 2
    soles = data.geom_xpos[boxes, 2] - world.model.geom_size[boxes, 2]
    assert soles == pytest.approx(-robot.standing_height_m, abs=2e-4)


@BOTH
def test_shapes_are_drawn_on_the_side_where_they_are(robot: Robot) -> None:
    mujoco = library()
    world = world_of(robot)
    data = world.new_data()
    data.qpos[world.torso :] = 0.0
    data.qpos[world.torso + 3] = 1.0
    mujoco.mj_kinematics(world.model, data)
    assert len(robot.shapes) == len(world.geoms)
    for shape, geom in zip(robot.shapes, world.geoms, strict=True):
        expected = {"left": 1, "right": -1, "centre": 0}[shape.side]
        assert np.sign(round(float(data.geom_xpos[geom, 1]), 2)) == expected, shape
        assert all(length >= 0.0 for length in shape.size_m) and shape.size_m[0] > 0.0


def test_robots_are_listed_without_mujoco() -> None:
    program = (
        "import sys; from naosim import kinds, robots; t1 = robots.get('t1');"
        "parameters = kinds.get('embedded').parameters(t1)(); t1.with_parameters({'kp': {'legs': 100}});"
        "assert 'mujoco' not in sys.modules and 'naosim.mujoco._mujoco' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
    assert {"t1", "k1"} <= set(robots.names())


def test_gains_by_group_kind_and_joint() -> None:
    changed = T1.with_parameters({"kp": {"legs": 200, "hip_yaw": 90, "left_hip_yaw": 95}, "kd": {"arms": 1}})
    gains = {name: changed.parameters.gains(name) for name in T1.joint_names}  # type: ignore[attr-defined]
    assert gains["right_ankle_roll"][0] == 200.0
    assert (gains["left_hip_yaw"][0], gains["right_hip_yaw"][0]) == (95.0, 90.0)
    assert gains["left_elbow_yaw"] == (T1.parameters.gains("left_elbow_yaw")[0], 1.0)  # type: ignore[attr-defined]
    dumped = changed.parameters.model_dump(mode="json")
    assert set(dumped["kp"]) == {*T1.parameters.model_dump()["kp"], "left_hip_yaw"}
    assert T1.with_parameters(dumped).parameters == changed.parameters
    with pytest.raises(ValidationError, match="there is no joint 'hip'"):
        T1.with_parameters({"kp": {"hip": 1}})
    with pytest.raises(ValidationError, match="there is no joint 'waist'"):
        K1.with_parameters({"kp": {"waist": 1}})
    with pytest.raises(ValidationError, match="knee_pitch must be from 0 to 2000"):
        T1.with_parameters({"kp": {"knee_pitch": -1}})


@BOTH
def test_a_wrong_gain_is_named_once_and_with_the_robot(robot: Robot) -> None:
    for refuse in (
        lambda given: robot.with_parameters({"kp": given}),
        lambda given: type(robot.parameters).model_validate({"name": robot.name, "kp": given}),  # a specification's
    ):
        for given, words in (({"knee": 1}, "there is no joint 'knee'; name a group"), ({"legs": -1}, "legs must be")):
            with pytest.raises(ValidationError) as refused:
                refuse(given)
            (error,) = refused.value.errors()
            assert error["loc"] == ("kp",)
            assert error["msg"].startswith(f"Value error, robot {robot.name}: {words}")


@pytest.mark.parametrize(
    ("gains", "words"),
    [
        ({**T1Parameters.DEFAULT_KP, "knee": 100.0}, "Soft.DEFAULT_KP: there is no joint 'knee'; name a kind of joint"),
        ({**T1Parameters.DEFAULT_KP, "legs": 100.0}, "Soft.DEFAULT_KP: there is no joint 'legs'; name a kind of joint"),
        ({"knee_pitch": 100.0}, "Soft.DEFAULT_KP: ankle_pitch is missing; state every kind of joint"),
    ],
)
def test_default_gains_of_a_variant_are_checked(gains: dict[str, float], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        type("Soft", (T1Parameters,), {"DEFAULT_KP": MappingProxyType(gains), "__module__": __name__})()


def test_what_a_variants_description_has_itself_is_kept() -> None:
    """Settings fill in the rest, and one that would have no effect is refused."""
    ranges = {joint.name: 0.2 for joint in T1.joints if joint.actuated}
    narrow = dataclasses.replace(
        T1, name="t1-narrow", action_range_rad=ranges, nominal_rad={**T1.nominal_rad, "head_pitch": 0.3}
    )
    for settings in ({}, {"action_range_rad": 0.75, "head_pitch_rad": 0.0}, {"action_range_rad": 0.2}):
        robot = narrow.with_parameters(settings)
        assert set(Actuation(robot).action_range_rad.tolist()) == {0.2}  # type: ignore[union-attr]
        assert robot.nominal[T1.joint_names.index("head_pitch")] == 0.3
        assert robot.with_parameters({}) == narrow.with_parameters({})
    for name, value, own in (("action_range_rad", 1.0, 0.2), ("head_pitch_rad", 0.6, 0.3)):
        with pytest.raises(
            ValueError, match=f"robot t1-narrow: {name}: {value:g} would have no effect.* has {own} rad"
        ):
            narrow.with_parameters({name: value})
    mixed = {**T1.action_range_rad, "left_knee_pitch": 0.4, "right_knee_pitch": 0.4}  # type: ignore[dict-item]
    robot = dataclasses.replace(T1, name="t1-knees", action_range_rad=mixed).with_parameters({"head_pitch_rad": 0.6})
    assert robot.action_range_rad == mixed and robot.nominal_rad["head_pitch"] == 0.6
    # the settings of the robot that a variant was made of are not its own
    wide = dataclasses.replace(T1.with_parameters({"action_range_rad": 2.0, "head_pitch_rad": 0.6}), name="t1-wide")
    assert set(wide.with_parameters({}).action_range_rad.values()) == {0.75}  # type: ignore[union-attr]
    assert "head_pitch" not in wide.with_parameters({}).nominal_rad


def test_a_variant_has_the_joints_of_the_simulators_model() -> None:
    moved = dataclasses.replace(T1, joints=tuple(dataclasses.replace(each, actuated=True) for each in T1.joints))
    assert Actuation(moved.with_parameters({})).n_actions == 23
    speeds = [dataclasses.replace(each, width=22) if each.width == 23 else each for each in T1.perceptors]
    stiff = tuple(joint for joint in T1.joints if joint.name != "waist")
    without = dataclasses.replace(T1, name="t1-stiff", joints=stiff, perceptors=tuple(speeds))
    with pytest.raises(ValueError, match=r"robot t1-stiff: joints: the simulator's model has head_yaw, .* waist, "):
        without.with_parameters({})
    assert isinstance(without.parameters, BoosterParameters)


def test_the_range_of_actions_is_a_setting() -> None:
    wide = T1.with_parameters({"action_range_rad": 2.0})
    for robot, reach in ((T1, 0.75), (wide, 2.0)):
        actuation = Actuation(robot)
        ones = actuation.targets(np.ones((1, actuation.n_actions)))[0, actuation.index] * actuation.sign
        np.testing.assert_allclose(ones, np.minimum(actuation.nominal + reach, actuation.high_rad))
    with pytest.raises(ValidationError, match="action_range_rad"):
        T1.with_parameters({"action_range_rad": 0.0})


def test_an_action_of_one_is_three_quarters_of_a_radian() -> None:
    actuation = Actuation(T1)
    assert actuation.n_actions == 21 and "head_yaw" not in actuation.names
    ones = actuation.targets(np.ones((1, 21)))[0]
    for name, sign in (("left_hip_roll", 1.0), ("right_hip_roll", -1.0)):
        assert ones[T1.joint_names.index(name)] == sign * 0.75


class Mirror:
    """Reflection of a robot's state at the plane y = 0."""

    def __init__(self, robot: Robot, world: MujocoWorld) -> None:
        self.first = world.torso
        self.partner = [robot.joint_names.index(joint.mirror) for joint in robot.joints]
        # angle of a joint = mirror_sign * sign * sign of the partner * angle of the partner
        self.sign = np.array(
            [
                joint.mirror_sign * joint.sign * robot.joints[k].sign
                for joint, k in zip(robot.joints, self.partner, strict=True)
            ]
        )

    def joints(self, values: np.ndarray) -> np.ndarray:
        return values[self.partner] * self.sign

    def state(self, data: Any) -> tuple[np.ndarray, np.ndarray]:
        position, velocity = data.qpos.copy(), data.qvel.copy()
        for start, flat in ((0, position[: self.first]), (self.first, position[self.first : self.first + 7])):
            position[start : start + len(flat)] = flat * [1, -1, 1, 1, -1, 1, -1][: len(flat)]
        for start in (0, 6):
            velocity[start : start + 6] *= [1, -1, 1, -1, 1, -1]
        position[self.first + 7 :] = self.joints(position[self.first + 7 :])
        velocity[12:] = self.joints(velocity[12:])
        return position, velocity


def mirrored_bodies(model: Any) -> Any:
    """Return the model with each body's inertia taken from its mirror image: real robots are not quite symmetric."""
    mirrored = copy.copy(model)

    def other(name: str) -> str:
        for left, right in (("left", "right"), ("Left", "Right"), ("AL", "AR")):
            if left in name:
                return name.replace(left, right)
            if right in name:
                return name.replace(right, left)
        return name

    for body in range(model.nbody):
        name = model.body(body).name
        source = model.body(other(name)).id
        mirrored.body_mass[body] = model.body_mass[source]
        mirrored.body_inertia[body] = model.body_inertia[source]
        mirrored.body_ipos[body] = model.body_ipos[source] * [1, -1, 1]
        mirrored.body_iquat[body] = model.body_iquat[source] * [1, -1, 1, -1]
    library().mj_setConst(mirrored, library().MjData(mirrored))
    return mirrored


@BOTH
def test_a_mirrored_robot_moves_as_its_mirror_image(robot: Robot) -> None:
    mujoco = library()
    world = world_of(robot)
    mirror = Mirror(robot, world)
    rng = np.random.default_rng(3)
    ours = world.new_data((3.0, 4.0))
    ours.qpos[world.torso : world.torso + 7] = (0.0, 0.4, robot.standing_height_m + 0.02, 1, 0.01, 0.02, 0.1)
    ours.qpos[world.torso + 7 :] = robot.nominal + rng.uniform(-0.05, 0.05, world.joints)
    ours.qvel[6:] = rng.uniform(-0.1, 0.1, world.joints + 6)
    image_model = mirrored_bodies(world.model)
    image = mujoco.MjData(image_model)
    image.qpos[:], image.qvel[:] = mirror.state(ours)
    touched = False
    for _ in range(15):
        target = robot.nominal + rng.uniform(-0.2, 0.2, world.joints)
        ours.ctrl[1::3], image.ctrl[1::3] = target, mirror.joints(target)
        mujoco.mj_step(world.model, ours, 4)
        mujoco.mj_step(image_model, image, 4)
        touched |= bool((ours.sensordata[-6:] != 0.0).any())
        expected_position, expected_velocity = mirror.state(ours)
        assert np.abs(image.qpos - expected_position).max() < 1e-9
        assert np.abs(image.qvel - expected_velocity).max() < 1e-9
    assert touched


@BOTH
def test_the_head_is_held_where_it_should_look(robot: Robot) -> None:
    looking = robot.with_parameters({"head_pitch_rad": 0.6})
    differs = looking.nominal != robot.nominal
    assert [name for name, yes in zip(robot.joint_names, differs, strict=True) if yes] == ["head_pitch"]
    assert looking.nominal[differs].tolist() == [0.6]
    assert robot.with_parameters({}) == looking.with_parameters({}) == robot
    with pytest.raises(ValidationError, match=r"less than or equal to 0\.85"):
        robot.with_parameters({"head_pitch_rad": 1.0})


@BOTH
def test_the_camera_is_where_the_model_has_it(robot: Robot) -> None:
    built, mujoco = world_of(robot), library()
    data, first = built.new_data(), built.torso
    data.qpos[first : first + 7] = (1.0, 2.0, 0.7, 1.0, 0.0, 0.0, 0.0)
    data.qpos[first + 7 : first + 9] = (0.4, 0.5)
    mujoco.mj_kinematics(built.model, data)
    assert robot.camera is not None
    (c, s), (d, z) = (np.cos(0.4), np.sin(0.4)), (np.cos(0.5), np.sin(0.5))
    turn, nod = (
        np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]),
        np.array([[d, 0.0, z], [0.0, 1.0, 0.0], [-z, 0.0, d]]),
    )
    mount, rotation = robot.camera, turn @ nod
    position = mount.yaw_m + turn @ (mount.pitch_m + nod @ mount.camera_m)
    assert position + np.array([1.0, 2.0, 0.7]) == pytest.approx(data.site_xpos[built.camera], abs=1e-12)
    assert rotation.ravel() == pytest.approx(data.site_xmat[built.camera], abs=1e-12)
