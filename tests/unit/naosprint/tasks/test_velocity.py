"""The task velocity: commands, rewards, ends, resuming, and what an evaluation reports."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from naosim.mujoco.embedded import MujocoSimulator
from naosim.robots import Robot
from naosim.robots.booster import K1, T1
from naosim.simulator import CONTACT_N, STEP_S, Simulator, Starts
from naospec import EvaluationSpec, TrainingSpec
from naosprint.tasks.commands import FIRST_RANGE, SETTLING_S
from naosprint.tasks.environment import Environment, open_environment
from naosprint.tasks.episodes import Episodes, Statistics
from naosprint.tasks.velocity import FLIGHT_SPEED_MPS, OFFSET_LIMIT_M, TRACKING_SCALE, Velocity, VelocitySettings
from naosprint.tasks.velocity_results import applied
from pydantic import ValidationError

from ..boosters import action_mirror, mirrored_pair, symmetric_environment  # noqa: TID252

ALL = {"stand_fraction": 0.0, "straight_fraction": 0.0, "command_steps": 20}


def environment_of(n: int, *, seed: int = 0, robot: Robot = T1, **settings: Any) -> Environment:
    """Return n robots at their starts."""
    parameters = Velocity.resolve(VelocitySettings(name="velocity", **{**ALL, **settings}), robot)
    environment = Environment(MujocoSimulator(robot, n), Velocity, parameters, seed)
    environment.load_starts(environment.task.starts(n, 0, 2.0))
    environment.restart(np.arange(n), np.arange(n))
    return environment


def task_of(environment: Environment) -> Velocity:
    assert isinstance(environment.task, Velocity)
    return environment.task


def gentle(environment: Environment, steps: int, seed: int = 0) -> np.ndarray:
    """Return (steps, n, A) actions that robots survive for a while."""
    shape = (steps, environment.n, environment.actuation.n_actions)
    return 0.3 * np.random.default_rng(seed).uniform(-1.0, 1.0, shape)


def commands(environment: Environment, actions: np.ndarray, active: np.ndarray | None = None) -> np.ndarray:
    """Step with (steps, n, A) actions; return the (steps + 1, n, 3) commands on the way."""
    task = task_of(environment)
    found = [task.command.copy()]
    for action in actions:
        environment.step(action, active)
        found.append(task.command.copy())
    return np.array(found)


def test_commands_are_drawn_from_the_ranges() -> None:
    environment = environment_of(
        64, forward_min_mps=-0.5, forward_max_mps=1.5, sideways_max_mps=0.4, turn_max_rad_s=0.8, stand_fraction=0.2
    )
    task = task_of(environment)
    drawn = []
    for _ in range(40):
        environment.task.begin(np.arange(64))
        drawn.append(task.command.copy())
    found = np.concatenate(drawn)
    still = (found == 0.0).all(axis=1)
    assert still.mean() == pytest.approx(0.2, abs=0.03)
    low, high = np.array([-0.5, -0.4, -0.8]), np.array([1.5, 0.4, 0.8])
    moving = found[~still]
    assert (moving >= low).all() and (moving <= high).all()
    np.testing.assert_allclose(moving.min(axis=0), low, atol=0.02)
    np.testing.assert_allclose(moving.max(axis=0), high, atol=0.02)
    np.testing.assert_allclose(moving.mean(axis=0), (low + high) / 2, atol=0.05)
    straight = task_of(environment_of(256, straight_fraction=0.5)).command
    assert ((straight[:, 1:] == 0.0).all(axis=1)).mean() == pytest.approx(0.5, abs=0.1)


def test_combined_commands_can_stay_within_an_ellipsoid() -> None:
    limits = {"forward_min_mps": -1.0, "forward_max_mps": 3.0, "sideways_max_mps": 1.0, "turn_max_rad_s": 2.0}
    free = task_of(environment_of(512, **limits)).command
    within = task_of(environment_of(512, command_ellipsoid=True, **limits)).command

    def lengths(command: np.ndarray) -> np.ndarray:
        ahead = np.where(command[:, 0] > 0.0, command[:, 0] / 3.0, command[:, 0] / -1.0)
        return np.asarray(np.sqrt(ahead**2 + command[:, 1] ** 2 + (command[:, 2] / 2.0) ** 2))

    assert lengths(free).max() > 1.3
    np.testing.assert_allclose(lengths(within), np.minimum(lengths(free), 1.0), rtol=1e-12)
    np.testing.assert_allclose(within * np.maximum(lengths(free), 1.0)[:, None], free, rtol=1e-12)
    flat = task_of(environment_of(64, command_ellipsoid=True, **{**limits, "turn_max_rad_s": 0.0})).command
    assert np.isfinite(flat).all() and (flat[:, 2] == 0.0).all()


def test_the_range_of_commands_grows_with_those_that_are_followed() -> None:
    """A robot that stands still follows slow commands only; nothing grows in an evaluation."""
    whole = {"forward_min_mps": 0.0, "forward_max_mps": 1.0, "sideways_max_mps": 0.0, "turn_max_rad_s": 0.0}
    growing = {**whole, "command_growth": 0.25, "command_error_mps": 0.2, "command_steps": 60}
    environment = environment_of(32, **growing)
    task, nowhere = task_of(environment), np.zeros((32, environment.actuation.n_actions))
    assert task.growth == 0.0 and task.command[:, 0].max() <= FIRST_RANGE
    assert task_of(environment_of(1)).growth is None
    steps, error, up = np.zeros(32), np.zeros(32), np.ones(32, dtype=np.bool_)
    followed = missed = 0
    for _ in range(200):
        command, before = task.command[:, 0].copy(), task.arrays["grown"].copy()
        environment.step(nowhere)
        steps, up = steps + 1, up & ~environment.ends["fallen"]
        error += 0.04 * (np.hypot(task.velocity[:, 0] - command, task.velocity[:, 1]) - error)
        renewed, change = up & (task.command[:, 0] != command), task.arrays["grown"] - before
        rated = renewed & (steps >= SETTLING_S / STEP_S)
        good, bad = rated & (error < 0.2), rated & (error > 0.2)
        np.testing.assert_array_equal(change[good], np.minimum(0.25, 1.0 - before[good]))
        np.testing.assert_array_equal(change[bad], -np.minimum(0.25, before[bad]))
        assert (change[up & ~rated] == 0.0).all()
        scale = FIRST_RANGE + (1.0 - FIRST_RANGE) * task.arrays["grown"]
        assert (task.command[:, 0] <= scale)[renewed].all()
        followed, missed = followed + good.sum(), missed + bad.sum()
        steps[task.command[:, 0] != command] = 0
    assert followed and missed and 0.0 < task.growth < 1.0
    fall = nowhere.copy()
    fall[0] = 1.0
    before = np.maximum(task.arrays["grown"], 0.5)
    task.arrays["grown"][:] = before
    environment.restart(np.arange(32), np.zeros(32, dtype=np.int64))
    task.arrays["command_steps"][:] = -1000  # no command is rated any more
    environment.step(fall)
    while not environment.terminated[0]:
        environment.step(fall)
    assert task.arrays["grown"][0] == before[0] - 0.25
    trained = TrainingSpec.model_validate(
        {"task": {"name": "velocity", "command_growth": 0.1, "command_ellipsoid": True}, "robot": "t1"}
    )
    evaluated = EvaluationSpec().applied_to(trained).task
    assert (evaluated.command_growth, evaluated.command_ellipsoid) == (0.0, True)


def test_commands_can_be_approached() -> None:
    """What the policy observes moves towards the command by the accelerations; results are about the command itself."""
    limits = {"forward_acceleration_mps2": 3.0, "turn_acceleration_rad_s2": 4.0}
    environment, at_once = environment_of(8, **limits), environment_of(8)
    task, most = task_of(environment), np.array([3.0, np.inf, 4.0]) * STEP_S
    columns = [environment.observer.names.index(f"command_{name}") for name in ("forward", "sideways", "turn")]
    np.testing.assert_array_equal(environment.observations[:, columns], 0.0)
    reference = np.zeros((8, 3))
    for action in gentle(environment, 100):
        environment.step(action)
        at_once.step(action)
        reference += np.clip(task.command - reference, -most, most)
        np.testing.assert_allclose(environment.observations[:, columns], reference, rtol=0.0, atol=1e-12)
        np.testing.assert_array_equal(task.trace_row(np.arange(8))[:, 3:6], task.command)
    np.testing.assert_array_equal(task.command, task_of(at_once).command)
    np.testing.assert_array_equal(at_once.observations[:, columns], task.command)
    assert (reference[:, 0] == task.command[:, 0]).any() and (reference[:, 0] != task.command[:, 0]).any()


def test_episodes_begin_with_states_of_other_policies() -> None:
    """In the middle of a step, with the latest action; the command is approached from the speed that the robot has."""
    entry = {"entry_policies": ("t1-run",), "entry_fraction": 0.5, "handover_states": 32}
    environment = environment_of(64, forward_acceleration_mps2=3.0, **entry)
    task, everyone = task_of(environment), np.arange(64)
    environment.load_starts(task.starts(8, 0, 2.0))
    environment.restart(everyone, everyone % 8)
    assert task._entered is not None
    states, names = task._entered.states, environment.observer.names
    seen = environment.observations[:, [names.index(f"velocity_{axis}") for axis in "xyz"]]
    entered = seen.any(axis=1)
    assert len(states) == 32
    assert 16 < entered.sum() < 48
    numbers = task._entered.numbers[entered]
    np.testing.assert_array_equal(seen[entered], states.velocity[numbers])
    np.testing.assert_array_equal(environment.world.actions[entered], states.actions[numbers])
    assert not environment.world.actions[~entered].any()
    wanted = environment.observations[:, names.index("command_forward")]
    np.testing.assert_array_equal(wanted, seen[:, 0])
    assert np.ptp(wanted) > 0.5
    before = numbers.copy()
    environment.restart(everyone, everyone % 8)
    assert (task._entered.numbers[entered] != before).any()


def test_evaluations_begin_from_a_stand_and_last_as_long_as_those_of_other_policies() -> None:
    trained = VelocitySettings(name="velocity", entry_policies=("t1-run",), episode_steps=300, command_growth=0.1)
    assert trained.for_evaluation() == VelocitySettings(name="velocity")


def test_commands_depend_on_the_seed_and_on_nothing_that_other_robots_do() -> None:
    """A robot's commands are the same alone in motion, among others, and for any own action."""
    first = environment_of(4)
    actions = gentle(first, 60)
    found = commands(first, actions)
    np.testing.assert_array_equal(commands(environment_of(4), actions), found)
    only_two = commands(environment_of(4), gentle(first, 60, seed=1), np.array([False, False, True, True]))
    np.testing.assert_array_equal(only_two[:, 2:], found[:, 2:])
    np.testing.assert_array_equal(commands(environment_of(2), actions[:, :2]), found[:, :2])
    assert not np.array_equal(commands(environment_of(4, seed=1), actions)[0], found[0])
    changed = (np.diff(found, axis=0) != 0.0).any(axis=2)
    assert changed.any(axis=0).all()  # every robot was given new commands on the way,
    assert changed.sum() == pytest.approx(4 * 60 / 20, abs=8)  # as often as asked for,
    assert not (changed[:, 0] == changed[:, 1]).all()  # at times of its own


def test_a_restart_leaves_the_others_commands_alone() -> None:
    environment = environment_of(3, command_steps=100_000)
    before = task_of(environment).command.copy()
    environment.restart(np.array([1]), np.array([0]))
    after = task_of(environment).command
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    assert not np.array_equal(after[1], before[1])


@pytest.mark.parametrize("speed_weight", [0.0, 0.6])
def test_the_reward_is_for_following_the_command(speed_weight: float) -> None:
    """Recomputed from positions and rotations of the torso alone."""
    weights = {
        "speed_weight": speed_weight,
        "turn_weight": 0.5,
        "flight_weight": 0.4,
        "path_penalty": 2.0,
        "heading_penalty": 0.7,
        "tilt_penalty": 0.3,
    }
    environment = environment_of(4, command_steps=100_000, forward_max_mps=3.0, **weights)
    task, truth, simulator = task_of(environment), environment.simulator.truth, environment.simulator
    assert isinstance(simulator, MujocoSimulator)
    fast = task.command[:, 0] >= FLIGHT_SPEED_MPS
    assert fast.any() and not fast.all()
    scale = task.parameters.reward_scale
    command = task.command.copy()

    def place() -> tuple[np.ndarray, np.ndarray]:
        rotation = truth.torso_rotation
        return truth.torso_position[:, :2].copy(), np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])

    def perceived() -> tuple[np.ndarray, np.ndarray]:
        w, x, y, z = simulator.perceptors["torso_quat"].T
        angles = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
        return simulator.perceptors["torso_pos"][:, :2].copy(), angles

    position, yaw = place()
    seen_position, heading = perceived()
    offset, flew = np.zeros(4), False
    for action in 3.0 * gentle(environment, 40):
        environment.step(action)
        moved, turned = place()[0] - position, place()[1] - yaw
        position, yaw = place()
        ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        left = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
        velocity = np.stack([(moved * ahead).sum(axis=1), (moved * left).sum(axis=1), turned], axis=1) / STEP_S
        offset += ((perceived()[0] - seen_position) * left).sum(axis=1) - command[:, 1] * STEP_S
        heading = heading + command[:, 2] * STEP_S
        seen_position, seen_yaw = perceived()
        turn = seen_yaw - heading
        error = velocity - command
        tilt = 1.0 - truth.torso_rotation[:, 2, 2] ** 2
        squared = error[:, 0] ** 2 + error[:, 1] ** 2
        off = (simulator.foot_frames() < CONTACT_N).all(axis=2)
        flies = np.array([any(a and b for a, b in itertools.pairwise(frames)) for frames in off.tolist()])
        flew |= bool((flies & fast).any() and (flies & ~fast).any())
        expected = (
            (0.5 * np.exp(-squared / TRACKING_SCALE) + 0.5 / (1.0 + np.sqrt(squared)))
            * (1.0 + speed_weight * np.hypot(command[:, 0], command[:, 1]))
            + 0.4 * (flies & fast)
            + 0.5 * np.exp(-(error[:, 2] ** 2) / TRACKING_SCALE)
            - 2.0 * np.minimum(np.abs(offset), OFFSET_LIMIT_M)
            - 0.7 * (1.0 - np.cos(turn))
            - 0.3 * tilt
        )
        np.testing.assert_allclose(environment.rewards, scale * expected, atol=1e-9)
        names = environment.observer.names
        seen = {name: environment.observations[:, names.index(name)] for name in names[-6:]}
        asked = np.stack([seen[f"command_{kind}"] for kind in ("forward", "sideways", "turn")], axis=1)
        np.testing.assert_array_equal(asked, command)
        np.testing.assert_allclose(seen["line_offset"], np.clip(offset, -OFFSET_LIMIT_M, OFFSET_LIMIT_M), atol=1e-9)
        np.testing.assert_allclose(seen["heading_sin"], np.sin(turn), atol=1e-9)
        np.testing.assert_allclose(seen["heading_cos"], np.cos(turn), atol=1e-9)
    assert flew


def test_a_fall_ends_the_episode_and_the_time_limit_truncates_it() -> None:
    environment = environment_of(2, episode_steps=30, fall_penalty=5.0)
    nowhere = np.zeros((2, environment.actuation.n_actions))
    fall = nowhere.copy()
    fall[0] = 1.0
    for step in range(1, 31):
        environment.step(fall)
        low = environment.simulator.truth.torso_position[:, 2] < environment.world.defaults.fall_height_m
        np.testing.assert_array_equal(environment.terminated, low)
        np.testing.assert_array_equal(environment.failed, low)
        np.testing.assert_array_equal(environment.ends["fallen"], low)
        np.testing.assert_array_equal(environment.truncated, (step == 30) & ~low)
        if low.any():
            assert environment.rewards[0] < environment.rewards[1] - 4.0 * task_of(environment).parameters.reward_scale
            break
    assert low.tolist() == [True, False]
    environment = environment_of(1, episode_steps=30, command_steps=100_000)
    for step in range(1, 31):
        environment.step(nowhere[:1])
        assert environment.truncated.tolist() == [step == 30]
    error, fallen, forward = environment.task.measure(np.arange(1))[0]
    assert fallen == 0.0 and abs(forward) < 0.3
    assert error == pytest.approx(np.hypot(*task_of(environment).command[0, :2]), abs=0.3)


@pytest.mark.parametrize("growth", [0.0, 0.25])
@pytest.mark.parametrize("robot", [T1, K1], ids=lambda robot: robot.name)
def test_a_resumed_environment_continues_bit_for_bit(robot: Robot, growth: float) -> None:
    """From its state alone: commands, path, delayed actions and physics."""
    environment = environment_of(3, robot=robot, command_growth=growth)
    actions = gentle(environment, 60)
    for action in actions[:25]:
        environment.step(action)
    state = environment.state()
    resumed = environment_of(3, robot=robot, command_growth=growth)
    resumed.load_state({name: array.copy() for name, array in state.items()})
    for action in actions[25:]:
        np.testing.assert_array_equal(resumed.step(action), environment.step(action))
        np.testing.assert_array_equal(resumed.rewards, environment.rewards)
        np.testing.assert_array_equal(task_of(resumed).command, task_of(environment).command)
    rows = np.arange(3)
    np.testing.assert_array_equal(resumed.task.measure(rows), environment.task.measure(rows))
    for which in (environment, resumed):
        which.restart(rows, rows)
    np.testing.assert_array_equal(resumed.observations, environment.observations)


@pytest.mark.parametrize("robot", [T1, K1], ids=lambda robot: robot.name)
def test_a_mirrored_robot_with_a_mirrored_command_is_seen_and_rewarded_alike(robot: Robot) -> None:
    environment = symmetric_environment(robot, Velocity, command_steps=100_000, fall_penalty=1.0)
    rng = np.random.default_rng(2)
    environment.load_starts(mirrored_pair(robot, robot.nominal + rng.uniform(-0.02, 0.02, len(robot.joints))))
    environment.restart(np.arange(2), np.arange(2))
    task = task_of(environment)
    task.command[:] = (0.8, 0.3, -0.6), (0.8, -0.3, 0.6)
    mirror, actions = environment.observer.mirror, action_mirror(environment)
    for step in range(25):
        action = 0.5 * rng.standard_normal(environment.actuation.n_actions)
        seen = environment.step(np.stack([action, actions.apply(action)]))
        np.testing.assert_allclose(seen[1], mirror.apply(seen[0]), atol=1e-6, err_msg=f"step {step}")
        assert environment.rewards[1] == pytest.approx(environment.rewards[0], abs=1e-6)
    assert environment.rewards[0] != 0.0 and abs(task._offset[0]) > 1e-3


def test_a_robot_that_perceives_no_velocity_begins_with_policies_that_need_none() -> None:
    def onboard(policy: str) -> TrainingSpec:
        settings = {"name": "velocity", "entry_policies": [policy], "entry_fraction": 1.0, "handover_states": 8}
        return TrainingSpec.model_validate({"robot": {"name": "t1", "onboard_sensing": True}, "task": settings})

    with pytest.raises(ValidationError, match=r"task\.entry_policies: 't1-run' .* and senses, .* use t1-run-blind"):
        onboard("t1-run")
    environment = open_environment(onboard("t1-run-blind"), 4, threads=1)
    environment.load_starts(environment.task.starts(2, 0, 0.0))
    environment.restart(np.arange(4), np.zeros(4, dtype=np.int64))
    assert (np.abs(environment.world.actions).max(axis=1) > 0.0).all()
    environment.close()


def test_flight_without_contacts_is_what_the_simulator_takes_for_it() -> None:
    """As on servers, which report none, so that both feet always bear nothing."""

    class Blind(MujocoSimulator):
        foot_frames = Simulator.foot_frames

        def foot_forces(self) -> np.ndarray:
            return np.zeros((self.n, 2))

        def airborne(self) -> np.ndarray:
            return self.truth.torso_position[:, 0] > 0.5

    parameters = VelocitySettings(name="velocity", flight_weight=1.0, forward_min_mps=1.5, stand_fraction=0.0)
    environment = Environment(Blind(T1, 2), Velocity, Velocity.resolve(parameters, T1))
    environment.load_starts(Starts(np.repeat(T1.nominal[None], 2, axis=0), np.array([[0.0, 0.0], [1.0, 0.0]])))
    environment.step(np.zeros((2, environment.actuation.n_actions)))
    assert environment.simulator.flight().tolist() == [False, True]
    flight = Velocity.trace.index("flight")
    assert environment.task.trace_row(np.arange(2))[:, flight].tolist() == [0.0, 1.0]
    (term,) = (term for term in environment.task.reward_terms() if term.name == "flight")
    assert term.compute(slice(0, 2)).tolist() == [0.0, 1.0]
    environment.close()


def episodes_of(velocity: np.ndarray, command: np.ndarray, *, fallen: list[bool], flight: np.ndarray) -> Episodes:
    """Return episodes with (k, T, 3) velocities and commands, an offset of 0.1 m, and (k, T) flight.

    A trace has the command that follows a step.
    """
    count, samples = velocity.shape[:2]
    offset = np.full((count, samples, 1), 0.1)
    following = np.concatenate([command[:, 1:], command[:, -1:]], axis=1)
    trace = np.concatenate([velocity, following, offset, flight[..., None]], axis=2)
    zeros = [np.zeros(samples)] * count
    return Episodes(
        x=zeros,
        y=zeros,
        height=zeros,
        up=zeros,
        feet=[np.zeros((samples, 2))] * count,
        airborne=list(flight),
        trace=list(trace),
        ends={"fallen": np.array(fallen)},
        max_steps=samples - 1,
    )


def test_an_evaluation_reports_errors_drift_falls_and_flight() -> None:
    """The first two seconds are left out of the error, and the start's sample of everything."""
    samples = 201
    command = np.zeros((2, samples, 3))
    command[..., 0] = 1.0
    velocity = command.copy()
    velocity[0, 100:, 0] = 1.3  # an error of 0.3 m/s after 2 s
    velocity[0, 1:100, 0] = 0.0
    velocity[1, :, 2] = 0.2
    flight = np.zeros((2, samples), dtype=np.bool_)
    flight[0, 50] = flight[0, 0] = flight[1, 0] = True
    environment = environment_of(1)
    episodes = episodes_of(velocity, command, fallen=[False, True], flight=flight)
    results, tables = environment.task.summarize(episodes, Statistics(0.95, 100, 0))
    found = {result.metric.name: result for result in results}
    assert tables == ()
    assert found["rmse_mps"].low == 0.0 and found["rmse_mps"].high == pytest.approx(0.3)
    whole = np.sqrt((99 * 1.0 + 101 * 0.09) / 200)
    assert found["rmse_whole_mps"].high == pytest.approx(whole)
    assert found["turn_rmse_rad_s"].high == pytest.approx(0.2)
    assert found["forward_settled_mps"].high == pytest.approx(1.3)
    assert found["drift_m"].value == found["median_drift_m"].value == pytest.approx(0.1)
    assert found["median_rmse_mps"].value == pytest.approx(0.15)
    assert found["median_rmse_whole_mps"].value == pytest.approx(whole / 2)
    assert found["median_forward_mps"].value == pytest.approx(1.15)
    assert (found["fall_rate"].value, found["upright_rate"].value) == (0.5, 0.5)
    assert found["flight_share"].value == pytest.approx(0.5 / 200)
    assert found["flight_rate"].value == 0.5
    assert set(Velocity.presentation.headline) <= found.keys()


def test_errors_are_from_the_command_that_the_robot_had() -> None:
    """The one that is drawn after a step says nothing about its velocity."""
    environment = environment_of(2, command_steps=5)
    task, rows, had = task_of(environment), np.arange(2), []
    traces = [task.trace_row(rows)]
    for _ in range(40):
        had.append(task.command.copy())
        environment.step(np.zeros((2, environment.actuation.n_actions)))
        traces.append(task.trace_row(rows))
    assert len(np.unique(np.array(had)[:, 0], axis=0)) > 3
    for row in range(2):
        trace = np.array(traces)[:, row]
        np.testing.assert_array_equal(applied(trace)[1:, 3:6], np.array(had)[:, row])


def test_an_evaluation_reports_settled_errors_and_stops() -> None:
    """Robot 0 stops in time, 1 does not, 2 falls before, 3 is commanded something else before, 4 was slow."""
    samples, stop = 301, 100
    command = np.zeros((5, samples, 3))
    command[:, :stop, 0] = 1.5
    command[4, :stop, 0] = 0.5
    velocity = np.zeros((5, samples, 3))
    velocity[:, :, 0] = 0.25  # an error of 0.25 m/s while it stands ...
    velocity[:, :stop, 0] = command[:, :stop, 0] - 0.5  # ... and of 0.5 m/s before
    velocity[0, stop : stop + 40, 0] = 1.5
    velocity[1, stop : stop + 70, 0] = 1.5
    command[3, stop + 60 :, 1] = 0.2
    traces = zip(velocity, command, [False, False, True, False, False], strict=True)
    episodes = [
        episodes_of(v[None, :end], c[None, :end], fallen=[fell], flight=np.zeros((1, end), dtype=np.bool_))
        for (v, c, fell), end in zip(traces, (samples, samples, stop + 60, samples, samples), strict=True)
    ]
    task = environment_of(1).task
    found = [
        {result.metric.name: result for result in task.summarize(each, Statistics(0.95, 100, 0))[0]}
        for each in episodes
    ]
    assert [each["stop_rate"].value for each in found] == [1.0, 0.0, 0.0, None, None]
    late = round(SETTLING_S / STEP_S)
    before, after = stop - late, samples - stop - late
    expected = np.sqrt((before * 0.25 + after * 0.0625) / (before + after))
    assert found[0]["rmse_settled_mps"].value == pytest.approx(expected)
    assert found[2]["rmse_settled_mps"].value == pytest.approx(np.sqrt((before * 0.25 + 10 * 0.0625) / (before + 10)))


def test_an_episode_that_falls_within_two_seconds_has_no_error_after_them() -> None:
    environment = environment_of(1)
    short = np.ones((1, 60, 3))
    episodes = episodes_of(short, short, fallen=[True], flight=np.zeros((1, 60), dtype=np.bool_))
    results, _ = environment.task.summarize(episodes, Statistics(0.95, 100, 0))
    found = {result.metric.name: result for result in results}
    assert found["rmse_mps"].value is found["median_rmse_mps"].value is None
    assert found["median_forward_mps"].value == 0.0 and found["rmse_whole_mps"].value == 0.0
    assert found["fall_rate"].value == 1.0


def test_a_range_the_wrong_way_round_is_refused() -> None:
    with pytest.raises(ValidationError, match="exchange them"):
        VelocitySettings(name="velocity", forward_min_mps=1.0, forward_max_mps=0.5)
