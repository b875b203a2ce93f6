"""Penalties that several tasks share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from naosim import robots
from naosim.simulator import Simulator, Starts
from naospec import TrainingSpec
from naosprint.tasks.environment import Environment
from naosprint.tasks.penalties import hopping
from naosprint.tasks.sprint import Sprint1, SprintSettings
from naosprint.tasks.world import World
from pydantic import ValidationError

LEGS = ("hip_pitch", "knee_pitch", "hip_roll")


@pytest.fixture
def simulator() -> Simulator:
    mujoco = pytest.importorskip("naosim.mujoco.embedded")
    simulator: Simulator = mujoco.MujocoSimulator(robots.get("t1"), 2)
    simulator.load_starts(Starts(np.zeros((1, len(simulator.robot.joints)))))
    simulator.start(np.arange(2), np.zeros(2, dtype=np.int64))
    return simulator


def test_legs_that_move_alike_are_hopping_and_legs_in_turn_are_not(simulator: Simulator) -> None:
    world = World(simulator)
    term = hopping(world, 0.5)
    assert term.weight == -0.5
    speeds = simulator.perceptors["joint_speeds"]
    for row, right in enumerate((1.0, -1.0)):
        speeds[row] = 0.0
        for number, joint in enumerate(simulator.robot.joints):
            if joint.name.endswith(LEGS):
                # in the convention of policies a mirrored posture has the same numbers on both sides
                speeds[row, number] = 300.0 * joint.sign * (right if joint.side == "right" else 1.0)
    alike, opposite = term.value(slice(0, 2))
    assert 0.9 < alike < 1.0
    assert opposite == 0.0
    speeds *= 0.01
    assert term.value(slice(0, 1))[0] < 0.02  # a robot that hardly moves does not hop


def test_joints_without_limits_of_torque_or_without_sides_are_no_reason_for_nan(simulator: Simulator) -> None:
    robot = simulator.robot
    simulator.robot = replace(robot, joints=tuple(replace(joint, max_torque=np.inf) for joint in robot.joints))
    simulator.perceptors["joint_speeds"][:] = 300.0
    assert np.isfinite(hopping(World(simulator), 1.0).value(slice(0, 2))).all()
    middle = tuple(joint if joint.side == "centre" else replace(joint, actuated=False) for joint in robot.joints)
    simulator.robot = replace(robot, joints=middle)
    with pytest.raises(ValueError, match=r"task\.hop_penalty: robot t1 has no actuated joints on the left"):
        hopping(World(simulator), 1.0)


def test_the_reward_falls_by_the_penalty(simulator: Simulator) -> None:
    rewards = {}
    for weight in (0.0, 0.01):
        settings = Sprint1.resolve(SprintSettings(name="sprint1", hop_penalty=weight), simulator.robot)
        environment = Environment(simulator, Sprint1, settings)
        environment.load_starts(environment.task.starts(1, 0, 0.0))
        environment.restart(np.arange(2), np.zeros(2, dtype=np.int64))
        for _ in range(5):
            environment.step(np.full((2, environment.actuation.n_actions), 0.3))
        rewards[weight] = environment.rewards.copy()
        expected = hopping(environment.world, 1.0).value(slice(0, 2))[:, 0]
    assert (expected > 0.5).all()
    np.testing.assert_allclose(rewards[0.0] - rewards[0.01], 100.0 * 0.01 * expected, rtol=1e-9)


def test_a_robot_without_joint_speeds_is_refused_by_name() -> None:
    with pytest.raises(
        ValidationError, match=r"task.hop_penalty\n.*0.1 needs perceptor joint_speeds, which robot nao-0"
    ):
        TrainingSpec.model_validate({"robot": "nao-0", "task": {"name": "sprint1", "hop_penalty": 0.1}})
