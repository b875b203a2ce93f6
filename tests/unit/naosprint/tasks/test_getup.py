"""The task getup: lying starts, rewards, when a robot stands, resuming, and what an evaluation reports."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from naosim.mujoco.embedded import MujocoSimulator
from naosim.robots import Robot
from naosim.robots.booster import K1, T1
from naosim.simulator import STEP_S, Starts
from naosprint.tasks.environment import Environment
from naosprint.tasks.episodes import Episodes, Statistics
from naosprint.tasks.getup import HOLD_STEPS, STANDING_HEIGHT, STANDING_UP, GetUp, GetUpSettings, time_numbers
from naosprint.tasks.motions import motions
from naosprint.terms import source

from ..boosters import action_mirror, mirrored_pair, symmetric_environment  # noqa: TID252

WIDE = T1.with_parameters({"action_range_rad": 3.2})
"""A robot whose actions reach the angles of the motions."""

BOTH = pytest.mark.parametrize("robot", [T1, K1], ids=lambda robot: robot.name)


def environment_of(n: int, robot: Robot = T1, **settings: Any) -> Environment:
    """Return n lying robots."""
    parameters = GetUp.resolve(GetUpSettings(name="getup", **settings), robot)
    environment = Environment(MujocoSimulator(robot, n), GetUp, parameters)
    environment.load_starts(environment.task.starts(n, 0, 0.0))
    environment.restart(np.arange(n), np.arange(n))
    return environment


def standing(n: int, **settings: Any) -> Environment:
    """Return n robots that stand."""
    environment = environment_of(n, **settings)
    environment.load_starts(Starts(T1.nominal[None]))
    environment.restart(np.arange(n), np.zeros(n, dtype=np.int64))
    return environment


def hold(environment: Environment) -> np.ndarray:
    """Return the actions that keep the nominal pose."""
    return np.zeros((environment.n, environment.actuation.n_actions))


@BOTH
def test_robots_start_lying_on_every_side(robot: Robot) -> None:
    """On the front, the back and both sides in turn, at rest on the ground, with limbs at random."""
    environment = environment_of(8, robot)
    truth = environment.simulator.truth
    assert (truth.torso_position[:, 2] < 0.5 * robot.standing_height_m).all()
    assert (np.abs(truth.torso_rotation[:, 2, 2]) < 0.8).all()
    facing = truth.torso_rotation[:, 2, 0]  # upward component of the front
    assert facing.max() > 0.6 and facing.min() < -0.6
    sideways = truth.torso_rotation[:, 2, 1]
    assert sideways.max() > 0.5 and sideways.min() < -0.5
    assert (np.ptp(environment.simulator.perceptors["joint_angles"], axis=0) > 5.0).sum() > len(robot.joints) / 2
    again = environment.task.starts(8, 0, 0.0)
    np.testing.assert_array_equal(again.poses_rad, environment.task.starts(8, 0, 5.0).poses_rad)
    assert not np.array_equal(again.poses_rad, environment.task.starts(8, 1, 0.0).poses_rad)
    low = np.array([joint.low_rad for joint in robot.joints])
    high = np.array([joint.high_rad for joint in robot.joints])
    assert ((again.poses_rad >= low) & (again.poses_rad <= high)).all()
    assert "heading_sin" not in environment.observer.names


@pytest.mark.parametrize(
    ("fraction", "quarters"), [(0.5, [0, 1, 2, 3]), (1.0, [0, 2, 0, 2]), (0.0, [1, 3, 1, 3]), (0.75, [0, 2, 0, 1])]
)
def test_a_fraction_of_the_robots_tips_over_sideways(fraction: float, quarters: list[int]) -> None:
    """0 is the right side, 1 the front, 2 the left, 3 the back: the head's horizontal direction from the feet."""
    task = environment_of(4, side_fraction=fraction).task
    w, x, y, z = task.starts(4, 0, 0.0).orientations.T
    # the torso's z axis before the turn about the vertical, which the torso's own x and y axes show
    rising = np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x)], axis=1)  # upward components of x and y axes
    found = np.select(
        [np.abs(rising[:, 1]) > np.abs(rising[:, 0])],
        [np.where(rising[:, 1] > 0.0, 0, 2)],
        np.where(rising[:, 0] < 0.0, 1, 3),
    )
    assert found.tolist() == quarters


def test_evaluations_have_as_many_robots_on_the_sides_as_on_front_and_back() -> None:
    assert GetUpSettings(
        name="getup", side_fraction=0.9, episode_steps=150, pose_noise_deg=5.0
    ).for_evaluation() == GetUpSettings(name="getup", side_fraction=0.5, pose_noise_deg=5.0)


def test_demonstrations_stand_up_from_every_side() -> None:
    """The scripted motions alone, with the noise of 0.1 rad of a policy that explores; nobody balances after them."""
    environment = environment_of(64, WIDE)
    held, best, rng = np.zeros(64), np.zeros(64), np.random.default_rng(0)
    for _ in range(190):
        shown = environment.task.demonstration(slice(0, 64))
        assert shown is not None
        environment.step(shown + rng.normal(0.0, 0.1 / 3.2, shown.shape))
        truth = environment.simulator.truth
        tall = truth.torso_position[:, 2] > STANDING_HEIGHT * T1.standing_height_m
        held = np.where(tall & (truth.torso_rotation[:, 2, 2] > STANDING_UP), held + 1, 0)
        best = np.maximum(best, held)
    stood = (best >= HOLD_STEPS).reshape(-1, 4).mean(axis=0)
    assert (stood > 0.1).all() and stood.mean() > 0.3, stood


def test_a_mirrored_motion_moves_the_other_side() -> None:
    motion = motions("getup", T1)["right"]
    mirrored, names = motion.mirrored(T1), [joint.name for joint in T1.joints]
    targets, others = motion.targets(T1), mirrored.targets(T1)
    assert np.abs(targets - others).max() > 0.5
    for index, joint in enumerate(T1.joints):
        side, _, end = joint.name.partition("_")
        partner = names.index({"left": "right_", "right": "left_"}[side] + end) if side in ("left", "right") else index
        sign = joint.mirror_sign if partner == index else joint.sign * T1.joints[partner].sign
        np.testing.assert_array_equal(targets[:, index], sign * others[:, partner], err_msg=joint.name)
    assert mirrored.mirrored(T1) == motion


def test_a_robot_without_a_motion_demonstrates_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert environment_of(4, K1).task.demonstration(slice(0, 4)) is not None
    monkeypatch.setattr("naosprint.tasks.getup.motions", lambda _task, _robot: {})
    assert environment_of(4, K1).task.demonstration(slice(0, 4)) is None


def test_the_time_is_observed_until_nothing_follows() -> None:
    numbers = time_numbers(source(np.array([0, 1, 100, 200, 240])))(slice(None))
    assert numbers.shape == (5, 13) and (np.abs(numbers) <= 1.0).all()
    assert numbers[:, 0] == pytest.approx([0.0, 0.005, 0.5, 1.0, 1.0])
    np.testing.assert_array_equal(numbers[3], numbers[4])
    assert np.abs(numbers[0] - numbers[1]).max() > 0.05


def test_the_reward_is_for_height_an_upright_torso_and_the_nominal_pose() -> None:
    """Recomputed from what the simulator reports, for lying and for standing robots."""
    lying, upright = environment_of(4, pose_weight=0.7), standing(2, pose_weight=0.7)
    for environment, expected_standing in ((lying, False), (upright, True)):
        scale = environment.task.parameters.reward_scale
        for _ in range(5):
            environment.step(hold(environment))
            truth = environment.simulator.truth
            height, up = truth.torso_position[:, 2], truth.torso_rotation[:, 2, 2]
            stands = (height > STANDING_HEIGHT * T1.standing_height_m) & (up > STANDING_UP)
            assert (stands == expected_standing).all()
            angles = environment.actuation.angles(environment.simulator.perceptors["joint_angles"])
            off = 4.0 * np.square(angles - environment.actuation.nominal).mean(axis=1)
            squared = np.square(np.clip(height / T1.standing_height_m, 0.0, 1.0))
            expected = squared + 0.25 * (1.0 + up) * squared
            expected += stands * (1.0 + 0.7 * np.exp(-off))
            np.testing.assert_allclose(environment.rewards, scale * expected, atol=1e-9)
    assert upright.rewards.min() > 1.5 * lying.rewards.max()


def test_a_robot_stands_once_it_has_stayed_up_for_half_a_second() -> None:
    environment = standing(2, episode_steps=HOLD_STEPS + 5)
    rows = np.arange(2)
    for step in range(1, HOLD_STEPS + 6):
        environment.step(hold(environment))
        assert not environment.terminated.any()
        assert environment.truncated.all() == (step == HOLD_STEPS + 5)
        on_feet, in_time = environment.task.measure(rows).T
        assert on_feet.all()
        assert in_time.all() == (step >= HOLD_STEPS)
    stood_at, held = environment.task.trace_row(rows).T
    assert (stood_at == 1).all() and (held == HOLD_STEPS + 5).all()
    environment.restart(np.array([0]), np.array([0]))
    np.testing.assert_array_equal(environment.task.trace_row(rows), [[0, 0], [1, HOLD_STEPS + 5]])


def test_a_lying_robot_never_stands() -> None:
    environment = environment_of(4)
    for _ in range(30):
        environment.step(hold(environment))
    assert not environment.terminated.any()
    np.testing.assert_array_equal(environment.task.measure(np.arange(4)), np.zeros((4, 2)))


@BOTH
def test_disturbances_grow_with_robots_that_stand_in_time(robot: Robot) -> None:
    environment = environment_of(3, robot, sensor_noise=1.0, disturbance_growth=0.25)
    for stood, strength in ((0, 0.0), (20, 0.25), (20, 0.5), (200, 0.25)):
        environment.world.steps[:] = 250
        environment.task.arrays["stood_at"][:] = stood
        environment.restart(np.arange(3), np.zeros(3, dtype=np.int64))
        assert environment.disturbances.strength == strength


@BOTH
def test_a_resumed_environment_continues_bit_for_bit(robot: Robot) -> None:
    environment = environment_of(4, robot)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (40, 4, environment.actuation.n_actions))
    for action in actions[:15]:
        environment.step(action)
    state = environment.state()
    resumed = environment_of(4, robot)
    resumed.load_state({name: array.copy() for name, array in state.items()})
    for action in actions[15:]:
        np.testing.assert_array_equal(resumed.step(action), environment.step(action))
        np.testing.assert_array_equal(resumed.rewards, environment.rewards)
    rows = np.arange(4)
    np.testing.assert_array_equal(resumed.task.trace_row(rows), environment.task.trace_row(rows))


def test_a_robot_that_stood_before_a_pause_has_stood_after_it() -> None:
    environment = standing(1)
    for _ in range(HOLD_STEPS - 5):
        environment.step(hold(environment))
    resumed = standing(1)
    resumed.load_state(environment.state())
    for _ in range(5):
        resumed.step(hold(resumed))
    assert resumed.task.trace_row(np.arange(1)).tolist() == [[1.0, HOLD_STEPS]]


@BOTH
def test_a_mirrored_robot_is_seen_and_rewarded_alike(robot: Robot) -> None:
    """It falls over from an oblique start, so that every component of its orientation counts."""
    environment = symmetric_environment(robot, GetUp, torque_penalty=0.1)
    rng = np.random.default_rng(3)
    oblique = np.array([0.8, 0.4, 0.3, 0.2])
    pose = robot.nominal + rng.uniform(-0.1, 0.1, len(robot.joints))
    # in the air, before any contact: lying robots have contacts that are not symmetric to the last bit
    environment.simulator.parameters = environment.simulator.parameters.model_copy(update={"settle_steps": 1})  # type: ignore[attr-defined]
    environment.load_starts(mirrored_pair(robot, pose, oblique))
    environment.restart(np.arange(2), np.arange(2))
    mirror, actions = environment.observer.mirror, action_mirror(environment)
    np.testing.assert_allclose(environment.observations[1], mirror.apply(environment.observations[0]), atol=1e-6)
    for step in range(10):
        action = 0.5 * rng.standard_normal(environment.actuation.n_actions)
        seen = environment.step(np.stack([action, actions.apply(action)]))
        np.testing.assert_allclose(seen[1], mirror.apply(seen[0]), atol=1e-5, err_msg=f"step {step}")
        assert environment.rewards[1] == pytest.approx(environment.rewards[0], abs=1e-5)


def test_an_evaluation_reports_how_often_and_how_fast_robots_stand() -> None:
    """Up in time and still up, up too late, up and down again, never up."""
    stood, held = [50.0, 200.0, 20.0, 0.0], [30.0, 40.0, 0.0, 0.0]
    samples, zeros = 251, [np.zeros(251)] * 4
    trace = [np.tile([s, h], (samples, 1)) for s, h in zip(stood, held, strict=True)]
    episodes = Episodes(
        x=zeros,
        y=zeros,
        height=[np.full(samples, height) for height in (0.6, 0.6, 0.2, 0.2)],
        up=zeros,
        feet=[np.zeros((samples, 2))] * 4,
        airborne=[np.zeros(samples, dtype=np.bool_)] * 4,
        trace=trace,
        ends={},
        max_steps=250,
    )
    results, tables = environment_of(1).task.summarize(episodes, Statistics(0.95, 100, 0))
    found = {result.metric.name: result for result in results}
    assert tables == ()
    assert (found["success_rate"].count, found["standing_rate"].count) == (2, 2)
    assert found["time_s"].episodes == 3 and found["time_s"].high == pytest.approx(200 * STEP_S)
    assert found["final_height_m"].value == pytest.approx(0.4)
    assert set(GetUp.presentation.headline) <= found.keys()
