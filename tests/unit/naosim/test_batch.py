"""Batches: independence of lanes, threads and kernels, snapshots, and refusal of bad input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naosim.robots import nao_model
from naosim.simspark import BatchSimulator, centre_of_mass
from naosim.simspark.batch import WHOLE
from naosim.simspark.control import GAIN, motor_speeds
from naosim.simspark.motion import stepping_speeds
from naosim.simulator import halves
from numpy.typing import NDArray

JOINTS = 22


def commands(seed: int, cycles: int = 120, joints: int = JOINTS) -> NDArray[np.float64]:
    """Return violent joint speeds, (cycles, joints): falls, stops, saturated motors and self-collisions."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-8, 8, (cycles // 6 + 1, joints)), 6, axis=0)[:cycles]


def run(sim: BatchSimulator, seeds: list[int], cycles: int = 120) -> bytes:
    """Step each environment with its own commands; return all bits of the final state."""
    joints = len(sim.model.joints)
    sim.beam((0, 0, sim.model.standing_height + 0.01))
    plan = np.stack([commands(seed, cycles, joints) for seed in seeds], axis=1)
    for speeds in plan:
        sim.step(speeds)
    return b"".join(sim.snapshot(np.arange(sim.n) == k).tobytes() for k in range(sim.n))


def environment_bits(seed: int, robot_type: int = 0) -> bytes:
    return run(BatchSimulator(1, robot_type, kernel="generic"), [seed])


@pytest.mark.parametrize("robot_type", nao_model.ROBOT_TYPES)
def test_bits_do_not_depend_on_batch_order_threads_or_kernel(robot_type: int) -> None:
    alone = [environment_bits(seed, robot_type) for seed in range(11)]
    for threads in (1, 3):
        assert run(BatchSimulator(11, robot_type, threads=threads), list(range(11))) == b"".join(alone)
    order = [7, 0, 10, 3, 3, 9]
    assert run(BatchSimulator(6, robot_type), order) == b"".join(alone[k] for k in order)


def test_all_kernels_that_run_here_agree() -> None:
    ran = set()
    for kernel in ("avx512", "avx2", "generic"):
        try:
            sim = BatchSimulator(3, kernel=kernel)
        except ValueError:
            continue
        ran.add(run(sim, [4, 5, 6], 200))
    assert len(ran) == 1


def test_masked_environments_keep_still() -> None:
    sim = BatchSimulator(5)
    sim.beam((0, 0, 0.4))
    before = sim.snapshot()
    speeds = np.ones((5, JOINTS))
    mask = np.array([True, False, True, False, False])
    sim.step(speeds, mask)
    after = sim.snapshot()
    assert [bool((a != b).any()) for a, b in zip(before, after, strict=True)] == mask.tolist()


def test_restore_continues_bit_for_bit() -> None:
    sim = BatchSimulator(4)
    sim.beam((0, 0, 0.39))
    plan = commands(3, 240)
    for speeds in plan[:120]:
        sim.step(np.tile(speeds, (4, 1)))
    middle = sim.snapshot()
    perceived = sim.perceptors.joint_angles.copy()
    for speeds in plan[120:]:
        sim.step(np.tile(speeds, (4, 1)))
    end = sim.snapshot()
    other = BatchSimulator(9, threads=2)
    other.restore(middle[0], np.arange(9) == 6)
    np.testing.assert_array_equal(other.perceptors.joint_angles[6], perceived[0])
    for speeds in plan[120:]:
        other.step(np.tile(speeds, (9, 1)))
    np.testing.assert_array_equal(other.snapshot(np.arange(9) == 6)[0], end[0])


def test_reset_is_a_fresh_robot() -> None:
    sim = BatchSimulator(2)
    fresh = sim.snapshot()
    run(sim, [1, 2])
    sim.reset(np.array([False, True]))
    assert (sim.snapshot()[1] == fresh[1]).all() and (sim.snapshot()[0] != fresh[0]).any()


def test_robot_settles_as_on_the_server_and_falls_asleep() -> None:
    sim = BatchSimulator(1, digits=3)
    sim.beam((-14, 0, 0.4), -90)
    np.testing.assert_allclose(sim.truth.torso_rotation[0, :, 1], (1, 0, 0), atol=1e-15)
    still = np.zeros((1, JOINTS))
    for _ in range(80):
        sim.step(still)
    assert sim.truth.torso_position[0, 2] == pytest.approx(0.383871, abs=2e-6)
    assert not sim.truth.enabled.any()
    assert sim.perceptors.accel[0].tolist() == [0, 0, 9.81]
    assert sim.perceptors.foot_left[0].tolist() == pytest.approx([0, -0.01, -0.01, 0, 0, 22.592], abs=2e-3)
    weight = sim.perceptors.foot_left[0, 5] + sim.perceptors.foot_right[0, 5]
    assert weight == pytest.approx(nao_model.model(0).mass * 9.81, rel=1e-3)
    still[0, 3] = 1.0
    sim.step(still)
    assert sim.truth.enabled.all()


def test_commands_arrive_with_the_servers_latency() -> None:
    sim = BatchSimulator(1, digits=3)
    sim.beam((0, 0, 2.0))
    speeds = np.zeros((1, JOINTS))
    arm = sim.model.joint_index["laj1"]
    speeds[0, arm] = 1.0
    seen = []
    for _ in range(4):
        sim.step(speeds)
        seen.append(sim.perceptors.joint_angles[0, arm])
    assert seen == pytest.approx([0.0, 1.146, 2.292, 3.438], abs=2e-3)


def test_speed_is_capped_and_commands_at_a_stop_are_ignored() -> None:
    sim = BatchSimulator(1, digits=None)
    sim.beam((0, 0, 50.0))
    arm = sim.model.joint_index["laj1"]
    speeds = np.zeros((1, JOINTS))
    speeds[0, arm] = 100.0
    angles = []
    for _ in range(25):
        sim.step(speeds)
        angles.append(sim.perceptors.joint_angles[0, arm])
    assert angles[2] - angles[1] == pytest.approx(7.0276, abs=1e-3)
    assert 120 < max(angles) < 128  # overshoots its stop by at most one step
    assert sorted(angles[-4:])[0] < 120 < sorted(angles[-4:])[-1]  # and bounces


def test_overlapping_limbs_freeze_for_one_second() -> None:
    """Early in a game the server's single-precision clock makes it 51 cycles."""
    sim, free = BatchSimulator(64, digits=None), BatchSimulator(64, digits=None, self_collision=False)
    speeds = np.random.default_rng(0).uniform(-3, 3, (64, JOINTS))
    paths = []
    for each in (sim, free):
        each.beam((0, 0, 60.0))
        path = []
        for _ in range(130):
            each.step(speeds)
            path.append(each.perceptors.joint_angles.copy())
        paths.append(np.array(path))
    apart = np.abs(paths[0] - paths[1]).max(axis=2) > 0.5
    hit = np.flatnonzero(apart.any(axis=0))
    assert len(hit) > 5
    longest = []
    for k in hit:
        still = np.abs(np.diff(paths[0][:, k], axis=0)) < 0.3
        for limb in (slice(2, 6), slice(6, 10), slice(10, 16), slice(16, 22)):
            runs = "".join("x" if all(cycle) else " " for cycle in still[:, limb]).split()
            longest += [len(run) for run in runs if len(run) > 20]
    # the joints take a cycle to stop, so one less shows
    assert longest.count(50) > len(longest) / 2 and max(longest) <= 51


def test_rounding_matches_the_servers_print() -> None:
    exact, league, development = (BatchSimulator(1, digits=digits) for digits in (None, 2, 3))
    for speeds in commands(8, 60):
        for sim in (exact, league, development):
            sim.step(speeds[None])
    for digits, sim in ((2, league), (3, development)):
        for name in ("joint_angles", "gyro", "accel"):
            ours, true = getattr(sim.perceptors, name)[0], getattr(exact.perceptors, name)[0]
            expected = [float(f"{np.float32(value):.{digits}f}") for value in true]
            np.testing.assert_array_equal(ours, expected, err_msg=name)


def test_centre_of_mass_by_kinematics_matches_the_simulated_one() -> None:
    for robot_type in nao_model.ROBOT_TYPES:
        sim = BatchSimulator(3, robot_type, digits=None)
        sim.beam((1, 2, 5.0))
        joints = len(sim.model.joints)
        for k in range(30):
            sim.step(np.random.default_rng(k // 10).uniform(-0.5, 0.5, (3, joints)))
        truth = np.einsum("nij,ni->nj", sim.truth.torso_rotation, sim.truth.centre_of_mass - sim.truth.torso_position)
        sim.step(np.zeros((3, joints)))  # the angles of the state above are perceived now
        np.testing.assert_allclose(centre_of_mass(robot_type, sim.perceptors.joint_angles), truth, atol=1e-4)


def test_long_violent_run_always_settles_without_single_exchanges() -> None:
    sim = BatchSimulator(32, digits=None)
    sim.beam((0, 0, 0.4))
    rng = np.random.default_rng(0)
    for cycle in range(600):
        if cycle % 7 == 0:
            speeds = rng.uniform(-7, 7, (32, JOINTS))
        sim.step(speeds)
    assert np.isfinite(sim.truth.bodies).all()
    assert sim.statistics["fallback"] == 0


def test_stepping_robots_stay_on_their_feet() -> None:
    sim = BatchSimulator(8, digits=None)
    sim.beam((0, 0, 0.39))
    for cycle in range(500):
        sim.step(stepping_speeds(sim.model, cycle, sim.perceptors.joint_angles))
    assert (sim.truth.torso_position[:, 2] > 0.3).all() and sim.truth.enabled.all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_speed_that_is_no_number_names_environment_and_joint(value: float) -> None:
    sim = BatchSimulator(3)
    before = sim.snapshot()
    speeds = np.zeros((3, JOINTS))
    speeds[1, 4] = value
    with pytest.raises(ValueError, match=r"speeds\[1, 4\]: environment 1, joint laj3"):
        sim.step(speeds)
    np.testing.assert_array_equal(sim.snapshot(), before)
    sim.step(speeds, np.array([True, False, True]))  # a robot that is not stepped is not checked


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda s: s.step(np.zeros((2, 22))), "speeds"),
        (lambda s: s.step(np.zeros((3, 22)), np.ones(3)), "mask"),
        (lambda s: s.step(np.zeros((3, 22)), np.ones(2, bool)), "mask"),
        (lambda s: s.beam((0, 0, np.nan)), "position"),
        (lambda s: s.beam((0, 0, 1), np.inf), "yaw_deg"),
        (lambda s: s.set_bodies(np.zeros((3, 23, 12))), "bodies"),
        (lambda s: s.set_bodies(np.zeros((3, 23, 13))), r"bodies\[0, 0, 3\]: environment 0, torso"),
        (lambda s: s.set_bodies(np.full((3, 23, 13), np.nan)), "environment 0"),
        (lambda s: s.set_enabled(np.zeros((3, 2), bool)), "enabled"),
        (lambda s: s.restore(np.zeros(5, np.uint8)), "snapshot"),
        (lambda s: s.restore(s.snapshot()[:2]), "snapshot"),
        (lambda s: s.restore(s.snapshot().astype(float)), "snapshot"),
    ],
)
def test_bad_input_names_the_field(call: object, field: str) -> None:
    sim = BatchSimulator(3)
    with pytest.raises(ValueError, match=field):
        call(sim)  # type: ignore[operator]


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"n": 0}, "n"),
        ({"n": 2.5}, "n"),
        ({"n": True}, "n"),
        ({"n": 1, "threads": 0}, "threads"),
        ({"n": 1, "digits": 4}, "digits"),
        ({"n": 1, "robot_type": 7}, "robot_type"),
        ({"n": 1, "kernel": "mmx"}, "kernel"),
    ],
)
def test_bad_construction_names_the_argument(arguments: dict[str, object], field: str) -> None:
    with pytest.raises(ValueError, match=field):
        BatchSimulator(**arguments)  # type: ignore[arg-type]


def test_a_broken_environment_is_named_and_disturbs_nobody() -> None:
    sim, healthy = BatchSimulator(3), BatchSimulator(3)
    state = sim.truth.bodies
    state[1, :, 7:] = 9e5  # finite, but far beyond what integrates
    state[1, 5, 10:] = -9e5
    sim.set_bodies(state, np.array([False, True, False]))
    for _ in range(50):
        for each in (sim, healthy):
            try:
                each.step(np.ones((3, JOINTS)))
            except FloatingPointError as error:
                assert each is sim and "environment 1" in str(error)
    for k in (0, 2):
        chosen = np.arange(3) == k
        np.testing.assert_array_equal(sim.snapshot(chosen), healthy.snapshot(chosen))
    sim.reset(np.array([False, True, False]))
    sim.step(np.zeros((3, JOINTS)))


@settings(max_examples=60)
@given(
    data=st.data(),
    n=st.integers(1, 9),
    robot_type=st.sampled_from(nao_model.ROBOT_TYPES),
    size=st.floats(0, 1e6, allow_nan=False),
)
def test_fuzzed_states_and_speeds_never_crash(data: st.DataObject, n: int, robot_type: int, size: float) -> None:
    sim = BatchSimulator(n, robot_type)
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    state = sim.truth.bodies + rng.normal(0, size, sim.truth.bodies.shape)
    try:
        sim.set_bodies(state)
    except ValueError:
        return
    for _ in range(3):
        try:
            sim.step(rng.normal(0, size, (n, len(sim.model.joints))))
        except FloatingPointError as error:
            assert "environment" in str(error)


@settings(max_examples=40)
@given(
    st.one_of(
        st.none(),
        st.text(),
        st.lists(st.floats()),
        st.binary(max_size=64),
        st.integers(),
        st.lists(st.lists(st.floats()), max_size=3),
    )
)
def test_fuzzed_arguments_raise_python_errors(value: object) -> None:
    sim = BatchSimulator(4)
    for call in (sim.step, sim.set_bodies, sim.restore):
        with pytest.raises((ValueError, TypeError)):
            call(value)  # type: ignore[operator]


def test_the_compiled_controller_drives_as_the_python_one() -> None:
    driven, stepped = BatchSimulator(9, threads=2), BatchSimulator(9)
    limits = driven.model.max_speed
    rng = np.random.default_rng(1)
    mask = np.arange(9) != 4
    for _ in range(30):
        targets = rng.uniform(-2.0, 2.0, (9, JOINTS))
        driven.drive(targets, GAIN, limits, mask)
        stepped.step(motor_speeds(targets, stepped.perceptors.joint_angles, limits), mask)
    np.testing.assert_array_equal(driven.snapshot(), stepped.snapshot())


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_groups_in_the_background_move_as_all_together(threads: int) -> None:
    together, turns = BatchSimulator(29), BatchSimulator(29, threads=threads)
    limits, rng = turns.model.max_speed, np.random.default_rng(1)
    first, second = halves(29, WHOLE)
    assert (first, second) == (slice(0, 16), slice(16, 29))
    targets = rng.uniform(-2.0, 2.0, (40, 29, JOINTS))
    for cycle in targets:
        together.drive(cycle, GAIN, limits)
    for group in (first, second):
        turns.begin_drive(targets[0, group], GAIN, limits, group.start)
    for cycle in targets[1:]:
        for group in (first, second):
            turns.finish_drive(group.start)
            turns.begin_drive(cycle[group], GAIN, limits, group.start)
    for group in (first, second):
        turns.finish_drive(group.start)
    np.testing.assert_array_equal(turns.snapshot(), together.snapshot())


def test_what_has_begun_is_finished_once_before_it_begins_again() -> None:
    sim = BatchSimulator(32, threads=2)
    targets, limits = np.zeros((16, JOINTS)), sim.model.max_speed
    with pytest.raises(RuntimeError, match="no cycle has begun"):
        sim.finish_drive(0)
    sim.begin_drive(targets, GAIN, limits, 0)
    with pytest.raises(RuntimeError, match="not finished"):
        sim.begin_drive(targets, GAIN, limits, 0)
    for first in (4, 24):
        with pytest.raises(ValueError, match="rows"):
            sim.begin_drive(targets, GAIN, limits, first)
    targets[3, 4] = np.nan
    with pytest.raises(ValueError, match=r"targets_rad\[3, 4\]: environment 19, joint"):
        sim.begin_drive(targets, GAIN, limits, 16)
    sim.finish_drive(0)


def test_closing_while_a_cycle_runs_waits_for_it() -> None:
    for _ in range(20):
        sim = BatchSimulator(32, threads=2)
        sim.begin_drive(np.zeros((32, JOINTS)), GAIN, sim.model.max_speed, 0)
        del sim


def test_targets_that_are_not_finite_are_named() -> None:
    sim = BatchSimulator(3)
    targets = np.zeros((3, JOINTS))
    targets[1, 4] = np.nan
    before = sim.snapshot()
    with pytest.raises(ValueError, match=r"targets_rad\[1, 4\]: environment 1, joint .*: .* nan"):
        sim.drive(targets, GAIN, sim.model.max_speed)
    np.testing.assert_array_equal(sim.snapshot(), before)
    sim.drive(targets, GAIN, sim.model.max_speed, np.array([True, False, True]))


def test_environments_are_restored_from_chosen_snapshots() -> None:
    sim = BatchSimulator(4)
    run(sim, [1, 2, 3, 4], 30)
    saved = sim.snapshot()
    run(sim, [5, 6, 7, 8], 30)
    later = sim.snapshot()
    sim.restore_from(np.array([3, 0]), saved, np.array([1, 2]))
    np.testing.assert_array_equal(sim.snapshot(), np.stack([saved[2], later[1], later[2], saved[1]]))
    with pytest.raises(ValueError, match="out of range"):
        sim.restore_from(np.array([0]), saved, np.array([4]))


@pytest.mark.parametrize("robot_type", [0, 4])
def test_centres_of_mass_do_not_depend_on_neighbours_or_decimals(robot_type: int) -> None:
    """Angles with two decimals are looked up, those beside them computed."""
    joints = len(nao_model.model(robot_type).joints)
    rounded = np.round(np.random.default_rng(2).uniform(-190.0, 190.0, (7, joints)), 2)
    together = centre_of_mass(robot_type, rounded)
    for angles, found in zip(rounded, together, strict=True):
        np.testing.assert_array_equal(centre_of_mass(robot_type, angles[None])[0], found)
    np.testing.assert_allclose(centre_of_mass(robot_type, rounded + 1e-9), together, atol=1e-10)
