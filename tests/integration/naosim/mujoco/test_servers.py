"""Booster robots on the real rcssservermj: they conform, move as in the embedded worlds, and survive lost servers."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from naosim import kinds
from naosim.conformance import (
    CHECKS,
    Check,
    Subject,
    robots_are_independent,
    starts_are_repeated,
    steps_are_deterministic,
)
from naosim.launchers import ProcessLauncher, ServerHandle, ServerProgram
from naosim.mujoco.client import MujocoFleet
from naosim.mujoco.embedded import MujocoSimulator
from naosim.mujoco.program import RCSSSERVERMJ, server_launcher
from naosim.mujoco.remote import RemoteMujocoSimulator
from naosim.robots import Robot
from naosim.robots.booster import K1, T1
from naosim.simulator import PLAIN, RuntimeOptions, Scene, ServerLostError, Simulator, Starts

ROOT = Path(__file__).parents[4]
BOTH = pytest.mark.parametrize("robot", [T1, K1], ids=lambda robot: robot.name)


def remote(
    robot: Robot = T1,
    n: int = 2,
    *,
    settle_steps: int = 40,
    max_failures: int = 1,
    standby_servers: bool = False,
    scene: Scene = PLAIN,
) -> RemoteMujocoSimulator:
    kind = kinds.get("server")
    options = RuntimeOptions(max_server_failures=max_failures, standby_servers=standby_servers)
    simulator = kind.open(robot, n, kind.parameters(robot)(settle_steps=settle_steps), options, scene)
    assert isinstance(simulator, RemoteMujocoSimulator)
    return simulator


@contextmanager
def opened(*arguments: object, **settings: object) -> Iterator[RemoteMujocoSimulator]:
    simulator = remote(*arguments, **settings)  # type: ignore[arg-type]
    try:
        yield simulator
    finally:
        simulator.close()


def signal_server(simulator: Simulator, server: int, number: int) -> None:
    assert isinstance(simulator, RemoteMujocoSimulator)
    os.killpg(simulator._remote._handles[server].pid, number)  # type: ignore[union-attr]


def lose(simulator: Simulator, row: int) -> None:
    assert isinstance(simulator, RemoteMujocoSimulator)
    signal_server(simulator, int(simulator._servers[row]), signal.SIGKILL)


def swinging(robot: Robot, steps: int, n: int = 1) -> np.ndarray:
    """Return (steps, n, J) targets that a robot survives on its feet."""
    rng = np.random.default_rng(7)
    swing = rng.uniform(-0.06, 0.06, (steps, 1, len(robot.joints)))
    return np.repeat(robot.nominal + swing, n, axis=1)


COMPARING = (starts_are_repeated, steps_are_deterministic, robots_are_independent)
"""Checks that compare runs. A robot at rest does not change if it waits for another simulator's servers."""


def subject(check: Check, robot: Robot, scene: Scene = PLAIN) -> Subject:
    # A K1 sways on its ankles for 10 s, and the targets amplify it.
    resting_steps, tolerance_deg = {"t1": (150, 0.1), "k1": (450, 1.0)}[robot.name]
    settle_steps = resting_steps if check in COMPARING else 40
    abilities = kinds.get("server").abilities(robot)
    return Subject(lambda n: remote(robot, n, settle_steps=settle_steps, scene=scene), lose, tolerance_deg, abilities)


@BOTH
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_servers_conform(check: Check, robot: Robot) -> None:
    check(subject(check, robot))


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_servers_with_a_ball_conform(check: Check) -> None:
    check(subject(check, T1, Scene(ball=True)))


def test_a_server_and_an_embedded_world_report_the_same_ball() -> None:
    """It rolls to the robot's foot, bounces off and rolls away, in view all the time."""
    robot, row = T1.with_parameters({"head_pitch_rad": 0.6}), np.array([0])
    loaded = Starts(robot.nominal[None], (-6.0, 1.5), 0.3)
    ahead = np.array([np.cos(0.3), np.sin(0.3), 0.0])
    place = np.array([[-6.0, 1.5, 0.11]]) + 1.0 * ahead - 0.11 * np.array([-ahead[1], ahead[0], 0.0])
    scene = Scene(ball=True)
    embedded = MujocoSimulator(robot, 1, scene=scene)
    reports, places = [], []
    with opened(robot, 1, scene=scene) as server:
        for simulator in (server, embedded):
            simulator.load_starts(loaded)
            simulator.start(row, row)
            simulator.place_ball(row, place, -2.0 * ahead[None])
            seen, true = [], []
            for _ in range(70):
                simulator.step(robot.nominal[None])
                seen.append(simulator.perceptors["ball"][0].copy())
                true.append(simulator.truth.bodies["ball"].position[0].copy())
            reports.append(np.array(seen))
            places.append(np.array(true))
            assert simulator.shapes[-1].name == "ball"
            assert simulator.bodies()[0, -1, :3] == pytest.approx(true[-1])
        assert not server.lost.any()
    distances = [seen[np.isfinite(seen[:, 0]), 0] for seen in reports]
    assert 20 < len(distances[0]) <= len(distances[1]) + 1 <= 37
    assert distances[0].min() == pytest.approx(distances[1].min(), abs=0.05)
    assert places[0][-1] == pytest.approx(places[1][-1], abs=0.08)
    assert np.hypot(*(places[0][-1] - places[0][20])[:2]) > 0.2, "it bounced"


def test_a_standby_server_gets_the_ball_of_its_episode() -> None:
    with opened(T1, 1, standby_servers=True, scene=Scene(ball=True)) as server:
        server.load_starts(Starts(T1.nominal[None], (-2.0, 0.0)))
        row, ball = np.array([0]), server.truth.bodies["ball"]
        for x in (0.0, 0.5, 1.0):
            server.start(row, row, row)
            server.place_ball(row, np.array([[x, 0.0, 0.11]]))
            for _ in range(8):
                server.step(T1.nominal[None])
                assert ball.position[0] == pytest.approx([x, 0.0, 0.11], abs=0.03)
            seen = [server.perceptors["ball"][0, 0]]
            server.step(T1.nominal[None])
            seen.append(server.perceptors["ball"][0, 0])
            assert np.nanmax(seen) == pytest.approx(np.hypot(2.0 + x, 0.8), abs=0.2)


def test_a_server_whose_ball_has_crossed_a_line_is_replaced() -> None:
    with opened(T1, 1, scene=Scene(ball=True), settle_steps=5) as server:
        server.load_starts(Starts(T1.nominal[None]))
        row = np.array([0])
        server.start(row, row)
        server.place_ball(row, np.array([[27.0, 5.0, 0.11]]), np.array([[6.0, 0.0, 0.0]]))
        for targets in swinging(T1, 30):
            server.step(targets)
        assert not server.lost.any()
        server.start(row, row)
        assert server.failures == 1 and not server.lost.any()
        with pytest.raises(ValueError, match="without spin"):
            server.place_ball(row, np.array([[1.0, 0.0, 0.11]]), None, np.ones((1, 3)))


@BOTH
def test_a_server_and_an_embedded_world_print_the_same_numbers(robot: Robot) -> None:
    """From the start on, delay included: every perceptor of 100 steps, after another episode on the same server."""
    loaded = Starts(np.stack([robot.nominal, robot.nominal + 0.02]), (-6.0, 1.5), 0.3)
    row, start = np.array([0]), np.array([0])
    embedded = MujocoSimulator(robot, 1)
    with opened(robot, 1) as server:
        server.load_starts(loaded)
        embedded.load_starts(loaded)
        server.start(row, np.array([1]))
        for targets in swinging(robot, 12):
            server.step(3.0 * targets)
        server.start(row, start)
        embedded.start(row, start)
        assert server.latency_steps == embedded.latency_steps == 2
        for step, targets in enumerate(swinging(robot, 100)):
            for name, values in embedded.perceptors.items():
                np.testing.assert_array_equal(server.perceptors[name], values, err_msg=f"{name} before step {step}")
            assert np.abs(server.truth.torso_position - embedded.truth.torso_position).max() < 0.02  # 5 ms old
            assert np.abs(server.truth.torso_rotation - embedded.truth.torso_rotation).max() < 0.03
            everyone = slice(0, 1)
            assert np.abs(server.torque_shares(everyone) - embedded.torque_shares(everyone)).max() < 0.02
            assert not server.airborne().any() and not server.flight().any()
            server.step(targets)
            embedded.step(targets)
        assert np.abs(server.bodies()[..., :3] - embedded.bodies()[..., :3]).max() < 0.03


def test_the_ball_is_not_where_the_robots_are() -> None:
    """A K1 that touches the ball kills its server; it can start at the ball's first position."""
    with opened(K1, 1) as server:
        server.load_starts(Starts(K1.nominal[None], (0.0, 0.0)))
        server.start(np.array([0]), np.array([0]))
        for targets in swinging(K1, 50):
            server.step(targets)
        assert not server.lost.any()


def test_servers_keep_robots_to_which_nothing_is_sent() -> None:
    """Servers drop a robot after 5 s of silence; neither a busy caller nor a mask of active robots loses one."""
    with opened(T1, 2) as server:
        server.load_starts(Starts(T1.nominal[None]))
        server.start(np.arange(2), np.zeros(2, dtype=np.int64))
        before = server._remote.time.copy()
        deadline = time.monotonic() + 6.5
        targets = np.repeat(T1.nominal[None], 2, axis=0)
        while time.monotonic() < deadline:
            server.step(targets, np.array([True, False]))
            time.sleep(0.1)  # a caller that computes
        assert not server.lost.any()
        cycles = (server._remote.time - before) / 0.02
        assert 2 <= cycles[1] < 20 < cycles[0]


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (lambda simulator: signal_server(simulator, 0, signal.SIGKILL), "exit code -9"),
        # a command for a joint that the robot does not have
        (lambda simulator: simulator._remote._exchange.post(0, False, b"(zz9 0 0 1 1 0)"), "exit code 0"),
    ],
    ids=["killed", "crashed"],
)
def test_a_lost_server_costs_one_episode(fault: Callable[[RemoteMujocoSimulator], None], reason: str) -> None:
    with opened(T1, 2) as server:
        server.load_starts(Starts(T1.nominal[None]))
        server.start(np.arange(2), np.zeros(2, dtype=np.int64))
        fault(server)
        for targets in swinging(T1, 10, 2):
            server.step(targets)
        assert server.lost.tolist() == [True, False] and server.can_fail
        assert reason in server.loss_reason(0) and "log: " in server.loss_reason(0)
        server.start(np.array([0]), np.array([0]))
        assert not server.lost.any() and server.failures == 1
        fault(server)
        for targets in swinging(T1, 10, 2):
            server.step(targets)
        with pytest.raises(ServerLostError, match="2 servers were lost, 1 are allowed"):
            server.start(np.array([0]), np.array([0]))


def test_a_hung_server_is_lost_after_the_timeout() -> None:
    fleet = MujocoFleet(server_launcher(), T1, 1, timeout_s=1.0, max_failures=1)
    try:
        os.killpg(fleet._handles[0].pid, signal.SIGSTOP)  # type: ignore[union-attr]
        while not fleet.failed.all():  # a signal takes a moment
            began = time.monotonic()
            fleet.step(T1.nominal[None])
        assert 0.5 < time.monotonic() - began < 5.0
        assert "no reply within 1.0 s" in fleet.reason(0)
        assert fleet.replace() == [0]
        fleet.step(T1.nominal[None])
        assert not fleet.failed.any()
    finally:
        fleet.close()


def stop_for(fleet: MujocoFleet, server: int, seconds: float) -> threading.Timer:
    """Stop one server for a while, as a busy machine does."""
    pid = fleet._handles[server].pid  # type: ignore[union-attr]
    os.killpg(pid, signal.SIGSTOP)
    timer = threading.Timer(seconds, os.killpg, (pid, signal.SIGCONT))
    timer.start()
    return timer


def test_slow_servers_cost_no_other_its_robot() -> None:
    """Two of four answer late, while the reply of a third, of another group, lies unread."""
    fleet = MujocoFleet(server_launcher(), T1, 4, timeout_s=30.0, max_failures=0)
    timers: list[threading.Timer] = []
    try:
        targets = np.repeat(T1.nominal[None], 4, axis=0)
        slow, unread = np.array([True, True, False, False]), np.array([False, False, True, False])
        began = time.monotonic()
        fleet.send(targets, unread)
        timers += [stop_for(fleet, server, 7.0) for server in (0, 1)]
        while time.monotonic() - began < 7.0:
            fleet.step(targets, slow)  # a signal takes a moment
        fleet.receive(unread)
        for _ in range(3):
            fleet.step(targets)
        assert not fleet.failed[2:].any(), [fleet.reason(row) for row in range(4)]
        # the slow ones may have dropped their robots, or not
    finally:
        for timer in timers:
            timer.join()
        fleet.close()


def test_a_loss_by_our_own_silence_is_no_failure_of_a_server(tmp_path: Path) -> None:
    """The training process is stopped and continued, as by Ctrl-Z, at any place: while it waits, or between steps."""
    program = tmp_path / "trainer.py"
    program.write_text(STOPPED_TRAINER, encoding="utf-8")
    with subprocess.Popen(
        [sys.executable, str(program)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    ) as trainer:
        assert trainer.stdin is not None and trainer.stdout is not None
        assert trainer.stdout.readline() == "ready\n"
        trainer.send_signal(signal.SIGSTOP)
        time.sleep(7.0)  # longer than servers wait
        trainer.send_signal(signal.SIGCONT)
        out, _ = trainer.communicate("end\n", timeout=120)
        assert trainer.returncode == 0
    failed, restarts, reasons = json.loads(out.splitlines()[-1])
    assert failed == [True, True, True] and restarts == 0
    assert all("after this process had sent nothing for" in reason for reason in reasons), reasons


STOPPED_TRAINER = """
import json, sys, threading
import numpy as np
from naosim.mujoco.client import MujocoFleet
from naosim.mujoco.program import server_launcher
from naosim.robots.booster import T1
from tests import forking

forking.install()
fleet = MujocoFleet(server_launcher(), T1, 3, max_failures=0)
targets = np.repeat(T1.nominal[None], 3, axis=0)
ending = threading.Event()
threading.Thread(target=lambda: (sys.stdin.readline(), ending.set()), daemon=True).start()
fleet.step(targets)
print("ready", flush=True)
while not (fleet.failed.all() and ending.is_set()):
    fleet.step(targets)
failed, reasons = fleet.failed.tolist(), [fleet.reason(row) for row in range(3)]
assert fleet.replace() == [0, 1, 2]
fleet.step(targets)
assert not fleet.failed.any()
print(json.dumps([failed, fleet.restarts, reasons]))
fleet.close()
"""


def test_a_server_that_takes_long_to_start_costs_no_other_its_robot() -> None:
    class SlowAtLast:
        """Launcher whose third server starts later than servers wait for silent agents."""

        def __init__(self) -> None:
            self.launcher, self.started = server_launcher(), 0

        def start(self) -> ServerHandle:
            self.started += 1
            if self.started == 3:
                time.sleep(6.0)
            return self.launcher.start()

    fleet = MujocoFleet(SlowAtLast(), T1, 2, max_failures=1)
    try:
        targets = np.repeat(T1.nominal[None], 2, axis=0)
        os.killpg(fleet._handles[0].pid, signal.SIGKILL)  # type: ignore[union-attr]
        while not fleet.failed.any():
            fleet.step(targets)
        assert fleet.replace() == [0]
        fleet.step(targets)
        assert not fleet.failed.any()
    finally:
        fleet.close()


def test_a_standby_server_prepares_the_next_start() -> None:
    poses = np.stack([T1.nominal, T1.nominal])
    poses[1, 2] += 0.3
    with opened(T1, 1, standby_servers=True) as server:
        server.load_starts(Starts(poses, (-2.0, 0.0)))
        row = np.array([0])
        server.start(row, np.array([0]), np.array([1]))
        for targets in swinging(T1, 60):
            server.step(targets)
        running, before = int(server._servers[0]), server._remote.time.copy()
        server.start(row, np.array([1]), np.array([0]))
        assert int(server._servers[0]) != running
        assert (server._remote.time - before).max() < 0.05, "the start was prepared, nothing was left to do"
        assert server.perceptors["joint_angles"][0, 2] == pytest.approx(np.rad2deg(0.3), abs=2.0)


def test_starts_that_the_server_cannot_do_are_refused() -> None:
    with opened(T1, 1) as server:
        with pytest.raises(ValueError, match="upright only; use the embedded simulator"):
            server.load_starts(Starts(T1.nominal[None], orientations=np.array([[0.0, 1.0, 0.0, 0.0]])))
        with pytest.raises(ValueError, match="use a position with x <= 0"):
            server.load_starts(Starts(T1.nominal[None], (1.0, 0.0)))


def test_a_server_that_does_not_wait_or_does_not_run_is_named() -> None:
    hasty = ServerProgram(
        "rcssservermj", tuple(a for a in RCSSSERVERMJ.arguments if a not in ("--sync", "--no-realtime"))
    )
    launcher = ProcessLauncher(hasty, (sys.executable, "-m", "rcsssmj"))
    with (
        pytest.raises(ServerLostError, match="it must run in sync mode"),
        MujocoFleet(launcher, T1, 1, start_timeout_s=15.0, max_failures=0) as fleet,
    ):
        while True:  # on a busy machine it may be too slow to be noticed when it starts
            fleet.step(np.zeros((1, len(T1.joint_names))))
            fleet.replace()
    broken = ProcessLauncher(RCSSSERVERMJ, ("sh", "-c", "echo oh no; exit 3"))
    with pytest.raises(ServerLostError, match=r"exit code 3, log: \.\.\.oh no"):
        MujocoFleet(broken, T1, 1)
