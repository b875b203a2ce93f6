"""The ball in embedded worlds: placed, perceived, touched, part of snapshots; worlds without one are as they were."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace

import numpy as np
import pytest
from naosim import kinds, robots
from naosim.mujoco.embedded import MujocoSimulator
from naosim.mujoco.settings import BoosterEmbeddedParameters, Engine
from naosim.simulator import PLAIN, Floats, Scene, Starts

BALL = Scene(ball=True)
RADIUS_M = 0.11
EVERY = np.arange(2)
ENGINES: tuple[Engine, ...] = ("mujoco", "fast")


@contextmanager
def opened(
    name: str = "t1", scene: Scene = BALL, *, n: int = 2, engine: Engine = "mujoco"
) -> Iterator[MujocoSimulator]:
    """Open n robots in the middle of the field; they face +x."""
    simulator = MujocoSimulator(robots.get(name), n, BoosterEmbeddedParameters(engine=engine), scene=scene)
    try:
        simulator.load_starts(Starts(np.repeat(simulator.robot.nominal[None], 2, axis=0)))
        simulator.start(np.arange(n), np.arange(n) % 2)
        yield simulator
    finally:
        simulator.close()


def hold(simulator: MujocoSimulator, steps: int = 1) -> None:
    for _ in range(steps):
        simulator.step(np.repeat(simulator.robot.nominal[None], simulator.n, axis=0))


def placed(*points: tuple[float, float]) -> Floats:
    return np.array([(*point, RADIUS_M) for point in points])


@pytest.mark.parametrize("name", ["t1", "k1"])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_ball_in_view_is_reported_every_other_cycle(name: str, engine: Engine) -> None:
    """The two starts report it in different cycles, and what is reported is where the ball is."""
    with opened(name, engine=engine) as simulator:
        simulator.place_ball(EVERY, placed((2.0, 0.5), (2.0, 0.5)))
        assert np.isfinite(simulator.perceptors["ball"]).all(), "at once"
        reports = []
        for _ in range(6):
            hold(simulator)
            reports.append(simulator.perceptors["ball"].copy())
        seen = np.isfinite(np.array(reports)).all(axis=2)
        assert (seen[:, 0] != seen[:, 1]).all() and (seen[1:] != seen[:-1]).all()
        distance, azimuth, elevation = next(report[0] for report in reports if np.isfinite(report[0, 0]))
        assert 1.9 < distance < 2.2
        assert azimuth == pytest.approx(np.degrees(np.arctan2(0.5, 1.95)), abs=1.0)
        assert -35.0 < elevation < -15.0
        for value in (distance, azimuth, elevation):
            assert round(value * 100) == pytest.approx(value * 100, abs=1e-6), "two decimals"


@pytest.mark.parametrize("point", [(-1.0, 0.0), (0.1, 1.5), (0.25, 0.0)])
def test_a_ball_behind_beside_or_below_the_robot_is_not_seen(point: tuple[float, float]) -> None:
    with opened() as simulator:
        simulator.place_ball(EVERY, placed(point, (1.5, 0.0)))
        for _ in range(3):
            assert np.isnan(simulator.perceptors["ball"][0]).all()
            hold(simulator)


@pytest.mark.parametrize(
    ("name", "part", "point"),
    [
        ("t1", "right_foot", (0.26, -0.11)),
        ("t1", "left_foot", (0.26, 0.11)),
        ("k1", "right_foot", (0.25, -0.1)),
        ("t1", "left_shank", (0.3, 0.11)),
    ],
)
def test_who_touches_the_ball_is_named(name: str, part: str, point: tuple[float, float]) -> None:
    with opened(name) as simulator:
        contacts = simulator.truth.contacts
        simulator.place_ball(EVERY, placed(point, (1.0, 0.0)), np.array([[-2.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
        most = dict.fromkeys(contacts, 0.0)
        for _ in range(8):
            hold(simulator)
            most = {key: max(most[key], float(share[0])) for key, share in contacts.items()}
            assert all(share[1] == 0.0 for share in contacts.values())
        assert 0.0 < most[part] <= 1.0 and most["robot"] >= most[part]
        other = part.replace("left", "RIGHT").replace("right", "left").replace("RIGHT", "right")
        assert most[other] == most["left_hand"] == most["right_hand"] == 0.0


@pytest.mark.parametrize(("name", "side"), [("t1", 1.0), ("k1", -1.0)])
def test_a_hand_touches_a_ball_that_falls_on_it(name: str, side: float) -> None:
    """Arms point sideways at angle 0."""
    with opened(name, n=1) as simulator:
        pose = simulator.robot.nominal.copy()
        for index, joint in enumerate(simulator.robot.joints):
            if "shoulder" in joint.name or "elbow" in joint.name:
                pose[index] = 0.0
        for _ in range(25):
            simulator.step(pose[None])
        torso = simulator.truth.torso_position[0]
        simulator.place_ball(np.array([0]), np.array([[torso[0] + 0.05, side * 0.4, torso[2] + 0.4]]))
        touched = set()
        for _ in range(20):
            simulator.step(pose[None])
            touched |= {key for key, share in simulator.truth.contacts.items() if share[0] > 0.0}
        assert touched == {"left_hand" if side > 0 else "right_hand", "robot"}


def test_bodies_move_as_their_velocities_say() -> None:
    with opened(engine="mujoco") as simulator:
        motion = replace(
            simulator.motion(EVERY),
            joints_rad_s=np.zeros((2, len(simulator.robot.joints))),
            torso_mps=np.array([[0.5, 0.0, 0.0], [0.0, 0.3, 0.0]]),
            torso_rad_s=np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]),
        )
        simulator.set_motion(EVERY, motion)
        torso, foot = (simulator.truth.bodies[name] for name in ("torso", "left_foot"))
        assert torso.velocity == pytest.approx(np.array([[0.5, 0.0, 0.0], [0.0, 0.3, 0.0]]), abs=1e-12)
        assert torso.spin[0] == pytest.approx([0.0, 0.0, 1.0], abs=1e-12)
        # a rigid body: the foot moves with the torso and around it
        arm = foot.position[0] - torso.position[0]
        assert foot.velocity[0] == pytest.approx([0.5 - arm[1], arm[0], 0.0], abs=1e-9)
        assert simulator.truth.torso_position == pytest.approx(torso.position, abs=0)
        assert simulator.truth.torso_rotation == pytest.approx(torso.rotation, abs=1e-12)
        before, speed = torso.position.copy(), torso.velocity.copy()
        hold(simulator)
        mean = (torso.velocity + speed) / 2
        assert torso.position - before == pytest.approx(mean * 0.02, abs=2e-3)


@pytest.mark.parametrize("scene", [PLAIN, BALL])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_robot_begins_in_the_middle_of_another_ones_step(scene: Scene, engine: Engine) -> None:
    """Its perceptors and its motion are the other's; the ball stays where it is."""
    with opened(scene=scene, engine=engine) as simulator:
        targets = np.repeat(simulator.robot.nominal[None], 2, axis=0)
        for step in range(30):
            targets[0, 11:] = simulator.robot.nominal[11:] + 0.3 * np.sin(0.4 * step)
            simulator.step(targets)
        moving = simulator.motion(np.array([0]))
        assert np.abs(moving.joints_rad_s).max() > 0.5
        ball = simulator.bodies()[1, -1].copy()
        simulator.set_motion(np.array([1]), moving)
        now = simulator.motion(np.array([1]))
        for name in (each.name for each in fields(moving)):
            assert getattr(now, name) == pytest.approx(getattr(moving, name), abs=1e-12), name
        for name, values in simulator.perceptors.items():
            if name in ("joint_angles", "torso_pos", "torso_quat"):  # the other's are 5 ms old
                assert values[1] == pytest.approx(values[0], abs=4.0 if name == "joint_angles" else 0.02), name
        if scene.ball:
            assert np.array_equal(simulator.bodies()[1, -1], ball)
        targets[1] = targets[0]
        for _ in range(5):
            simulator.step(targets)
        assert simulator.truth.torso_position[1] == pytest.approx(simulator.truth.torso_position[0], abs=1e-6)
        assert simulator.perceptors["joint_speeds"][1] == pytest.approx(
            simulator.perceptors["joint_speeds"][0], abs=0.05
        )
        for none, message in ((np.nan, "expected finite numbers"), (0.0, "a quaternion is 0")):
            with pytest.raises(ValueError, match=f"torso_wxyz: {message}"):
                simulator.set_motion(np.array([1]), replace(moving, torso_wxyz=np.full((1, 4), none)))


def test_snapshots_contain_ball_and_contacts() -> None:
    with opened() as simulator:
        simulator.place_ball(EVERY, placed((0.26, -0.11), (1.0, 0.2)), np.array([[-2.0, 0.0, 0.0], [0.5, 0.0, 0.0]]))
        hold(simulator, 2)

        def record() -> dict[str, Floats]:
            truth = simulator.truth
            arrays = {"ball": simulator.perceptors["ball"].copy()} | {k: v.copy() for k, v in truth.contacts.items()}
            return arrays | {name: body.velocity.copy() for name, body in truth.bodies.items()}

        state, here = simulator.snapshot(), record()
        assert here["robot"].any()
        hold(simulator, 5)
        there = record()
        simulator.restore(state)
        for name, values in record().items():
            assert np.array_equal(values, here[name], equal_nan=True), name
        hold(simulator, 5)
        for name, values in record().items():
            assert np.array_equal(values, there[name], equal_nan=True), name


@pytest.mark.parametrize("engine", ENGINES)
def test_the_observed_world_moves_as_the_bare_one(engine: Engine) -> None:
    """Reporting bodies changes no bit of the motion."""
    with opened(scene=PLAIN, engine=engine) as plain, opened(scene=Scene(bodies=True), engine=engine) as observed:
        for step in range(40):
            targets = plain.robot.nominal + 0.3 * np.sin(0.3 * step + np.arange(len(plain.robot.joints)))
            for simulator in (plain, observed):
                simulator.step(np.repeat(targets[None], 2, axis=0))
            assert np.array_equal(plain.truth.torso_position, observed.truth.torso_position)
            assert np.array_equal(plain.perceptors["joint_speeds"], observed.perceptors["joint_speeds"])


def test_the_fast_world_rolls_and_kicks_a_ball_nearly_as_the_exact_one() -> None:
    ends = []
    for engine in ENGINES:
        with opened(engine=engine) as simulator:
            simulator.place_ball(
                EVERY, placed((2.0, 0.0), (0.27, -0.11)), np.array([[3.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])
            )
            hold(simulator, 50)
            ends.append(simulator.truth.bodies["ball"].velocity.copy())
    exact_end, fast_end = ends
    assert fast_end[0] == pytest.approx(exact_end[0], abs=1e-6), "alone it rolls alike, with air"
    assert np.linalg.norm(exact_end[1]) > 0.3
    assert fast_end[1] == pytest.approx(exact_end[1], abs=0.1)


def test_shapes_end_with_the_ball() -> None:
    with opened() as simulator:
        simulator.place_ball(EVERY, placed((1.0, 0.0), (2.0, 0.0)))
        assert simulator.shapes[-1].name == "ball" and simulator.shapes[-1].size_m[0] == RADIUS_M
        assert simulator.bodies()[:, -1, :3] == pytest.approx(placed((1.0, 0.0), (2.0, 0.0)))
    with opened(scene=PLAIN) as simulator:
        assert simulator.shapes == simulator.robot.shapes
        with pytest.raises(ValueError, match=r"there is none in this MujocoSimulator; open it with Scene\(ball=True\)"):
            simulator.place_ball(EVERY, placed((1.0, 0.0), (2.0, 0.0)))


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((np.zeros((1, 3)),), "position_m: expected finite numbers of shape"),
        ((np.full((2, 3), np.nan),), "position_m"),
        ((np.zeros((2, 3)), np.zeros(3)), "velocity_mps"),
        ((np.zeros((2, 3)), None, np.full((2, 3), np.inf)), "spin_rad_s"),
    ],
)
def test_places_that_are_no_places_are_refused(arguments: tuple[Floats, ...], named: str) -> None:
    with opened() as simulator, pytest.raises(ValueError, match=named):
        simulator.place_ball(EVERY, *arguments)


@pytest.mark.parametrize("name", ["t1", "k1"])
def test_a_server_refuses_a_ball_that_would_kill_it(name: str) -> None:
    server, robot = kinds.get("server"), robots.get(name)
    refusal = server.refusal(robot, BALL)
    assert bool(refusal) == (name == "k1")
    if refusal:
        assert "first touch of the ball" in refusal and "embedded" in refusal
    assert server.refusal(robot, PLAIN) == kinds.get("embedded").refusal(robot, Scene(ball=True, goals=True)) == ""
