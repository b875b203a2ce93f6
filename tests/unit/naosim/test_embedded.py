"""NAOs in the embedded engine: starts, control and data for viewers."""

from __future__ import annotations

import numpy as np
import pytest
from naosim import kinds, robots
from naosim.simspark import BatchSimulator, EmbeddedSimulator
from naosim.simspark.control import DROP_M, motor_speeds
from naosim.simulator import DEFAULT_OPTIONS, RuntimeOptions, Starts

NAO = robots.get("nao-0")


def poses(count: int, seed: int = 0) -> np.ndarray:
    offsets = np.random.default_rng(seed).uniform(-0.035, 0.035, (count, len(NAO.joints)))
    return NAO.nominal + offsets


def test_a_start_is_the_state_after_sixty_cycles() -> None:
    """Restoring a settled snapshot and simulating 60 cycles into the pose give the same state, bit for bit."""
    targets = poses(3)
    simulated = BatchSimulator(3)
    limits = simulated.model.max_speed
    simulated.reset()
    simulated.beam((-14.0, 0.0, simulated.model.standing_height + DROP_M), -90.0)
    for _ in range(60):
        error = targets - np.deg2rad(simulated.perceptors.joint_angles)
        simulated.step(np.clip(7.0 * error, -limits, limits))

    restored = EmbeddedSimulator(NAO, 4)
    restored.load_starts(Starts(targets, (-14.0, 0.0)))
    restored.start(np.arange(4), np.array([0, 0, 0, 0]))
    rng = np.random.default_rng(0)
    for _ in range(20):
        restored.step(NAO.nominal + rng.uniform(-0.5, 0.5, (4, 22)))
    restored.start(np.array([3, 0, 1]), np.array([2, 0, 1]))
    assert np.array_equal(restored.snapshot()[[0, 1, 3]], simulated.snapshot())
    assert np.array_equal(restored.perceptors["joint_angles"][[0, 1, 3]], simulated.perceptors.joint_angles)
    assert np.array_equal(restored.truth.torso_position[[0, 1, 3]], simulated.truth.torso_position)


@pytest.mark.parametrize("name", [f"nao-{robot_type}" for robot_type in range(5)])
def test_naos_stand_upright_on_both_feet(name: str) -> None:
    robot = robots.get(name)
    simulator = kinds.get("embedded").open(robot, 2, kinds.get("embedded").parameters(robot)(), DEFAULT_OPTIONS)
    simulator.load_starts(Starts(robot.nominal[None], (-14.0, 0.0)))
    simulator.start(np.arange(2), np.array([0, 0]))
    position, rotation = simulator.truth.torso_position, simulator.truth.torso_rotation
    assert np.abs(position[:, :2] - [-14.0, 0.0]).max() < 0.1
    assert 0.8 * robot.standing_height_m < position[:, 2].min() < robot.standing_height_m
    assert rotation[:, 2, 2].min() > 0.97
    assert rotation[:, 0, robot.front_axis].min() > 0.97
    assert (simulator.foot_forces() > 5.0).all()
    assert simulator.bodies()[:, 0, :3] == pytest.approx(position)


def test_in_the_air_no_foot_bears_weight() -> None:
    """The server sends no foot perceptor then."""
    simulator = EmbeddedSimulator(NAO, 1)
    assert np.isnan(simulator.perceptors["foot_left"]).all()
    assert np.array_equal(simulator.foot_forces(), [[0.0, 0.0]])


def test_starts_that_are_not_upright_are_refused() -> None:
    simulator = EmbeddedSimulator(NAO, 1)
    with pytest.raises(ValueError, match="upright starts only"):
        simulator.load_starts(Starts(NAO.nominal[None], orientations=np.array([[0.7, 0.7, 0.0, 0.0]])))
    with pytest.raises(ValueError, match="rows: expected one of"):
        simulator.step_async(NAO.nominal[None], slice(0, 2))


def test_the_controller_is_proportional_within_the_joints_limits() -> None:
    """The speed is 7 times the error; robot type 2 has fast ankle pitch and slow ankle roll."""
    index = {name: k for k, name in enumerate(NAO.joint_names)}
    limits = np.array([joint.max_speed for joint in robots.get("nao-2").joints])
    targets, angles = np.zeros((1, 22)), np.zeros((1, 22))
    targets[0, index["laj1"]] = 0.1
    angles[0, index["laj2"]] = np.rad2deg(0.2)
    for name in ("llj4", "llj5", "llj6"):
        targets[0, index[name]] = -100.0
    speeds = dict(zip(NAO.joint_names, motor_speeds(targets, angles, limits)[0], strict=True))
    assert (speeds["laj1"], speeds["laj2"], speeds["laj3"]) == pytest.approx((0.7, -1.4, 0.0))
    assert [speeds[name] for name in ("llj4", "llj5", "llj6")] == pytest.approx([-6.1395, -8.80667, -3.47234], rel=1e-4)


def test_threads_and_digits_reach_the_engine() -> None:
    kind = kinds.get("embedded")
    parameters = kind.parameters(NAO)
    precise = kind.open(NAO, 1, parameters(sensor_digits=None), RuntimeOptions(threads=2))
    rounded = kind.open(NAO, 1, parameters())
    for simulator in (precise, rounded):
        simulator.load_starts(Starts(poses(1)))
        simulator.start(np.array([0]), np.array([0]))
    angles = [simulator.perceptors["joint_angles"] for simulator in (precise, rounded)]
    assert np.array_equal(angles[1], np.round(angles[1], 2))
    assert not np.array_equal(angles[0], np.round(angles[0], 2))
    with pytest.raises(ValueError, match="sensor_digits"):
        parameters(sensor_digits=4)


@pytest.mark.parametrize("onboard", [False, True], ids=["", "with vision"])
def test_what_is_no_snapshot_of_these_robots_is_refused_and_changes_nothing(onboard: bool) -> None:
    simulator = EmbeddedSimulator(NAO.with_parameters({"onboard_sensing": onboard}), 3)
    simulator.load_starts(Starts(NAO.nominal[None]))
    simulator.start(np.arange(3), np.zeros(3, dtype=np.int64))
    state = simulator.snapshot()
    for _ in range(4):
        simulator.step(np.repeat(NAO.nominal[None], 3, axis=0))
    now = simulator.snapshot()
    for wrong in (state[:1], state[0], state[:2], state[:, 8:], state[:, :8], state.astype(np.float64)):
        with pytest.raises(ValueError, match=r"state: expected bytes of 3 robots|snapshot: must be uint8"):
            simulator.restore(wrong)
        assert np.array_equal(simulator.snapshot(), now)
    simulator.restore(state)
    assert np.array_equal(simulator.snapshot(), state)
