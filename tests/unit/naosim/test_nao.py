"""The descriptions of the NAOs, and the mapping between joints and policies."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from naosim import robots
from naosim.robots import Robot, nao_model
from naosim.robots.actuation import Actuation
from naosim.robots.nao import model_of
from naospec.plugins import UnknownPluginError

NAOS = [f"nao-{robot_type}" for robot_type in nao_model.ROBOT_TYPES]


@pytest.fixture(params=NAOS)
def robot(request: pytest.FixtureRequest) -> Robot:
    return robots.get(request.param)


def test_robots_are_found_by_name() -> None:
    assert set(NAOS) <= set(robots.names())
    with pytest.raises(UnknownPluginError, match=r"unknown robot 'nao-5': choose one of .*nao-4"):
        robots.get("nao-5")


def test_a_description_follows_the_table_of_its_type(robot: Robot) -> None:
    model = model_of(robot)
    assert robot.joint_names == model.joint_names
    assert np.rad2deg([joint.low_rad for joint in robot.joints]) == pytest.approx(model.low_deg)
    assert np.rad2deg([joint.high_rad for joint in robot.joints]) == pytest.approx(model.high_deg)
    assert [joint.max_speed for joint in robot.joints] == list(model.max_speed)
    assert [shape.name for shape in robot.shapes] == list(model.body_names)
    assert {shape.side for shape in robot.shapes if shape.name.startswith("l")} == {"left"}
    assert {shape.side for shape in robot.shapes if shape.name in ("torso", "neck", "head")} == {"centre"}
    assert 0.38 < robot.standing_height_m < 0.45


def test_mirrored_joints_pair_up(robot: Robot) -> None:
    joints = {joint.name: joint for joint in robot.joints}
    for joint in robot.joints:
        partner = joints[joint.mirror]
        assert partner.mirror == joint.name
        assert {joint.side, partner.side} in ({"left", "right"}, {"centre"})
        ends = {tuple(sorted((one.low_rad * one.sign, one.high_rad * one.sign))) for one in (joint, partner)}
        assert len(ends) == 1, "ranges are the same in the policy convention"
    assert (joints["hj1"].mirror_sign, joints["hj2"].mirror_sign, joints["llj1"].mirror_sign) == (-1.0, 1.0, 1.0)


def test_other_parameters_are_refused(robot: Robot) -> None:
    assert robot.with_parameters({}) == robot
    with pytest.raises(ValueError, match="gain"):
        robot.with_parameters({"gain": 7})
    other = dataclasses.replace(robot, family="booster")
    with pytest.raises(ValueError, match="expected a robot of family 'nao', got 'booster'"):
        model_of(other)


def test_actions_are_the_papers_twenty_joints() -> None:
    """Left arm, right arm, left leg, right leg, without the neck; type 4 has toes."""
    arms = [f"{side}aj{k}" for side in "lr" for k in range(1, 5)]
    legs = [f"{side}lj{k}" for side in "lr" for k in range(1, 7)]
    assert list(Actuation(robots.get("nao-0")).names) == arms + legs
    assert {"llj7", "rlj7"} <= set(Actuation(robots.get("nao-4")).names)


def test_ends_of_the_action_range_are_the_joints_stops(robot: Robot) -> None:
    actuation = Actuation(robot)
    low, high = actuation.targets(np.array([[-1.0], [1.0]]) * np.ones(actuation.n_actions))
    for index, joint in enumerate(robot.joints):
        if joint.actuated:
            assert sorted((low[index], high[index])) == pytest.approx([joint.low_rad, joint.high_rad])
        else:
            assert low[index] == high[index] == 0.0
    middle = actuation.targets(np.zeros((1, actuation.n_actions)))[0]
    assert middle == pytest.approx((low + high) / 2)
    beyond = actuation.targets(7.0 * np.ones((1, actuation.n_actions)))[0]
    assert np.array_equal(beyond, high)


def test_actions_of_a_robot_with_a_range_are_offsets_from_its_nominal_pose() -> None:
    nao = robots.get("nao-0")
    ranges = {joint.name: 0.5 for joint in nao.joints}
    actuation = Actuation(dataclasses.replace(nao, action_range_rad=ranges))
    targets = actuation.targets(np.zeros((1, 20)))[0]
    assert targets == pytest.approx(nao.nominal)
    action = np.zeros((1, 20))
    action[0, actuation.names.index("llj4")] = 0.5
    action[0, actuation.names.index("llj1")] = 1.0  # its stop is at 1 degree
    moved = actuation.targets(action)[0] - nao.nominal
    by_name = dict(zip(nao.joint_names, moved, strict=True))
    assert by_name["llj4"] == pytest.approx(-0.25), "a bent knee is positive for a policy, negative here"
    assert by_name["llj1"] == pytest.approx(np.deg2rad(1.0))
    assert np.abs(actuation.rest).max() == 1.0


def test_same_action_on_both_sides_is_a_symmetric_posture() -> None:
    """Mirrored about the sagittal plane: rotations about x keep their sign, those about y and z change it."""
    nao = robots.get("nao-0")
    model, actuation = model_of(nao), Actuation(nao)
    rng = np.random.default_rng(0)
    half_arm, half_leg = rng.uniform(-1, 1, 4), rng.uniform(-1, 1, 6)
    target = actuation.targets(np.concatenate([half_arm, half_arm, half_leg, half_leg])[None])[0]
    for name in actuation.names:
        if name[0] != "l":
            continue
        left, right = model.joint_index[name], model.joint_index["r" + name[1:]]
        # the axial vector angle * axis, mirrored
        vector = target[left] * np.array(model.joints[left].axis)
        mirrored = np.array([vector[0], -vector[1], -vector[2]])
        assert target[right] * np.array(model.joints[right].axis) == pytest.approx(mirrored, abs=1e-6), name


def test_nominal_pose_is_the_papers() -> None:
    """Arms down with bent elbows, hips and ankles at 30 degrees, knees at 60."""
    nao = robots.get("nao-0")
    expected = {"laj1": -90, "raj1": -90, "laj3": -90, "raj3": 90, "laj4": -90, "raj4": 90}
    expected |= {"llj3": 30, "rlj3": 30, "llj4": -60, "rlj4": -60, "llj5": 30, "rlj5": 30}
    assert np.rad2deg(nao.nominal) == pytest.approx([expected.get(name, 0.0) for name in nao.joint_names])
    actuation = Actuation(nao)
    seen = dict(zip(actuation.names, np.rad2deg(actuation.angles(np.rad2deg(nao.nominal)[None])[0]), strict=True))
    for side in "lr":
        assert [seen[f"{side}{joint}"] for joint in ("aj1", "lj3", "lj4", "lj5")] == pytest.approx([90, -30, 60, -30])
