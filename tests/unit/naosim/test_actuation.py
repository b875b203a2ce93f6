"""How actions become target angles, and perceived angles what policies see."""

from __future__ import annotations

import numpy as np
import pytest
from naosim import robots
from naosim.robots import nao_model
from naosim.robots.actuation import Actuation
from naosim.simspark.control import motor_speeds


@pytest.fixture
def actuation() -> Actuation:
    """Return the standard robot's joints."""
    return Actuation(robots.get("nao-0"))


def test_actions_are_the_papers_twenty_joints(actuation: Actuation) -> None:
    """Left arm, right arm, left leg, right leg, without the neck."""
    arms = [f"{side}aj{i}" for side in "lr" for i in range(1, 5)]
    legs = [f"{side}lj{i}" for side in "lr" for i in range(1, 7)]
    assert list(actuation.names) == arms + legs
    assert actuation.n_actions == 20


def test_toes_are_moved_where_there_are_toes() -> None:
    """Robot type 4 has two more actions."""
    names = Actuation(robots.get("nao-4")).names
    assert len(names) == 22
    assert {"llj7", "rlj7"} <= set(names)


@pytest.mark.parametrize("robot_type", range(5))
def test_ends_of_the_action_range_are_the_joints_stops(robot_type: int) -> None:
    """Actions of -1 and 1 ask for the stops, and every target lies between them."""
    model = nao_model.model(robot_type)
    actuation = Actuation(robots.get(f"nao-{robot_type}"))
    low, high = actuation.targets(np.array([[-1.0], [1.0]]) * np.ones(actuation.n_actions))
    for name in actuation.names:
        at = model.joint_index[name]
        joint = model.joints[at]
        assert sorted(np.rad2deg([low[at], high[at]])) == pytest.approx([joint.low_deg, joint.high_deg])
    middle = actuation.targets(np.zeros((1, actuation.n_actions)))[0]
    assert middle == pytest.approx((low + high) / 2)


def test_actions_beyond_the_range_are_clipped(actuation: Actuation) -> None:
    """An action of 7 is an action of 1."""
    ones = np.ones((1, 20))
    assert np.array_equal(actuation.targets(7 * ones), actuation.targets(ones))
    assert np.array_equal(actuation.targets(-7 * ones), actuation.targets(-ones))


def test_neck_is_held_at_zero(actuation: Actuation) -> None:
    """No action moves the neck, and the controller brings it back."""
    targets = actuation.targets(np.ones((1, 20)))
    assert np.array_equal(targets[0, :2], [0.0, 0.0])
    angles = np.zeros((1, 22))
    angles[0, 0] = 10.0
    assert motor_speeds(targets, angles, nao_model.model(0).max_speed)[0, 0] == pytest.approx(-7 * np.deg2rad(10))


def test_same_action_on_both_sides_is_a_symmetric_posture(actuation: Actuation) -> None:
    """Mirrored about the sagittal plane: rotations about x keep their sign, those about y and z change it."""
    model = nao_model.model(0)
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


def test_controller_is_proportional_with_gain_seven() -> None:
    """The speed is 7 times the error in radians, within the joint's limit."""
    targets, angles = np.zeros((1, 22)), np.zeros((1, 22))
    targets[0, 5] = 0.1
    angles[0, 6] = np.rad2deg(0.2)
    targets[0, 7], targets[0, 8] = 2.0, -2.0
    speeds = motor_speeds(targets, angles, nao_model.model(0).max_speed)[0]
    assert speeds[5] == pytest.approx(0.7)
    assert speeds[6] == pytest.approx(-1.4)
    assert speeds[7] == pytest.approx(nao_model.model(0).max_speed[7])
    assert speeds[8] == pytest.approx(-nao_model.model(0).max_speed[8])


def test_speed_limits_are_each_joints_own() -> None:
    """Robot type 2 has fast ankle pitch and slow ankle roll."""
    limits = np.array([joint.max_speed for joint in robots.get("nao-2").joints])
    speeds = motor_speeds(np.full((1, 22), 100.0), np.zeros((1, 22)), limits)[0]
    index = nao_model.model(2).joint_index
    assert speeds[index["llj5"]] == pytest.approx(8.80667, rel=1e-4)
    assert speeds[index["llj6"]] == pytest.approx(3.47234, rel=1e-4)
    assert speeds[index["llj4"]] == pytest.approx(6.1395, rel=1e-4)


def test_start_pose_is_the_papers(actuation: Actuation) -> None:
    """Arms down with bent elbows, hips and ankles at 30 degrees, knees at 60, in the simulator's signs."""
    pose = np.rad2deg(actuation.robot.nominal)
    index = nao_model.model(0).joint_index
    expected = {"laj1": -90, "raj1": -90, "laj3": -90, "raj3": 90, "laj4": -90, "raj4": 90}
    expected |= {"llj3": 30, "rlj3": 30, "llj4": -60, "rlj4": -60, "llj5": 30, "rlj5": 30}
    for name, place in index.items():
        assert pose[place] == pytest.approx(expected.get(name, 0.0)), name


def test_policies_see_the_papers_signs(actuation: Actuation) -> None:
    """In the start pose a policy sees shoulders at 90, hips at -30, knees at 60 and ankles at -30 on both sides."""
    seen = np.rad2deg(actuation.angles(np.rad2deg(actuation.robot.nominal)[None])[0])
    by_name = dict(zip(actuation.names, seen, strict=True))
    for side in "lr":
        found = [by_name[f"{side}{joint}"] for joint in ("aj1", "lj3", "lj4", "lj5")]
        assert found == pytest.approx([90.0, -30.0, 60.0, -30.0])
