"""Yaw and height as a player estimates them."""

from __future__ import annotations

import naopolicies
import numpy as np
import pytest
from naosim import robots
from naosim.robots import Robot
from naosim.simspark import EmbeddedSimulator
from naosim.simulator import Truth
from naosprint.rl.policy import load_policy
from naosprint.tasks.environment import Environment
from naosprint.tasks.observations import Observer, blocks
from naosprint.tasks.onboard_pose import OnboardPose
from naosprint.tasks.robot_defaults import robot_defaults
from naosprint.tasks.sprint import Sprint1, SprintSettings
from naosprint.tasks.world import World

N, STEPS = 16, 300


def opened(robot: Robot, n: int = N) -> Environment:
    settings = Sprint1.resolve(SprintSettings(name="sprint1"), robot)
    environment = Environment(EmbeddedSimulator(robot, n), Sprint1, settings)
    environment.load_starts(environment.task.starts(n, 3, 2.0))
    environment.restart(np.arange(n), np.arange(n))
    return environment


def onboard(robot_type: int = 0) -> Robot:
    return robots.get(f"nao-{robot_type}").with_parameters({"onboard_sensing": True})


@pytest.fixture(scope="module")
def errors() -> np.ndarray:
    """(steps, robots, 3): errors of yaw, of yaw against a step before, and of height, in a run by the true pose."""
    environment = opened(onboard())
    policy, manifest = load_policy(naopolicies.folder("sprint"))
    true = Observer(N, blocks(environment.world, robot_defaults(robots.get("nao-0")).observations))
    everyone = slice(0, N)
    true.begin(np.arange(N))
    found, yaw_before = [], environment.world.yaw(everyone)
    for _ in range(STEPS):
        environment.step(policy.act(true.observations))
        true.update(everyone)
        yaw, height = (
            environment.observations[:, environment.observer.names.index(name)] for name in ("yaw", "height")
        )
        now = environment.world.yaw(everyone)
        found.append(
            np.stack([yaw - now, yaw - yaw_before, height - environment.world.position(everyone)[:, 2]], axis=1)
        )
        yaw_before = now
    assert true.names == manifest.observations
    environment.close()
    errors = np.array(found)
    errors[..., :2] = (errors[..., :2] + np.pi) % (2 * np.pi) - np.pi
    return errors


def test_the_estimates_follow_a_run(errors: np.ndarray) -> None:
    """A torso that swings by 28 degrees and bobs by 13 mm is known to some degrees and millimetres, a step ahead."""
    running = errors[50:]
    assert np.degrees(np.sqrt((running[..., 0] ** 2).mean())) < 7.0
    assert np.degrees(np.sqrt((running[..., 1] ** 2).mean())) > 7.0, "not extrapolated"
    assert np.sqrt((running[..., 2] ** 2).mean()) < 0.016
    # no drift: the direction is known to a fraction of a degree over seconds
    assert np.degrees(np.abs(running[..., 0].mean(axis=0))).max() < 1.5
    assert np.abs(running[..., 2].mean(axis=0)).max() < 0.01


def test_a_start_that_faces_elsewhere_is_noticed_by_vision() -> None:
    robot = onboard()
    environment = opened(robot, 3)
    starts = environment.task.starts(3, 0, 0.0)
    turned = 0.15
    environment.simulator.load_starts(type(starts)(starts.poses_rad, starts.position_m, heading_rad=turned))
    environment.restart(np.arange(3), np.zeros(3, np.int64))
    yaw = environment.observer.names.index("yaw")
    assert environment.observations[:, yaw] == pytest.approx(0.0)
    for _ in range(60):
        environment.step(np.zeros((3, environment.actuation.n_actions)))
    assert environment.observations[:, yaw] == pytest.approx(environment.world.yaw(slice(0, 3)), abs=np.radians(0.4))
    assert environment.observations[:, yaw] == pytest.approx(turned, abs=0.05)
    environment.close()


@pytest.mark.parametrize("robot_type", [0, 3, 4])
def test_the_height_of_a_standing_robot_is_estimated(robot_type: int) -> None:
    environment = opened(onboard(robot_type), 4)
    height = environment.observer.names.index("height")
    true = environment.world.position(slice(0, 4))[:, 2]
    assert environment.observations[:, height] == pytest.approx(true, abs=0.01)
    environment.close()


def test_nothing_of_it_is_the_truth() -> None:
    environment = opened(onboard(), 4)
    estimate = OnboardPose(environment.world)
    blind = World(environment.simulator)
    rng = np.random.default_rng(0)
    for store in estimate.stores:
        store.apply(store.begin, np.arange(4))
    for _ in range(40):
        environment.step(rng.normal(0.0, 0.5, (4, environment.actuation.n_actions)))
        truth = environment.simulator.truth
        environment.simulator.truth = Truth(np.full((4, 3), np.nan), np.full((4, 3, 3), np.nan))
        for store in estimate.stores:
            store.apply(store.update, slice(0, 4))
        for block in blocks(blind, environment.world.defaults.observations):
            assert np.isfinite(block.value(slice(0, 4))).all(), block.names
        environment.simulator.truth = truth
        assert all(np.isfinite(array).all() for array in estimate.arrays.values())
    environment.close()


def test_a_run_continues_from_its_state() -> None:
    robot = onboard()
    first, second = opened(robot), opened(robot)
    rng = np.random.default_rng(1)
    actions = rng.normal(0.0, 0.4, (60, N, first.actuation.n_actions))
    for step in range(30):
        first.step(actions[step])
    second.load_state(first.state())
    for step in range(30, 60):
        assert np.array_equal(first.step(actions[step]), second.step(actions[step]), equal_nan=True)
    for environment in (first, second):
        environment.close()
