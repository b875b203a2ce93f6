"""Booster robots in MuJoCo worlds of this process."""

from __future__ import annotations

import gc
import resource
import sys
from pathlib import Path

import numpy as np
import pytest
from naosim.mujoco.embedded import MujocoSimulator
from naosim.mujoco.settings import BoosterEmbeddedParameters
from naosim.mujoco.shapes import sole_heights
from naosim.mujoco.traces import load
from naosim.mujoco.world import MujocoUnavailableError, library, metadata
from naosim.robots.booster import K1, T1, kind_of
from naosim.robots.description import Robot
from naosim.simulator import Starts, Variation

BOTH = pytest.mark.parametrize("robot", [T1, K1], ids=lambda robot: robot.name)
POSES = np.stack([T1.nominal, T1.nominal + 0.03 * (np.arange(23) % 3 - 1)])


def opened(n: int = 2, robot: Robot = T1, threads: int = 1, **settings: object) -> MujocoSimulator:
    simulator = MujocoSimulator(
        robot, n, BoosterEmbeddedParameters.model_validate({"engine": "mujoco", **settings}), threads=threads
    )
    simulator.load_starts(Starts(POSES if robot is T1 else robot.nominal[None], (-14.0, 0.0)))
    simulator.start(np.arange(n), np.arange(n) % (2 if robot is T1 else 1))
    return simulator


def flailing(robot: Robot, n: int, steps: int) -> list[np.ndarray]:
    """Return targets that make the robots fall."""
    rng = np.random.default_rng(5)
    return [robot.nominal + rng.uniform(-0.75, 0.75, (n, len(robot.joints))) for _ in range(steps)]


@BOTH
def test_the_robot_stands_ten_seconds_without_a_policy(robot: Robot) -> None:
    simulator = MujocoSimulator(robot, 1)
    simulator.load_starts(Starts(robot.nominal[None]))
    simulator.start(np.array([0]), np.array([0]))
    for _ in range(500):
        simulator.step(robot.nominal[None])
    assert simulator.truth.torso_position[0, 2] > 0.9 * robot.standing_height_m
    assert simulator.truth.torso_rotation[0, 2, 2] > 0.99
    weight = 9.81 * (simulator.world.model.body_mass.sum() - 0.41)
    assert simulator.foot_forces().sum() == pytest.approx(weight, rel=0.01)


def test_the_loop_computes_what_mujoco_in_python_computes() -> None:
    """The loop adds only the delay, the four decimals of commands and the truncation."""
    mujoco = library()
    simulator = opened(1)
    data = mujoco.MjData(simulator.world.model)
    signature = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(simulator.world.model, signature))
    mujoco.mj_getState(simulator.world.model, simulator.batch.data[0], state, signature)
    mujoco.mj_setState(simulator.world.model, data, state, signature)
    late = POSES[:1]
    for targets in flailing(T1, 1, 30):
        simulator.step(targets)
        data.ctrl[1::3] = np.radians([round(float(angle), 4) for angle in np.degrees(late[0])])
        late = targets
        mujoco.mj_step(simulator.world.model, data, 4)
        assert np.array_equal(simulator.batch.data[0].qpos, data.qpos)
        sensed = simulator.perceptors
        assert np.array_equal(sensed["torso_quat"][0], np.trunc(data.sensordata[:4] * 1000) / 1000.0)
        assert np.array_equal(sensed["gyro"][0], np.trunc(np.degrees(data.sensordata[7:10]) * 100) / 100.0)
        assert np.array_equal(sensed["joint_angles"][0], np.trunc(np.degrees(data.sensordata[13:36]) * 100) / 100.0)
        assert np.array_equal(simulator.truth.torso_position[0], data.qpos[7:10])
        # the sensor of position is 5 ms old, the truth is not
        assert not np.array_equal(data.sensordata[4:7], data.qpos[7:10])


@BOTH
def test_threads_and_neighbours_do_not_change_a_bit(robot: Robot) -> None:
    one, three = opened(1, robot), opened(3, robot, threads=2)
    for targets in flailing(robot, 3, 25):
        one.step(targets[:1])
        three.step(targets)
    assert np.array_equal(one.snapshot()[0], three.snapshot()[0])


def test_a_command_acts_one_step_late_unless_told_otherwise() -> None:
    for delay in (0, 1):
        simulator = opened(2, action_delay=delay)
        simulator.start(np.arange(2), np.zeros(2, dtype=np.int64))
        targets = np.stack([T1.nominal, T1.nominal + 0.1])
        differs = []
        for _ in range(3):
            simulator.step(targets)
            differs.append(not np.array_equal(*simulator.perceptors["joint_angles"]))
        assert differs == [not delay, True, True]
        assert simulator.latency_steps == 1 + delay


@BOTH
def test_a_fast_world_lacks_nothing_but_the_ball(robot: Robot) -> None:
    exact, fast = opened(1, robot).world, opened(1, robot, engine="fast").world
    assert fast.kernel and not exact.kernel
    assert fast.model.nv == exact.model.nv - 6
    assert np.array_equal(fast.model.dof_frictionloss, exact.model.dof_frictionloss[6:])
    assert (fast.model.opt.density, fast.model.opt.viscosity) == (exact.model.opt.density, exact.model.opt.viscosity)


def test_a_cycle_of_the_fast_world_is_the_exact_worlds() -> None:
    exact, fast = (opened(1, engine=engine, action_delay=0, truncate=False) for engine in ("mujoco", "fast"))
    source, target = exact.batch.data[0], fast.batch.data[0]
    names = ("qpos", "qvel", "qacc_warmstart", "ctrl")
    for step in range(100):
        for name, first in zip(names, (7, 6, 6, 0), strict=True):
            getattr(target, name)[:] = getattr(source, name)[first:]
        targets = T1.nominal + 0.5 * np.sin(step / 4 + np.arange(23))
        for simulator in (exact, fast):
            simulator.step(targets[None])
        np.testing.assert_allclose(target.qpos, source.qpos[7:], rtol=0, atol=1e-8)
        np.testing.assert_allclose(target.qvel, source.qvel[6:], rtol=0, atol=1e-6)
    assert fast.batch.left_to_mujoco == 0


def test_a_robot_on_its_feet_moves_as_in_the_exact_world() -> None:
    exact, fast = opened(1), opened(1, engine="fast")
    farthest = 0.0
    for offset in 0.05 * np.sin(np.arange(300) / 8):
        for simulator in (exact, fast):
            simulator.step((T1.nominal + offset * (np.array(T1.nominal) != 0))[None])
        apart = np.abs(exact.truth.torso_position - fast.truth.torso_position).max()
        farthest = max(farthest, float(apart))
    assert farthest < 1e-6, "metres"


def test_worlds_in_the_background_move_as_all_together() -> None:
    together, turns = opened(5), opened(5, threads=2)
    assert turns.groups == (slice(0, 3), slice(3, 5))
    for step in range(20):
        targets = T1.nominal + 0.1 * np.sin(step / 3 + np.arange(5))[:, None]
        together.step(targets)
        for group in turns.groups:
            if step:
                turns.step_wait(group)
            turns.step_async(targets[group], group)
    for group in turns.groups:
        turns.step_wait(group)
    np.testing.assert_array_equal(turns.snapshot(), together.snapshot())
    with pytest.raises(RuntimeError, match="no step has begun"):
        turns.batch.finish(0)


def test_perceptors_without_truncation_have_all_digits() -> None:
    cut, full = opened(1), opened(1, truncate=False)
    for name, values in full.perceptors.items():
        step = 0.001 if name in ("torso_quat", "torso_pos") else 0.01
        difference = values - cut.perceptors[name]
        assert (np.abs(difference) < step).all() and (difference * values >= 0).all() and difference.any(), name


def test_robots_start_lying_where_the_caller_says() -> None:
    simulator = MujocoSimulator(T1, 3)
    half = np.sqrt(0.5)
    lying = np.array(
        [[half, 0.0, half, 0.0], [half, 0.0, -half, 0.0], [half, half, 0.0, 0.0]]
    )  # prone, supine, on a side
    simulator.load_starts(Starts(np.repeat(T1.nominal[None], 3, axis=0), (1.0, 2.0), 0.0, lying))
    simulator.start(np.arange(3), np.arange(3))
    assert (simulator.truth.torso_position[:, 2] < 0.25).all()
    assert np.abs(simulator.truth.torso_position[:, :2] - (1.0, 2.0)).max() < 0.3
    front = simulator.truth.torso_rotation[:, 2, 0]
    assert front[0] < -0.9 and front[1] > 0.9 and abs(front[2]) < 0.5
    speeds = simulator.perceptors["joint_speeds"]
    assert np.abs(speeds).max() < 60.0 and not simulator.lost.any()


@pytest.mark.parametrize(
    ("orientations", "message"),
    [
        (np.zeros((2, 4)), "orientations: a quaternion is 0"),
        (np.full((2, 4), np.nan), "orientations: expected finite numbers of shape"),
        (np.ones((3, 4)), r"orientations: .* shape \(2, 4\), got shape \(3, 4\)"),
    ],
)
def test_orientations_that_are_none_are_refused(orientations: np.ndarray, message: str) -> None:
    simulator = MujocoSimulator(T1, 1)
    with pytest.raises(ValueError, match=message):
        simulator.load_starts(Starts(np.repeat(T1.nominal[None], 2, axis=0), orientations=orientations))


def test_a_pose_in_which_the_robot_falls_is_refused_with_its_remedy() -> None:
    simulator = MujocoSimulator(T1, 1)
    leaning = T1.nominal.copy()
    leaning[T1.joint_names.index("left_hip_pitch")] = leaning[T1.joint_names.index("right_hip_pitch")] = -1.2
    with pytest.raises(ValueError, match="t1 does not stand after 40 steps in 1 of 1 start poses"):
        simulator.load_starts(Starts(leaning[None]))
    loose = MujocoSimulator(T1.with_parameters({"kp": {"legs": 5}}), 1)
    with pytest.raises(ValueError, match="stiffer ankles"):
        loose.load_starts(Starts(T1.nominal[None]))


def test_a_robot_whose_physics_diverge_is_lost_until_it_starts_again() -> None:
    simulator = opened(2)
    before = simulator.snapshot()[1]
    simulator.batch.data[0].qvel[10] = 1e12
    targets = np.repeat(T1.nominal[None], 2, axis=0)
    simulator.step(targets)
    assert simulator.lost.tolist() == [True, False]
    assert "the physics diverged" in simulator.loss_reason(0) and simulator.loss_reason(1) == ""
    stuck = simulator.snapshot()[0]
    simulator.step(targets)
    assert np.array_equal(simulator.snapshot()[0], stuck) and not np.array_equal(simulator.snapshot()[1], before)
    simulator.start(np.array([0]), np.array([1]))
    assert not simulator.lost.any() and simulator.failures == 1
    assert np.array_equal(simulator.snapshot()[0], before)


def test_the_worlds_of_a_step_in_the_background_outlive_the_simulator() -> None:
    """After an error, a simulator may be deleted while threads in C++ still step its worlds."""

    def owned() -> list[bool]:
        return [sys.getrefcount(each) > 3 for each in used]  # by the list, `each`, and the argument

    simulator = opened(3, threads=2)
    simulator.vary([Variation(friction=0.9)] * 3, np.random.default_rng(0))
    simulator.step_async(np.repeat(T1.nominal[None], 3, axis=0), slice(0, 3))
    batch, angles = simulator.batch, simulator.perceptors["joint_angles"]
    used = [batch.world.model, *batch.data, *batch._models[1:]]
    del simulator, batch
    gc.collect()
    assert all(owned()), "by the loop in C++, which its arrays keep"
    del angles
    assert not any(owned()[1:])


def test_malformed_commands_are_refused() -> None:
    simulator = opened(2)
    state = simulator.snapshot()
    for targets in (np.zeros((2, 22)), np.full((2, 23), np.nan), np.zeros((1, 23))):
        with pytest.raises(ValueError, match="targets_rad"):
            simulator.step(targets)
    halfway = np.stack([np.full(23, np.inf), T1.nominal])
    simulator.step(halfway, np.array([False, True]))
    assert np.array_equal(simulator.snapshot()[0], state[0])
    with pytest.raises(ValueError, match="state: expected bytes"):
        simulator.restore(state[:1])
    state = simulator.snapshot()
    for velocities in (np.full((2, 2), np.nan), np.ones((1, 2)), np.ones((2, 3))):
        with pytest.raises(ValueError, match="velocities_mps: expected finite numbers of shape"):
            simulator.push(velocities, slice(0, 2))
    assert np.array_equal(simulator.snapshot(), state)


def test_foot_frames_are_the_contacts_of_every_substep() -> None:
    mujoco = library()
    simulator = opened(1)
    model, data = simulator.world.model, simulator.batch.data[0]
    feet = [
        next(g for g in simulator.world.geoms if name in model.body(model.geom_bodyid[g]).name)
        for name in ("left_foot", "right_foot")
    ]
    pitch = model.geom("pitch").id
    airborne = 0
    for targets in flailing(T1, 1, 40):
        simulator.step(targets)
        forces = np.zeros(2)
        for index in range(data.ncon):
            pair = set(data.contact[index].geom.tolist())
            for side, foot in enumerate(feet):
                if pair == {pitch, foot}:
                    force = np.zeros(6)
                    mujoco.mj_contactForce(model, data, index, force)
                    forces[side] += force[0]
        assert simulator.foot_forces()[0] == pytest.approx(forces, abs=1e-9)
        assert np.array_equal(simulator.foot_frames()[0, -1], simulator.foot_forces()[0])
        airborne += int((simulator.foot_frames()[0] == 0.0).all(axis=1).sum())
    assert airborne > 0


def test_poses_of_bodies_are_those_of_the_current_state() -> None:
    mujoco = library()
    simulator = opened(2)
    for targets in flailing(T1, 2, 10):
        simulator.step(targets)
    poses = simulator.bodies()
    torso = next(k for k, shape in enumerate(T1.shapes) if shape.name == "torso")
    offset = np.array((0.06, 0.0, 0.12))  # of the torso's box in its body
    expected = simulator.truth.torso_position + simulator.truth.torso_rotation @ offset
    assert poses[:, torso, :3] == pytest.approx(expected, abs=1e-12)
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, poses[0, torso, 3:])
    assert matrix.reshape(3, 3) == pytest.approx(simulator.truth.torso_rotation[0], abs=1e-9)


@pytest.mark.parametrize(
    ("package", "version", "message"),
    [
        ("mujoco", "3.4.0", "mujoco: version 3.5.0 is needed, 3.4.0 is installed; run 'pip install mujoco==3.5.0"),
        ("rcsssmj", None, "rcsssmj: version 0.2.1 is needed, it is not installed"),
    ],
)
def test_a_missing_or_other_mujoco_is_named_with_its_remedy(
    monkeypatch: pytest.MonkeyPatch, package: str, version: str | None, message: str
) -> None:
    installed = metadata.version

    def pretended(name: str) -> str:
        if name == package and version is None:
            raise metadata.PackageNotFoundError(name)
        return str(version) if name == package else installed(name)

    monkeypatch.setattr(metadata, "version", pretended)
    library.cache_clear()  # as in a process that has not imported it yet
    with pytest.raises(MujocoUnavailableError, match=message):
        MujocoSimulator(T1, 1)


def test_the_recordings_start_is_reached_by_the_simulators_own_start() -> None:
    """A robot that is held in the recorded pose ends where the recorded one stood."""
    trace = load(Path(__file__).parent / "traces" / "k1-smooth.npz")
    held = np.radians(trace.command[0, :, 0])
    gains = {name: float(gain) for name, gain in zip(K1.joint_names, trace.command[0, :, 2], strict=True)}
    damping = {name: float(gain) for name, gain in zip(K1.joint_names, trace.command[0, :, 3], strict=True)}
    robot = K1.with_parameters({"kp": gains, "kd": damping})
    simulator = MujocoSimulator(robot, 1, BoosterEmbeddedParameters(settle_steps=75))
    simulator.load_starts(Starts(held[None], (-10.0, 0.0)))
    simulator.start(np.array([0]), np.array([0]))
    assert np.abs(simulator.perceptors["joint_angles"] - trace.perceptors["joint_angles"][0]).max() < 3.0  # it sways
    assert np.abs(simulator.truth.torso_position[0] - trace.states["qpos"][0, 7:10]).max() < 0.03


@BOTH
def test_sole_heights_tell_flight_as_contacts_do(robot: Robot) -> None:
    """A server reports no contacts; by the perceived pose a robot is airborne in nearly the same steps."""
    simulator = opened(4, robot)
    jump = np.array(
        [
            {"hip_pitch": -0.5, "knee_pitch": 1.0, "ankle_pitch": -0.5}.get(kind_of(name), 0.0)
            for name in robot.joint_names
        ]
    )
    agree, flying = [], []
    for step in range(60):
        simulator.step(robot.nominal + jump * np.maximum(0.0, np.sign(np.sin(0.35 * step + np.arange(4))))[:, None])
        sensed = simulator.perceptors
        quaternions = sensed["torso_quat"] / np.linalg.norm(sensed["torso_quat"], axis=1, keepdims=True)
        pose = np.concatenate((sensed["torso_pos"], quaternions, np.radians(sensed["joint_angles"])), axis=1)
        above = (sole_heights(simulator.world, pose) > 0.0).all(axis=1)
        standing = simulator.truth.torso_position[:, 2] > 0.65 * robot.standing_height_m
        agree += (above == simulator.airborne())[standing].tolist()
        flying += simulator.airborne()[standing].tolist()
    assert np.mean(agree) > 0.9 and 0.1 < np.mean(flying) < 0.9


def test_torque_shares_are_those_of_the_motors() -> None:
    simulator = opened(2)
    at_rest = simulator.torque_shares(np.array([1]))
    first = simulator.world.model.nv - 23
    limits = np.array([joint.max_torque for joint in T1.joints])
    for targets in flailing(T1, 2, 30):
        simulator.step(targets)
        applied = [data.qfrc_actuator[first:] / limits for data in simulator.batch.data]
        assert simulator.torque_shares(slice(0, 2)) == pytest.approx(np.array(applied), abs=1e-9)
    assert np.abs(simulator.torque_shares(slice(0, 2))).max() == 1.0
    simulator.start(np.array([1]), np.array([1]))
    assert np.array_equal(simulator.torque_shares(np.array([1])), at_rest)


def test_robots_that_differ_share_their_meshes() -> None:
    """A model of a K1 has 21 MB; one for each robot would be 420 MB."""

    def megabytes() -> float:
        return int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1]) * resource.getpagesize() / 1e6

    simulator = MujocoSimulator(K1, 20, threads=2)
    before = megabytes()
    for _ in range(3):
        simulator.vary([Variation(friction=0.6, masses=0.1)] * 20, np.random.default_rng(0))
    assert megabytes() - before < 150.0
    simulator.close()
