"""The mirror of vectors of named numbers, and that of robots."""

from __future__ import annotations

import numpy as np
import pytest
from naosim.robots import Robot
from naosim.robots.booster import K1, T1
from naospec import TrainingSpec
from naospec.flat import nest
from naosprint.mirror import Mirror
from naosprint.tasks.environment import open_training_environment
from naosprint.tasks.sprint import Sprint1

from .boosters import action_mirror, mirrored_pair, symmetric_environment


@pytest.mark.parametrize("robot_type", range(5))
def test_mirrored_actions_give_the_mirrored_run(robot_type: int) -> None:
    """The simulation of a robot and its mirror image shows which observations change sign."""
    settings = {
        "robot": f"nao-{robot_type}",
        "n_envs": 2,
        "n_steps": 8,
        "batch_size": 16,
        "sensor_digits": None,
        "start_noise_deg": 0.0,
        "simulator_threads": 1,
    }
    environment, _ = open_training_environment(TrainingSpec.model_validate(nest(settings)))
    environment.restart(np.arange(2), np.zeros(2, dtype=np.int64))
    observations = environment.observer.mirror
    actions = Mirror.of_names(environment.actuation.names, *environment.actuation.mirror)
    low, high = environment.actuation.low_rad, environment.actuation.high_rad
    rest = 2.0 * (environment.observations[0, 1 : 1 + len(low)] - low) / (high - low) - 1.0
    rng = np.random.default_rng(0)
    for _ in range(25):
        action = rest + 0.4 * rng.standard_normal(len(low))
        seen = environment.step(np.stack([action, actions.apply(action)]))
        np.testing.assert_allclose(observations.apply(seen[0]), seen[1], atol=1e-6)
    # it moved to one side, so that not all compared values are zero
    y = environment.simulator.truth.torso_position[:, 1]
    assert abs(y[0]) > 1e-3
    assert y[0] == pytest.approx(-y[1], abs=1e-8)


@pytest.mark.parametrize("robot", [T1, K1], ids=lambda robot: robot.name)
def test_mirrored_actions_give_the_mirrored_run_of_a_booster(robot: Robot) -> None:
    """The same in MuJoCo's world, delay of the actions included, from a start that is not symmetric."""
    environment = symmetric_environment(robot, Sprint1)
    rng = np.random.default_rng(0)
    pose = robot.nominal + rng.uniform(-0.02, 0.02, len(robot.joints))
    environment.load_starts(mirrored_pair(robot, pose))
    environment.restart(np.arange(2), np.arange(2))
    observations, actions = environment.observer.mirror, action_mirror(environment)
    for _ in range(25):
        np.testing.assert_allclose(
            environment.observations[1], observations.apply(environment.observations[0]), atol=1e-6
        )
        action = 0.5 * rng.standard_normal(environment.actuation.n_actions)
        environment.step(np.stack([action, actions.apply(action)]))
        assert environment.rewards[1] == pytest.approx(environment.rewards[0], abs=1e-6)
    # it moved to one side, so that not all compared values are zero
    y = environment.simulator.truth.torso_position[:, 1]
    assert abs(y[0]) > 1e-3
    assert y[0] == pytest.approx(-y[1], abs=1e-9)


def test_mirroring_twice_changes_nothing() -> None:
    """It is an involution."""
    mirror = Mirror.of_names(
        ("step", "llj1", "rlj1", "yaw", "yaw_rate", "left_foot_force_x", "right_foot_force_x"),
        ("step", "rlj1", "llj1", "yaw", "yaw_rate", "right_foot_force_x", "left_foot_force_x"),
        (1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0),
    )
    vector = np.arange(1.0, 8.0)
    np.testing.assert_array_equal(mirror.apply(vector), [1, 3, 2, -4, -5, -7, -6])
    np.testing.assert_array_equal(mirror.apply(mirror.apply(vector)), vector)


def test_missing_partner_is_named() -> None:
    """A robot with one arm has no mirror image."""
    with pytest.raises(ValueError, match="laj1: its mirror image raj1"):
        Mirror.of_names(("step", "laj1"), ("step", "raj1"), (1.0, 1.0))


def test_odd_layer_is_refused() -> None:
    """Units form pairs."""
    with pytest.raises(ValueError, match=r"hidden_sizes.*even width, got 7"):
        Mirror.of_pairs(7)
