"""The joint controller of NAOs."""

from __future__ import annotations

import numpy as np
import pytest
from naosim import robots
from naosim.robots import nao_model
from naosim.robots.actuation import Actuation
from naosim.simspark.control import motor_speeds


def test_neck_is_held_at_zero() -> None:
    """No action moves the neck, and the controller brings it back."""
    targets = Actuation(robots.get("nao-0")).targets(np.ones((1, 20)))
    assert np.array_equal(targets[0, :2], [0.0, 0.0])
    angles = np.zeros((1, 22))
    angles[0, 0] = 10.0
    assert motor_speeds(targets, angles, nao_model.model(0).max_speed)[0, 0] == pytest.approx(-7 * np.deg2rad(10))


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
