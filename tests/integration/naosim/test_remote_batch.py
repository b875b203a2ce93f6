from __future__ import annotations

import os
import select
import shutil
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
from naosim.launchers import Address, ProcessLauncher
from naosim.robots import nao_model
from naosim.simspark import RCSSSERVER3D, BatchSimulator, RemoteBatch, embedded_launcher
from naosim.simspark.program import PROGRAM_VARIABLE
from naosim.simspark.server_robot import SPAWN
from naosim.simulator import ServerLostError

ENTRY = ((-14.2, 9.2, 0.4), -90.0)


def commands(rng: np.random.Generator, n: int, robot_type: int) -> np.ndarray:
    model = nao_model.model(robot_type)
    return rng.uniform(-1, 1, size=(n, len(model.joints))) * np.minimum(model.max_speed, 3.0)


def embedded() -> ProcessLauncher:
    return embedded_launcher("--seed", "1")


@pytest.mark.parametrize("robot_type", [0, 4])
def test_the_wire_changes_nothing(robot_type: int) -> None:
    """The engine in process and the engine behind `naosim serve` return the same perceptors, to the last digit."""
    rng = np.random.default_rng(robot_type)
    engine = BatchSimulator(1, robot_type)
    still = np.zeros((1, len(engine.model.joints)))
    with RemoteBatch(embedded(), 1, robot_type, exact=True) as remote:
        engine.beam(SPAWN)
        engine.step(still)
        engine.beam(*ENTRY)
        while engine.perceptors.time[0] < remote.perceptors.time[0] - 0.01:
            engine.step(still)
        for cycle in range(150):
            speeds = commands(rng, 1, robot_type).astype(np.float32).astype(np.float64)
            engine.step(speeds)
            remote.step(speeds)
            assert not remote.failed.any(), remote.reason(0)
            for name in ("joint_angles", "gyro", "accel", "foot_left", "foot_right", "time"):
                ours, theirs = getattr(engine.perceptors, name), getattr(remote.perceptors, name)
                np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-9, err_msg=f"{name}, cycle {cycle}")
            np.testing.assert_allclose(remote.truth.torso_position, engine.truth.torso_position, atol=1e-4)
            np.testing.assert_allclose(remote.truth.torso_rotation, engine.truth.torso_rotation, atol=1e-5)


def test_robots_are_moved_untangled_and_stepped_side_by_side() -> None:
    rng = np.random.default_rng(0)
    with RemoteBatch(embedded(), 2) as remote:
        remote.beam([[-10.0, 1.0, 0.4], [-5.0, -1.0, 0.4]], [-90.0, 0.0])
        np.testing.assert_allclose(remote.truth.torso_position, [[-10, 1, 0.4], [-5, -1, 0.4]], atol=0.03)
        np.testing.assert_allclose(remote.truth.torso_rotation[:, :, 1], [[1, 0, 0], [0, 1, 0]], atol=0.02)
        before = remote.perceptors.time.copy()
        remote.step(np.zeros((2, 22)), np.array([True, False]))
        assert (remote.perceptors.time - before) == pytest.approx([0.02, 0.0])
        for _ in range(60):
            remote.step(commands(rng, 2, 0))
        assert np.abs(remote.perceptors.joint_angles).max() > 20
        remote.reset()
        assert np.abs(remote.perceptors.joint_angles).max() < 1
        remote.beam((-14.0, 0.0, 0.4), -90.0)
        for _ in range(60):
            remote.step(np.zeros((2, 22)))
        np.testing.assert_allclose(remote.truth.torso_position, [[-14, 0, 0.3839]] * 2, atol=0.006)
        with pytest.raises(ValueError, match="speeds: must be finite"):
            remote.step(np.full((2, 22), np.nan))


def test_a_lost_server_is_told_and_replaced_while_the_others_go_on() -> None:
    with RemoteBatch(embedded(), 3, timeout_s=1.0, max_failures=3) as remote:
        still = np.zeros((3, 22))
        killed, hung = remote._handles[0], remote._handles[1]
        os.killpg(killed.pid, signal.SIGKILL)  # type: ignore[union-attr]
        os.killpg(hung.pid, signal.SIGSTOP)  # type: ignore[union-attr]
        remote.step(still)
        remote.step(still)
        assert remote.failed.tolist() == [True, True, False]
        assert "port: closed by the server" in remote.reason(0)
        assert "exit code -9" in remote.reason(0)
        assert "no reply within 1.0 s" in remote.reason(1)
        before = remote.perceptors.time[2]
        remote.step(np.full((3, 22), [[np.nan], [np.inf], [0.0]]))  # as from the perceptors of worlds that diverged
        assert remote.perceptors.time[2] == pytest.approx(before + 0.02)
        with pytest.raises(ValueError, match="speeds: must be finite numbers"):
            remote.step(np.full((3, 22), np.nan))
        assert remote.replace() == [0, 1]
        assert not remote.failed.any()
        remote.beam((-14.0, 0.0, 0.4), -90.0)
        assert not remote.failed.any()
        assert remote.restarts == 2
        for _ in range(2):
            os.killpg(remote._handles[2].pid, signal.SIGKILL)  # type: ignore[union-attr]
            remote.step(still)
            remote.step(still)
            if remote.restarts == 3:
                break
            remote.replace()
        with pytest.raises(ServerLostError, match="4 servers were lost, 3 are allowed"):
            remote.replace()


def test_idle_servers_are_kept_alive(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also while the reply of another server is awaited, and while a reply lies unread."""
    monkeypatch.setattr(RemoteBatch, "silence_s", 0.3)
    with RemoteBatch(embedded(), 3, timeout_s=3.0) as remote:
        os.killpg(remote._handles[0].pid, signal.SIGSTOP)  # type: ignore[union-attr]
        before = remote.perceptors.time.copy()
        still = np.zeros((3, 22))
        remote.send(still, np.array([False, True, False]))
        while not remote.failed[0]:  # a signal takes a moment
            remote.step(still, np.array([True, False, False]))
        assert remote.failed.tolist() == [True, False, False]
        assert (remote.perceptors.time[1:] - before[1:] >= 0.06 - 1e-9).all()
        remote.receive(np.array([False, True, False]))
        remote.step(still)
        assert remote.failed.tolist() == [True, False, False]


def test_a_server_that_cannot_start_is_told() -> None:
    with pytest.raises(
        ServerLostError, match=r"server 0: the server has ended \(process \d+, exit code 3, log: \.\.\.oh no\)"
    ):
        RemoteBatch(ProcessLauncher(RCSSSERVER3D, ("sh", "-c", "echo oh no; exit 3")), 1)
    with pytest.raises(ServerLostError, match="Connection refused"):
        RemoteBatch([Address("127.0.0.1", 9, 10)])


OWNER = """
import sys
from naosim.launchers import ProcessLauncher
from naosim.simspark import RCSSSERVER3D, RemoteBatch, embedded_launcher
launcher = ProcessLauncher(RCSSSERVER3D, (sys.argv[1],)) if sys.argv[1:] else embedded_launcher()
remote = RemoteBatch(launcher, 2)
print(*(handle.pid for handle in remote._handles), flush=True)
print(*(handle.folder for handle in remote._handles), flush=True)
sys.stdin.read()
"""


PROGRAM = shutil.which(os.environ.get(PROGRAM_VARIABLE, "rcssserver3d"))
"""The real server's program: the one that the service would start, or the one in the search path."""
REAL = pytest.param(
    PROGRAM,
    marks=(
        pytest.mark.rcssserver3d,
        pytest.mark.skipif(PROGRAM is None, reason="no rcssserver3d in NAOSPRINT_SIMSERVER or in the search path"),
    ),
)


@pytest.mark.parametrize("program", [None, REAL])
def test_nothing_outlives_an_owner_that_is_killed(program: str | None) -> None:
    command = [sys.executable, "-c", OWNER, *([program] if program else [])]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as owner:
        assert owner.stdout is not None
        guards = [int(pid) for pid in owner.stdout.readline().split()]
        assert len(guards) == 2
        homes = owner.stdout.readline().decode().split()
        assert all(os.path.isdir(home) for home in homes)
        groups = [os.pidfd_open(pid) for pid in (*guards, *(child for pid in guards for child in children(pid)))]
        assert len(groups) == 4
        owner.kill()
    try:
        for fd in groups:
            waiter = threading.Thread(target=lambda fd=fd: wait_pidfd(fd))
            waiter.start()
            waiter.join(20)
            assert not waiter.is_alive(), "it still runs after its owner's death"
        assert not any(os.path.isdir(home) for home in homes), "its folder still exists"
    finally:
        for fd in groups:
            os.close(fd)


def children(pid: int) -> list[int]:
    with open(f"/proc/{pid}/task/{pid}/children", encoding="utf-8") as file:
        return [int(child) for child in file.read().split()]


def wait_pidfd(fd: int) -> None:
    select.select([fd], [], [], 20)


@pytest.mark.rcssserver3d
@pytest.mark.skipif(PROGRAM is None, reason="no rcssserver3d in NAOSPRINT_SIMSERVER or in the search path")
def test_the_real_server_is_driven_like_the_engine() -> None:
    with RemoteBatch(ProcessLauncher(RCSSSERVER3D, (str(PROGRAM),)), 2) as remote:
        remote.beam((-14.0, 0.0, 0.4), -90.0)
        for _ in range(100):
            remote.step(np.zeros((2, 22)))
        assert not remote.failed.any(), [remote.reason(k) for k in range(2)]
        np.testing.assert_allclose(remote.truth.torso_position, [[-14, 0, 0.3839]] * 2, atol=0.006)
        remote.reset()
        assert np.abs(remote.perceptors.joint_angles).max() < 1
