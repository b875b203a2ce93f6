"""Train and judge on servers: the observations are the engine's, and a server's death costs no more than an episode."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naosim.launchers import ProcessLauncher, ServerHandle
from naosim.simspark import RCSSSERVER3D, embedded_launcher
from naosim.simspark.server_robot import SPAWN
from naosim.simulator import ServerLostError
from naospec import EvaluationSpec, TrainingSpec, task
from naosprint import NullReporter, evaluate, train
from naosprint.__main__ import main
from naosprint.arrays import BoolArray, FloatArray, IntArray
from naosprint.environment import SprintBatch
from naosprint.gym_env import SprintEnv
from naosprint.servers import RemoteSimulator
from naosprint.simulator import EmbeddedSimulator

SPRINT = task("sprint1")
ENTRY = ((-14.2, 9.2, 0.4), -90.0)  # where the server puts a player who enters the field


class Engine(EmbeddedSimulator):
    """Do what a server does with its robot from the first cycle on, numbers in single precision as on the wire."""

    def enter(self, time_s: float) -> None:
        """Spawn the robot, put it on the field after a cycle and let it stand until ``time_s``."""
        still = np.zeros((1, len(self.model.joints)))
        self._engine.beam(SPAWN)
        self._engine.step(still)
        self._engine.beam(*ENTRY)
        while self._engine.perceptors.time[0] < time_s - 0.01:
            self._engine.step(still)

    def start(self, rows: IntArray, starts: IntArray, following: IntArray | None = None) -> None:
        """Leave the robot where it stands."""

    def step(self, speeds: FloatArray, active: BoolArray | None = None) -> None:
        """Advance by one cycle."""
        self.sent = speeds.astype(np.float32).astype(np.float64)
        super().step(self.sent, active)


class Server(RemoteSimulator):
    """Run the robot on a server, from where it stands."""

    leader: Engine | None = None
    """Whose joint speeds it repeats: one angle rounded the other way sends a robot on a path of its own."""

    def step(self, speeds: FloatArray, active: BoolArray | None = None) -> None:
        """Advance by one cycle."""
        super().step(speeds if self.leader is None else self.leader.sent, active)

    def start(self, rows: IntArray, starts: IntArray, following: IntArray | None = None) -> None:
        """Leave the robot where it stands."""


def batch_of(simulator: EmbeddedSimulator | RemoteSimulator) -> SprintBatch:
    """Return the task on a simulator."""
    return SprintBatch(simulator, SPRINT, robot_type=0, fall_height_m=0.27)


def embedded() -> ProcessLauncher:
    """Return a launcher of the drop-in server without chance."""
    return embedded_launcher("--seed", "1")


def test_both_simulators_show_the_same_89_numbers() -> None:
    """Equal to the last digit of each; the torso's pose to the six digits in which a monitor gets it."""
    engine = Engine(1, robot_type=0, task=SPRINT)
    server = Server(embedded(), 1, robot_type=0, task=SPRINT, max_failures=0, exact=True)
    ours, theirs = batch_of(engine), batch_of(server)
    try:
        engine.enter(float(server._remote.perceptors.time[0]))
        names = ours.observer.names
        assert len(names) == 89
        tolerance = np.full(89, 1e-9)
        for name in ("yaw", "yaw_rate", "height", "height_rate"):
            tolerance[names.index(name)] = 5e-6
        rows = np.array([0])
        ours.restart(rows, rows)
        theirs.restart(rows, rows)
        rng = np.random.default_rng(7)
        moved = np.zeros(89, dtype=np.bool_)
        first = ours.observations[0].copy()
        for cycle in range(250):
            action = np.clip(0.4 * rng.normal(size=(1, 20)), -1.0, 1.0)
            error = np.abs(ours.step(action) - theirs.step(action))[0]
            worst = int(np.argmax(error / tolerance))
            assert error[worst] <= tolerance[worst], f"cycle {cycle}: {names[worst]} differs by {error[worst]:g}"
            moved |= ours.observations[0] != first
            assert theirs.rewards[0] == pytest.approx(ours.rewards[0], abs=2e-4)
        assert ours.terminated == theirs.terminated
        assert [name for name, changed in zip(names, moved, strict=True) if not changed] == []
    finally:
        theirs.close()


@pytest.mark.rcssserver3d
@pytest.mark.skipif(shutil.which("rcssserver3d") is None, reason="no rcssserver3d in the search path")
@pytest.mark.parametrize("robot_type", range(5))
def test_the_real_server_shows_the_numbers_of_the_engine(robot_type: int) -> None:
    """One sequence of actions from the same fall: equal but for rounding, until contacts amplify what was rounded."""
    engine = Engine(1, robot_type=robot_type, task=SPRINT)
    server = Server(ProcessLauncher(RCSSSERVER3D), 1, robot_type=robot_type, task=SPRINT, max_failures=0, exact=True)
    ours, theirs = (SprintBatch(it, SPRINT, robot_type=robot_type, fall_height_m=0.1) for it in (engine, server))
    try:
        remote, x, y, z = server._remote, -10.0, 0.0, engine.model.standing_height + 0.1
        entered = remote._exchange.counts(0)[0]
        remote.beam((x, y, z), -90.0)
        calls = remote._exchange.counts(0)[0] - entered
        falls = z - 9.81 * 0.02**2 * np.cumsum(np.arange(10)) - remote.truth.torso_position[0, 2]
        fallen = int(np.argmin(np.abs(falls)))
        assert np.abs(falls[fallen]) < 1e-3
        # the head was turned in all of those cycles, whether the robot had been moved yet or not
        engine.enter(0.02 * entered)
        for cycle in range(calls):
            if cycle == calls - fallen:
                engine._engine.beam((x, y, z), -90.0)
            engine.step(remote._nudge)
        for _ in range(30):
            engine.step(remote._nudge)
            remote.step(remote._nudge)
        server.leader = engine
        rows = np.array([0])
        ours.restart(rows, rows)
        theirs.restart(rows, rows)
        # twice the league's digit for what is read, four times for a difference of two readings
        limits = {"force": 0.1, "centre": 0.01, "accel": 0.05, "gyro": 2e-3, "com": 1e-4}
        tolerance = np.array([next((v for k, v in limits.items() if k in name), 5e-4) for name in ours.observer.names])
        rng = np.random.default_rng(robot_type)
        for cycle in range(60):
            action = np.clip(0.4 * rng.normal(size=(1, ours.actuation.n_actions)), -1.0, 1.0)
            error = np.abs(ours.step(action) - theirs.step(action))[0]
            worst = int(np.argmax(error / tolerance))
            name = ours.observer.names[worst]
            assert error[worst] <= tolerance[worst], f"cycle {cycle}: {name} differs by {error[worst]:g}"
            assert not theirs.lost.any()
    finally:
        theirs.close()


def test_a_server_starts_robots_as_the_engine_does() -> None:
    """Put down and settled, the robot stands as in the engine's snapshot, in the pose that was drawn for it."""
    engine = batch_of(EmbeddedSimulator(2, robot_type=0, task=SPRINT))
    server = batch_of(RemoteSimulator(embedded(), 2, robot_type=0, task=SPRINT, max_failures=0))
    try:
        poses = np.repeat(engine.actuation.start_pose()[None], 2, axis=0)
        poses[1, engine.actuation.index[0]] += 0.2
        for batch in (engine, server):
            batch.load_starts(poses)
            batch.restart(np.array([1, 0]), np.array([0, 1]))
        limits = {"j": 0.006, "height": 0.006, "yaw": 0.02, "com": 0.002, "gyro": 0.2, "accel": 1.0}
        for prefix, limit in limits.items():
            of_kind = [prefix in name for name in engine.observer.names]
            np.testing.assert_allclose(
                server.observations[:, of_kind], engine.observations[:, of_kind], rtol=0, atol=limit, err_msg=prefix
            )
        np.testing.assert_allclose(
            server.simulator.truth.torso_position, engine.simulator.truth.torso_position, rtol=0, atol=0.02
        )
        ours, theirs = engine.simulator.truth.bodies, server.simulator.truth.bodies
        np.testing.assert_allclose(theirs[..., :3], ours[..., :3], rtol=0, atol=0.02)
        np.testing.assert_allclose(np.abs((theirs[..., 3:7] * ours[..., 3:7]).sum(axis=-1)), 1.0, atol=1e-3)
    finally:
        server.close()


def test_a_standby_server_prepares_the_next_start_while_the_robot_runs() -> None:
    """The two change places at the start, which then takes no cycle of the robot that goes on running."""
    simulator = RemoteSimulator(embedded(), 2, robot_type=0, task=SPRINT, max_failures=1, standby_servers=True)
    batch = batch_of(simulator)
    try:
        poses = np.repeat(batch.actuation.start_pose()[None], 3, axis=0)
        bent = batch.actuation.index[0]
        poses[1, bent] += 0.2
        poses[2, bent] -= 0.2
        everyone, actions = np.arange(2), np.zeros((2, batch.actuation.n_actions))
        batch.load_starts(poses)

        def bend(row: int) -> float:
            return float(np.deg2rad(simulator.perceptors.joint_angles[row, bent]))

        batch.restart(everyone, np.array([0, 0]), np.array([1, 2]))
        assert bend(1) == pytest.approx(poses[0, bent], abs=0.01)
        for _ in range(120):
            batch.step(actions)
        alone = np.array([1])
        before = simulator.perceptors.time[0]
        batch.restart(alone, np.array([2]), np.array([1]))
        assert bend(1) == pytest.approx(poses[2, bent], abs=0.01)
        assert simulator.truth.torso_position[1, 0] == pytest.approx(SPRINT.start_x_m, abs=0.02)
        assert simulator.perceptors.time[0] == before, "the other robot was held up"
        # told wrongly, and with a standby that has died meanwhile: both cost time, no more
        kill(simulator._remote._handles[simulator._standbys[1].server])  # type: ignore[arg-type]
        for _ in range(5):
            batch.step(actions)
        assert not batch.lost.any()
        batch.restart(alone, np.array([0]))
        assert bend(1) == pytest.approx(poses[0, bent], abs=0.01)
        assert simulator.failures == 1
    finally:
        batch.close()


def test_a_group_starts_over_while_the_servers_of_the_other_compute() -> None:
    """Robots that are stepped in turns perceive what they would side by side, a restart in between included."""
    simulators = [RemoteSimulator(embedded(), 3, robot_type=0, task=SPRINT, max_failures=0) for _ in range(2)]
    together, turns = (batch_of(simulator) for simulator in simulators)
    try:
        groups = turns.simulator.groups
        assert groups == (slice(0, 2), slice(2, 3))
        poses = np.repeat(turns.actuation.start_pose()[None], 2, axis=0)
        poses[1, turns.actuation.index[0]] += 0.2
        for batch in (together, turns):
            batch.load_starts(poses)
            batch.restart(np.arange(3), np.array([0, 1, 0]))
        rng = np.random.default_rng(3)
        actions = 0.2 * rng.standard_normal((30, 3, turns.actuation.n_actions))
        for group in groups:
            turns.send(actions[0, group], group)
        for cycle in range(30):
            together.step(actions[cycle])
            for group in groups:
                turns.receive(group)
                np.testing.assert_array_equal(turns.observations[group], together.observations[group])
                np.testing.assert_array_equal(turns.rewards[group], together.rewards[group])
                if cycle == 15 and group.start == 0:
                    for batch in (together, turns):
                        batch.restart(np.array([1]), np.array([0]))
                if cycle < 29:
                    turns.send(actions[cycle + 1, group], group)
        assert list(turns.steps) == list(together.steps) == [30, 14, 30]
    finally:
        together.close()
        turns.close()


class Killer(NullReporter):
    """Kill a server after each of the first updates."""

    def __init__(self, handles: list[ServerHandle], deaths: int) -> None:
        self.handles, self.deaths = handles, deaths
        self.rows: list[dict[str, float]] = []
        self.lines: list[tuple[str, str]] = []

    def metrics(self, row: dict[str, float]) -> None:
        """Keep the figures."""
        self.rows.append(row)
        if len(self.rows) <= self.deaths:
            kill(self.handles[-1])

    def log(self, level: str, message: str) -> None:
        """Keep the line."""
        self.lines.append((level, message))


def kill(handle: ServerHandle) -> None:
    """End a server and its guard at once."""
    os.killpg(handle.pid, signal.SIGKILL)  # type: ignore[attr-defined]


@pytest.fixture
def handles(monkeypatch: pytest.MonkeyPatch) -> list[ServerHandle]:
    """Return the servers that are started from now on."""
    started: list[ServerHandle] = []
    start = ProcessLauncher.start

    def remember(launcher: ProcessLauncher) -> ServerHandle:
        handle = start(launcher)
        started.append(handle)
        return handle

    monkeypatch.setattr(ProcessLauncher, "start", remember)
    monkeypatch.setenv("NAOSPRINT_SIMSERVER", "embedded")
    return started


def small_spec(**fields: Any) -> TrainingSpec:
    """Return a specification that trains within seconds, with one server an environment."""
    defaults: dict[str, Any] = {
        "simulator": "rcssserver3d",
        "standby_servers": False,
        "n_envs": 2,
        "n_steps": 64,
        "batch_size": 64,
        "n_epochs": 1,
        "total_steps": 384,
        "hidden_sizes": (16, 16),
        "simulator_threads": 1,
        "torch_threads": 1,
    }
    return TrainingSpec.model_validate({**defaults, **fields})


def test_training_survives_a_server_that_is_killed_and_is_judged_on_servers(
    tmp_path: Path, handles: list[ServerHandle], capsys: pytest.CaptureFixture[str]
) -> None:
    """One episode is cut off with the reason and counted; the other environment does not notice."""
    reporter = Killer(handles, deaths=1)
    result = train(small_spec(), workdir=tmp_path, reporter=reporter)
    assert (result.status, result.steps) == ("finished", 384)
    assert [row["server_failures"] for row in reporter.rows] == [0.0, 1.0, 1.0]
    (warning,) = [line for level, line in reporter.lines if level == "warning"]
    assert warning.startswith("environment ")
    assert "episode cut off after" in warning
    assert "exit code -9" in warning
    assert len(handles) == 3
    assert not any(handle.alive() for handle in handles)

    # an episode whose server dies is run again
    killed: list[int] = []

    def progress(done: int, total: int) -> None:
        if not killed:
            killed.append(done)
            kill(handles[-1])

    spec = EvaluationSpec(episodes=4, n_envs=2, task="sprint2", bootstrap_resamples=100)
    evaluation = evaluate(result.checkpoint, spec, progress=progress)
    assert evaluation.summary["server_failures"] == 1
    assert evaluation.summary["episodes"] == 4
    assert len(evaluation.trajectories.x) == 4
    assert np.abs(evaluation.trajectories.x[:, 0] + 14.0).max() < 0.1
    assert np.isfinite(evaluation.replay.positions).all()

    started = len(handles)
    twice = small_spec(standby_servers=True)
    assert train(twice, workdir=tmp_path / "standby", reporter=NullReporter()).steps == 384
    assert len(handles) == started + 4

    words = f"evaluate {result.checkpoint} --simulator rcssserver3d --task sprint2 --episodes 1 --n-envs 1"
    capsys.readouterr()
    assert main(words.split()) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 1


def test_too_many_failures_end_training_with_the_reason(tmp_path: Path, handles: list[ServerHandle]) -> None:
    """What was learnt until then is saved."""
    reporter = Killer(handles, deaths=1)
    with pytest.raises(ServerLostError, match=r"1 servers were lost, 0 are allowed; .*exit code -9"):
        train(small_spec(max_server_failures=0, n_envs=1), workdir=tmp_path, reporter=reporter)
    assert (tmp_path / "step-000000000064" / "checkpoint.json").is_file()
    assert not any(handle.alive() for handle in handles)


def test_the_gymnasium_environment_says_why_an_episode_was_cut_off(handles: list[ServerHandle]) -> None:
    """Truncated, not terminated; the observation is the last that the server gave."""
    env = SprintEnv(small_spec())
    try:
        before, _ = env.reset(seed=0)
        kill(handles[0])
        for _ in range(3):  # a reply may still be on its way
            observation, _, terminated, truncated, info = env.step(np.zeros(20))
            if truncated:
                break
            before = observation
        assert truncated
        assert not terminated
        assert "exit code -9" in info["server_lost"]
        assert np.array_equal(observation, before)
        again, _ = env.reset(seed=0)
        assert again[0] == 0.0
        assert not env.step(np.zeros(20))[3]
    finally:
        env.close()
