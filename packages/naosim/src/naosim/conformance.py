"""Checks that a simulator conforms to :class:`naosim.simulator.Simulator`.

:func:`check` runs all of them; a test suite runs them one by one::

    SUBJECT = Subject(lambda n: MySimulator(robot, n))


    @pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
    def test_conformance(check):
        check(SUBJECT)

A check that fails raises AssertionError with a message that describes the problem.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from naosim.simulator import BALL, STEP_S, TOUCHING, Ability, Simulator, SimulatorClosedError, Starts, Variation

if TYPE_CHECKING:
    from naosim.robots import Robot
    from naosim.simulator import Flags, Floats

N = 2
"""Number of robots in the simulators that are checked."""

POSITION_M = (-3.0, 2.0)
HEADING_RAD = 0.5
BEND_RAD = 0.2
"""Angle by which the second start differs from the first, in one joint."""

_STEPS = 20
_LOSING_STEPS = 5
_LONGEST_LATENCY = 10
_NEAR_M, _NEAR_RAD = 0.3, 0.3
_SAME_M = 0.01
_UPRIGHT = 0.6  # share of the standing height below which a robot does not stand


@dataclass(frozen=True)
class Subject:
    """A simulator to check.

    Attributes:
        open: returns a new simulator of n robots.
        lose: makes the simulator lose a robot, for example by killing its server; None if it cannot lose any.
        tolerance_deg: largest difference of a joint angle between two runs that should be the same; 0 if they are equal
            to the last bit, as in a simulator that computes in this process.
        abilities: what its SimulatorKind states for the robot.
    """

    open: Callable[[int], Simulator]
    lose: Callable[[Simulator, int], None] | None = None
    tolerance_deg: float = 0.0
    abilities: frozenset[Ability] = frozenset()


@dataclass(frozen=True)
class SimulatorCheck:
    """Outcome of one check; the message is empty if it passed."""

    name: str
    passed: bool
    message: str = ""


Check = Callable[[Subject], None]


def check(
    open_simulator: Callable[[int], Simulator],
    *,
    lose: Callable[[Simulator, int], None] | None = None,
    tolerance_deg: float = 0.0,
    abilities: frozenset[Ability] = frozenset(),
) -> list[SimulatorCheck]:
    """Run all checks and return their results; see :class:`Subject` for the arguments."""
    subject = Subject(open_simulator, lose, tolerance_deg, abilities)
    results = []
    for one in CHECKS:
        name = getattr(one, "__name__", str(one))
        try:
            one(subject)
        except Exception as error:  # a simulator that raises does not conform either
            results.append(SimulatorCheck(name, False, f"{type(error).__name__}: {error}"))
        else:
            results.append(SimulatorCheck(name, True))
    return results


# arrays


def arrays_match_the_robot(subject: Subject) -> None:
    """Check that perceptors, truth, bodies and forces have the names, shapes and types of the robot's description."""
    with _started(subject) as simulator:
        robot = simulator.robot
        expected = {each.name: each.width for each in (*robot.perceptors, *simulator.scene.perceptors)}
        _require(simulator.n == N, f"n: expected {N}, got {simulator.n}")
        _require(set(simulator.perceptors) == set(expected), f"perceptors: expected {sorted(expected)}")
        for name, width in expected.items():
            _require_array(f"perceptors[{name!r}]", simulator.perceptors[name], (N, width))
        if "joint_angles" in expected:
            _require(expected["joint_angles"] == len(robot.joints), "joint_angles: one angle for each joint")
            _require(bool(np.isfinite(simulator.perceptors["joint_angles"]).all()), "joint_angles: must be finite")
        _require_array("truth.torso_position", simulator.truth.torso_position, (N, 3))
        _require_array("truth.torso_rotation", simulator.truth.torso_rotation, (N, 3, 3))
        turned = simulator.truth.torso_rotation @ simulator.truth.torso_rotation.transpose(0, 2, 1)
        _require(bool(np.allclose(turned, np.eye(3), atol=0.05)), "truth.torso_rotation: must be rotations")
        _require_array("foot_forces()", simulator.foot_forces(), (N, 2))
        _require(bool(np.isfinite(simulator.foot_forces()).all()), "foot_forces(): must be finite")
        if robot.shapes:
            _require_array("bodies()", simulator.bodies(), (N, len(simulator.shapes), 7))
        lost = simulator.lost
        _require(lost.shape == (N,) and lost.dtype == np.bool_, f"lost: expected ({N},) bool, got {lost!r}")
        _require(not lost.any() and simulator.failures == 0, "no robot of a new simulator is lost")
        _require(simulator.loss_reason(0) == "", "loss_reason: must be empty for a robot that is not lost")


def bodies_have_the_names_of_the_scene(subject: Subject) -> None:
    """Check that truth has the motion of every body that the scene names, and contacts if there is a ball."""
    with _started(subject) as simulator:
        truth, scene = simulator.truth, simulator.scene
        bodies, contacts = tuple(truth.bodies), tuple(truth.contacts)
        _require(bodies == scene.moving, f"truth.bodies: expected {scene.moving}, got {bodies}")
        for name, body in truth.bodies.items():
            for part, shape in (("position", (3,)), ("rotation", (3, 3)), ("velocity", (3,)), ("spin", (3,))):
                _require_array(f"truth.bodies[{name!r}].{part}", getattr(body, part), (N, *shape))
        if scene.moving:
            away = np.abs(truth.bodies["torso"].position - truth.torso_position).max()
            _require(away < _SAME_M, f"truth.bodies['torso']: {away:g} m from truth.torso_position")
        expected = TOUCHING if scene.ball else ()
        _require(contacts == expected, f"truth.contacts: expected {expected}, got {contacts}")
        for name, share in truth.contacts.items():
            _require_array(f"truth.contacts[{name!r}]", share, (N,))
        if not scene.ball:
            with _raising(ValueError, "place_ball() without a ball"):
                simulator.place_ball(np.arange(N), np.zeros((N, 3)))


def groups_hold_every_robot_once(subject: Subject) -> None:
    """Check that every robot is in exactly one group."""
    with _opened(subject) as simulator:
        rows = [row for group in simulator.groups for row in range(N)[group]]
        _require(sorted(rows) == list(range(N)), f"groups: every robot once, got {simulator.groups}")


# starts


def unknown_starts_are_refused(subject: Subject) -> None:
    """Check that starts without :meth:`load_starts` raise RuntimeError and unknown indices IndexError."""
    with _opened(subject) as simulator:
        everyone = np.arange(N)
        with _raising(RuntimeError, "start() before load_starts()"):
            simulator.start(everyone, np.zeros(N, dtype=np.int64))
        simulator.load_starts(_starts(simulator.robot))
        for unknown in (2, -1):
            with _raising(IndexError, f"start() with start {unknown} of 2"):
                simulator.start(everyone, np.full(N, unknown))


def robots_start_where_they_should(subject: Subject) -> None:
    """Check that robots stand at the position of the starts and face their heading, in different postures."""
    with _started(subject) as simulator:
        position, rotation = simulator.truth.torso_position, simulator.truth.torso_rotation
        away = np.abs(position[:, :2] - POSITION_M).max()
        _require(away < _NEAR_M, f"position: {away:.2f} m from where the start is")
        front = rotation[:, :, simulator.robot.front_axis]
        turned = np.arctan2(front[:, 1], front[:, 0]) - HEADING_RAD
        _require(bool((np.abs(turned) < _NEAR_RAD).all()), f"heading: {turned} rad from the start's")
        down = position[:, 2] < _UPRIGHT * simulator.robot.standing_height_m
        _require(not down.any(), f"height: {position[:, 2]} m is below {_UPRIGHT:.0%} of standing_height_m")
        bent = np.abs(np.diff(_angles(simulator), axis=0)).max()
        _require(bent > np.rad2deg(BEND_RAD) / 2, f"starts: the postures differ by {bent:.2f} degrees only")


def starts_are_repeated(subject: Subject) -> None:
    """Check that a start does not depend on what happened before, and does not change the other robots."""
    with _started(subject) as simulator:
        first = _record(simulator)
        _walk(simulator, range(_STEPS))
        before = _record(simulator)
        simulator.start(np.array([1]), np.array([1]))
        after = _record(simulator)
        _require_same(after, before, 0.0, "start() of robot 1: robot 0", rows=slice(0, 1))
        _require_same(after, first, subject.tolerance_deg, "start() for the second time", rows=slice(1, 2))
        # order of rows does not matter
        simulator.start(np.array([1, 0]), np.array([1, 0]), np.array([0, 1]))
        _require_same(_record(simulator), first, subject.tolerance_deg, "start() for the third time")


def the_ball_is_where_it_is_placed(subject: Subject) -> None:
    """Check that a placed ball rolls, is perceived by robots that have it in view, and is one in each world."""
    with _started(subject, (0, 0)) as simulator:
        if not simulator.scene.ball:
            return
        ball, radius = simulator.truth.bodies[BALL], simulator.robot.field.ball_radius_m
        ahead = np.array([np.cos(HEADING_RAD), np.sin(HEADING_RAD), 0.0])
        place = np.array([*POSITION_M, radius]) + np.outer([3.0, -3.0], ahead)
        simulator.place_ball(np.arange(N), place, np.outer([1.0, 0.0], ahead))
        seen = np.zeros((N, 0))
        for _ in range(_STEPS):
            simulator.step(np.repeat(simulator.robot.nominal[None], N, axis=0))
            seen = np.column_stack([seen, simulator.perceptors[BALL][:, 0]])
        moved = (ball.position - place) @ ahead
        rolled = _STEPS * STEP_S
        near = 0.5 * rolled < moved[0] < 1.2 * rolled
        _require(near, f"place_ball(): rolled {moved[0]:.2f} m in {rolled:g} s at 1 m/s")
        _require(abs(moved[1]) < _NEAR_M, f"place_ball(): a ball at rest moved {moved[1]:.2f} m")
        along = float(ball.velocity[0] @ ahead)
        _require(0.4 < along < 1.1, f"truth.bodies['ball'].velocity: {along:.2f} m/s, placed at 1 m/s")
        distances = seen[0][np.isfinite(seen[0])]
        _require(len(distances) > _STEPS // 4, f"perceptors['ball']: reported in {len(distances)} of {_STEPS} steps")
        _require(bool((np.abs(distances - 3.2) < 0.5).all()), f"perceptors['ball']: {distances} m, placed 3 m ahead")
        _require(not np.isfinite(seen[1]).any(), "perceptors['ball']: a ball behind the robot is reported")


# steps


def steps_are_deterministic(subject: Subject) -> None:
    """Check that two simulators with the same commands agree, also if one is stepped group by group."""
    with _started(subject) as together, _started(subject) as turns:
        for step in range(_STEPS):
            targets = _targets(together.robot, step)
            together.step(targets)
            for group in turns.groups:
                turns.step_async(targets[group], group)
            for group in turns.groups:
                turns.step_wait(group)
            _require_same(_record(turns), _record(together), subject.tolerance_deg, f"step {step}")


def robots_are_independent(subject: Subject) -> None:
    """Check that a robot moves the same beside another robot as alone."""
    with _started(subject) as both, _opened(subject, 1) as alone:
        alone.load_starts(_starts(alone.robot))
        alone.start(np.array([0]), np.array([0]))
        for step in range(_STEPS):
            targets = _targets(both.robot, step)
            both.step(targets)
            alone.step(targets[:1])
        ours, theirs = _record(both), _record(alone)
        _require_same(ours, theirs, subject.tolerance_deg, "a robot beside another", rows=slice(0, 1))


def inactive_robots_keep_still(subject: Subject) -> None:
    """Check that a step leaves inactive robots exactly as they are."""
    with _started(subject) as simulator:
        _walk(simulator, range(3))
        before = _record(simulator)
        active: Flags = np.array([False, True])
        for step in range(3, 8):
            simulator.step(_targets(simulator.robot, step), active)
        after = _record(simulator)
        _require_same(after, before, 0.0, "an inactive robot", rows=slice(0, 1))
        moved = np.abs(after["joint_angles"] - before["joint_angles"])[1].max()
        _require(moved > 0.0, "the active robot did not move")
        simulator.step(_targets(simulator.robot, 8))


def latency_is_what_it_says(subject: Subject) -> None:
    """Check that joint angles show a command's effect after ``latency_steps`` steps, not before."""
    with _started(subject, (0, 0)) as simulator:
        holding = np.repeat(simulator.robot.nominal[None], N, axis=0)
        commanded = holding.copy()
        commanded[1] = _bent(simulator.robot)
        steps, shown = 0, False
        while not shown:
            _require(steps < _LONGEST_LATENCY, f"no effect of a command within {_LONGEST_LATENCY} steps")
            simulator.step(commanded)
            steps += 1
            angles = _angles(simulator)
            shown = bool(np.abs(angles[1] - angles[0]).max() > subject.tolerance_deg)
        expected = simulator.latency_steps
        _require(steps == expected, f"latency_steps: {expected}, but commands show after {steps} steps")


# abilities


def abilities_are_as_declared(subject: Subject) -> None:
    """Check that the simulator can do what its kind declares, and raises ValueError for everything else."""

    def vary(simulator: Simulator, **differences: float) -> None:
        simulator.vary([Variation(**differences)] * N, np.random.default_rng(0))

    everyone, level = np.arange(N), np.array([[np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]])
    uses: Mapping[Ability, Callable[[Simulator], object]] = {
        Ability.PUSHES: lambda simulator: simulator.push(np.full((N, 2), 0.1), slice(0, N)),
        Ability.MASSES: lambda simulator: vary(simulator, masses=0.1),
        Ability.FRICTION: lambda simulator: vary(simulator, friction=0.9),
        Ability.GRAVITY: lambda simulator: vary(simulator, gravity=0.9),
        Ability.GAINS: lambda simulator: vary(simulator, gains=0.1),
        Ability.CENTRES: lambda simulator: vary(simulator, centre_m=0.01),
        Ability.STIFFNESS: lambda simulator: vary(simulator, stiffness=0.8),
        Ability.STIFFER: lambda simulator: vary(simulator, stiffness=1.2),
        Ability.TORQUES: lambda simulator: simulator.torque_shares(slice(0, N)),
        Ability.LYING: lambda simulator: simulator.load_starts(
            Starts(simulator.robot.nominal[None], POSITION_M, HEADING_RAD, level)
        ),
        Ability.MOVING: lambda simulator: simulator.set_motion(everyone, simulator.motion(everyone)),
    }
    with _started(subject) as simulator:
        for ability, use in uses.items():
            if ability in subject.abilities:
                use(simulator)
            else:
                with _raising(ValueError, f"{ability}, which the kind does not declare"):
                    use(simulator)


# snapshots


def snapshots_are_complete(subject: Subject) -> None:
    """Check that commands lead to the same states again after restore(), or that it raises RuntimeError."""
    with _started(subject) as simulator:
        _walk(simulator, range(_STEPS))
        state = simulator.snapshot()
        if state is None:
            with _raising(RuntimeError, "restore() of a simulator without snapshots"):
                simulator.restore(np.zeros((N, 1), dtype=np.uint8))
            return
        _require(state.dtype == np.uint8 and state.shape[:1] == (N,), "snapshot(): expected (n, S) bytes")
        here, kept = _record(simulator), state.copy()
        _walk(simulator, range(_STEPS, 2 * _STEPS))
        there = _record(simulator)
        _require(bool(np.array_equal(state, kept)), "snapshot(): steps change it afterwards")
        simulator.restore(state)
        _require_same(_record(simulator), here, 0.0, "restore()")
        _walk(simulator, range(_STEPS, 2 * _STEPS))
        _require_same(_record(simulator), there, 0.0, "steps after restore()")


# faults and closing


def lost_robots_can_be_started_again(subject: Subject) -> None:
    """Check that a lost robot has a reason and stands still while others are stepped, until its next start."""
    if subject.lose is None:
        return
    with _started(subject) as simulator:
        subject.lose(simulator, 1)
        for step in range(_LOSING_STEPS):
            simulator.step(_targets(simulator.robot, step))
            if simulator.lost[1]:
                break
        _require(simulator.lost.tolist() == [False, True], f"lost: expected robot 1, got {simulator.lost}")
        _require(simulator.loss_reason(1) != "", "loss_reason: must not be empty for a lost robot")
        before = _record(simulator)
        _walk(simulator, range(_STEPS))
        after = _record(simulator)
        _require_same(after, before, 0.0, "a lost robot", rows=slice(1, 2))
        moved = np.abs(after["joint_angles"] - before["joint_angles"])[0].max()
        _require(moved > 0.0, "the other robot did not move")
        simulator.start(np.array([1]), np.array([1]))
        _require(not simulator.lost.any(), "the robot is still lost after its start")
        _require(simulator.failures == 1, f"failures: expected 1, got {simulator.failures}")
        simulator.step(_targets(simulator.robot, 0))


def robots_are_kept_alive(subject: Subject) -> None:
    """Check that robots can be stepped after keep_alive()."""
    with _started(subject) as simulator:
        with simulator.keep_alive():
            pass
        _walk(simulator, range(3))
        _require(not simulator.lost.any(), "robots are lost after keep_alive()")


def a_closed_simulator_refuses_use(subject: Subject) -> None:
    """Check that close() may be called twice, and that steps and starts raise SimulatorClosedError after it."""
    simulator = subject.open(N)
    try:
        simulator.load_starts(_starts(simulator.robot))
    finally:
        simulator.close()
    simulator.close()
    everyone, targets = slice(0, N), _targets(simulator.robot, 0)
    uses: Mapping[str, Callable[[], object]] = {
        "step()": lambda: simulator.step(targets),
        "step_async()": lambda: simulator.step_async(targets, everyone),
        "step_wait()": lambda: simulator.step_wait(everyone),
        "load_starts()": lambda: simulator.load_starts(_starts(simulator.robot)),
        "start()": lambda: simulator.start(np.arange(N), np.zeros(N, dtype=np.int64)),
    }
    for name, use in uses.items():
        with _raising(SimulatorClosedError, f"{name} after close()"):
            use()


CHECKS: tuple[Check, ...] = (
    arrays_match_the_robot,
    bodies_have_the_names_of_the_scene,
    groups_hold_every_robot_once,
    unknown_starts_are_refused,
    robots_start_where_they_should,
    starts_are_repeated,
    the_ball_is_where_it_is_placed,
    steps_are_deterministic,
    robots_are_independent,
    inactive_robots_keep_still,
    latency_is_what_it_says,
    abilities_are_as_declared,
    snapshots_are_complete,
    lost_robots_can_be_started_again,
    robots_are_kept_alive,
    a_closed_simulator_refuses_use,
)
"""All checks."""


# helpers


@contextmanager
def _opened(subject: Subject, n: int = N) -> Iterator[Simulator]:
    simulator = subject.open(n)
    try:
        yield simulator
    finally:
        simulator.close()


@contextmanager
def _started(subject: Subject, starts: Sequence[int] = (0, 1)) -> Iterator[Simulator]:
    with _opened(subject) as simulator:
        simulator.load_starts(_starts(simulator.robot))
        simulator.start(np.arange(N), np.array(starts))
        yield simulator


def _starts(robot: Robot) -> Starts:
    return Starts(np.stack([robot.nominal, _bent(robot)]), POSITION_M, HEADING_RAD)


def _bent(robot: Robot) -> Floats:
    """Return the nominal pose with one joint bent towards the middle of its range."""
    pose = robot.nominal.copy()
    index, joint = next((index, joint) for index, joint in enumerate(robot.joints) if joint.actuated)
    pose[index] += np.copysign(BEND_RAD, (joint.low_rad + joint.high_rad) / 2 - pose[index])
    return pose


def _targets(robot: Robot, step: int) -> Floats:
    """Return (N, J) targets that swing about the nominal pose, differently for each robot."""
    swing = np.array([[joint.actuated for joint in robot.joints]]) * 0.1
    phase = np.arange(len(robot.joints)) + np.arange(N)[:, None]
    targets = robot.nominal + swing * np.sin(0.4 * (step + 1) + phase)
    low, high = ([getattr(joint, end) for joint in robot.joints] for end in ("low_rad", "high_rad"))
    clipped: Floats = np.clip(targets, low, high)
    return clipped


def _walk(simulator: Simulator, steps: range) -> None:
    for step in steps:
        simulator.step(_targets(simulator.robot, step))


def _angles(simulator: Simulator) -> Floats:
    return simulator.perceptors["joint_angles"].copy()


def _record(simulator: Simulator) -> dict[str, Floats]:
    """Return copies of everything that a caller reads after a step."""
    arrays = {name: array.copy() for name, array in simulator.perceptors.items()}
    arrays["torso_position"] = simulator.truth.torso_position.copy()
    arrays["torso_rotation"] = simulator.truth.torso_rotation.copy()
    for name, body in simulator.truth.bodies.items():
        for part in ("position", "rotation", "velocity", "spin"):
            arrays[f"{name}.{part}"] = getattr(body, part).copy()
    arrays |= {f"contact.{name}": share.copy() for name, share in simulator.truth.contacts.items()}
    return arrays


def _require_same(
    ours: Mapping[str, Floats], theirs: Mapping[str, Floats], tolerance_deg: float, what: str, rows: slice = slice(None)
) -> None:
    """Require two records to agree: joint angles within the tolerance, or everything exactly if it is 0."""
    for name in ("joint_angles",) if tolerance_deg else ours:
        difference = np.abs(np.nan_to_num(ours[name][rows]) - np.nan_to_num(theirs[name][rows])).max()
        _require(difference <= tolerance_deg, f"{what}: {name} differs by {difference:g}")
        if not tolerance_deg:
            same = np.array_equal(ours[name][rows], theirs[name][rows], equal_nan=True)
            _require(same, f"{what}: {name} differs")


def _require_array(name: str, array: Floats, shape: tuple[int, ...]) -> None:
    fits = array.shape == shape and array.dtype == np.float64
    _require(fits, f"{name}: expected {shape} float64, got {array.shape} {array.dtype}")


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise AssertionError(message)


@contextmanager
def _raising(kind: type[Exception], what: str) -> Iterator[None]:
    try:
        yield
    except kind:
        return
    except Exception as error:
        raise AssertionError(f"{what}: expected {kind.__name__}, got {type(error).__name__}: {error}") from error
    raise AssertionError(f"{what}: expected {kind.__name__}")
