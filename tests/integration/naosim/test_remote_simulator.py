"""Robots on servers conform to the simulators' interface, and start and run as in the embedded engine."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest
from naosim import kinds, robots
from naosim.conformance import CHECKS, Check, Subject
from naosim.simspark import EmbeddedSimulator, RemoteSimulator, embedded_launcher, protocol
from naosim.simulator import ServerLostError, Starts

NAO = robots.get("nao-0")
BENT = 2  # the first joint of an arm


def remote(n: int, *, max_failures: int = 1, standby_servers: bool = False) -> RemoteSimulator:
    return RemoteSimulator(
        embedded_launcher("--seed", "1"), NAO, n, max_failures=max_failures, standby_servers=standby_servers
    )


def kill(simulator: RemoteSimulator, server: int) -> None:
    os.killpg(simulator._remote._handles[server].pid, signal.SIGKILL)  # type: ignore[union-attr]


def starts(*bends_rad: float) -> Starts:
    poses = np.repeat(NAO.nominal[None], len(bends_rad), axis=0)
    poses[:, BENT] += bends_rad
    return Starts(poses, (-14.0, 0.0))


def lose(simulator: RemoteSimulator, row: int) -> None:
    kill(simulator, int(simulator._servers[row]))


SERVERS = Subject(remote, lose, tolerance_deg=1.0, abilities=kinds.get("server").abilities(NAO))


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_servers_conform(check: Check) -> None:
    check(SERVERS)


def test_a_server_starts_robots_as_the_engine_does() -> None:
    """Dropped and settled, a robot stands as in the engine's snapshot, in the pose of its start."""
    engine, server = EmbeddedSimulator(NAO, 2), remote(2)
    try:
        for simulator in (engine, server):
            simulator.load_starts(starts(0.0, 0.2))
            simulator.start(np.array([1, 0]), np.array([0, 1]))
        limits = {"joint_angles": 0.35, "gyro": 12.0, "accel": 1.0}
        for name, limit in limits.items():
            np.testing.assert_allclose(
                server.perceptors[name], engine.perceptors[name], rtol=0, atol=limit, err_msg=name
            )
        np.testing.assert_allclose(server.truth.torso_position, engine.truth.torso_position, rtol=0, atol=0.02)
        np.testing.assert_allclose(server.truth.torso_rotation, engine.truth.torso_rotation, rtol=0, atol=0.02)
        ours, theirs = engine.bodies(), server.bodies()
        np.testing.assert_allclose(theirs[..., :3], ours[..., :3], rtol=0, atol=0.02)
        np.testing.assert_allclose(np.abs((theirs[..., 3:] * ours[..., 3:]).sum(axis=-1)), 1.0, atol=1e-3)
        weight = 9.81 * 4.6071
        for simulator in (engine, server):
            assert simulator.foot_forces().sum(axis=1) == pytest.approx([weight] * 2, rel=0.2)
    finally:
        server.close()


def test_a_standby_server_prepares_the_next_start_while_the_robot_runs() -> None:
    """The two are exchanged at the start, which then takes no step of the robot that keeps running."""
    simulator = remote(2, standby_servers=True)
    try:
        loaded = starts(0.0, 0.2, -0.2)
        simulator.load_starts(loaded)
        targets = np.repeat(NAO.nominal[None], 2, axis=0)
        time = simulator._remote.perceptors.time

        def bend(row: int) -> float:
            return float(np.deg2rad(simulator.perceptors["joint_angles"][row, BENT]))

        simulator.start(np.arange(2), np.array([0, 0]), np.array([1, 2]))
        assert bend(1) == pytest.approx(loaded.poses_rad[0, BENT], abs=0.01)
        for _ in range(120):
            simulator.step(targets)
        alone = np.array([1])
        before = time[simulator._servers[0]]
        simulator.start(alone, np.array([2]), np.array([1]))
        assert bend(1) == pytest.approx(loaded.poses_rad[2, BENT], abs=0.01)
        assert simulator.truth.torso_position[1, 0] == pytest.approx(-14.0, abs=0.02)
        assert time[simulator._servers[0]] == before, "the other robot was stepped"
        # another start than the prepared one, on a standby server that died meanwhile: both only take time
        kill(simulator, simulator._standbys[1].server)
        for _ in range(5):
            simulator.step(targets)
        assert not simulator.lost.any()
        simulator.start(alone, np.array([0]))
        assert bend(1) == pytest.approx(loaded.poses_rad[0, BENT], abs=0.01)
        assert simulator.failures == 1
    finally:
        simulator.close()


def test_a_group_starts_while_the_servers_of_the_other_compute() -> None:
    """Robots that are stepped in turns perceive the same as in parallel, a start in between included."""
    together, turns = remote(3), remote(3)
    try:
        assert turns.groups == (slice(0, 2), slice(2, 3))
        for simulator in (together, turns):
            simulator.load_starts(starts(0.0, 0.2))
            simulator.start(np.arange(3), np.array([0, 1, 0]))
        rng = np.random.default_rng(3)
        targets = NAO.nominal + 0.1 * rng.standard_normal((30, 3, len(NAO.joints)))
        for group in turns.groups:
            turns.step_async(targets[0, group], group)
        for step in range(30):
            together.step(targets[step])
            for group in turns.groups:
                turns.step_wait(group)
                for name, array in turns.perceptors.items():
                    np.testing.assert_array_equal(array[group], together.perceptors[name][group], err_msg=name)
                if step == 15 and group.start == 0:
                    for simulator in (together, turns):
                        simulator.start(np.array([1]), np.array([0]))
                if step < 29:
                    turns.step_async(targets[step + 1, group], group)
    finally:
        together.close()
        turns.close()


def test_robots_on_servers_see_landmarks_where_they_are() -> None:
    """In every third step, and to the accuracy of the server's noise."""
    robot = NAO.with_parameters({"onboard_sensing": True})
    simulator = RemoteSimulator(embedded_launcher("--seed", "1"), robot, 2, max_failures=0)
    try:
        simulator.load_starts(starts(0.0))
        simulator.start(np.arange(2), np.array([0, 0]))
        seen = []
        for _ in range(6):
            simulator.step(np.repeat(NAO.nominal[None], 2, axis=0))
            seen.append(simulator.perceptors["vision"].reshape(2, -1, 3).copy())
        sighted = ~np.isnan(np.array(seen)[..., 0]).all(axis=2)
        assert sighted.sum(axis=0).tolist() == [2, 2]
        ahead = np.array([position[0] > 0 for _, position in protocol.LANDMARKS])
        places = np.array([position for _, position in protocol.LANDMARKS])[ahead]
        head = simulator.bodies()[:, 2, :3]
        relative = places - head[:, None]
        for row in range(2):
            polar = seen[np.flatnonzero(sighted[:, row])[-1]][row]
            assert np.array_equal(~np.isnan(polar[:, 0]), ahead)
            distance = np.linalg.norm(relative[row], axis=-1)
            theta = np.degrees(np.arctan2(relative[row, :, 1], relative[row, :, 0]))
            np.testing.assert_allclose(polar[ahead, 0], distance, atol=0.15)
            np.testing.assert_allclose(polar[ahead, 1], theta, atol=1.5)
    finally:
        simulator.close()


def test_more_failures_than_allowed_end_with_the_reason() -> None:
    simulator = remote(1, max_failures=0)
    try:
        simulator.load_starts(starts(0.0))
        kill(simulator, 0)
        for _ in range(3):
            simulator.step(NAO.nominal[None])
        assert simulator.lost.all()
        with pytest.raises(ServerLostError, match=r"1 servers were lost, 0 are allowed; .*exit code -9"):
            simulator.start(np.array([0]), np.array([0]))
    finally:
        simulator.close()
