"""Training and evaluation on servers: the observations are the engine's, and a lost server costs only an episode."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from naosim import robots
from naosim.launchers import ProcessLauncher, ServerHandle
from naosim.simspark import RCSSSERVER3D, EmbeddedSimulator, RemoteSimulator, embedded_launcher
from naosim.simspark.control import motor_speeds
from naosim.simspark.server_robot import SPAWN
from naosim.simulator import ServerLostError
from naospec import EvaluationSpec, TrainingSpec
from naospec.flat import nest
from naosprint import NullReporter, evaluate, train
from naosprint.__main__ import main
from naosprint.arrays import BoolArray, FloatArray, IntArray
from naosprint.tasks.environment import Environment
from naosprint.tasks.sprint import Sprint1, SprintSettings

ENTRY = ((-14.2, 9.2, 0.4), -90.0)  # where the server puts a player who enters the field


class Engine(EmbeddedSimulator):
    """Engine whose robot repeats a server's from the first cycle on, in single precision as on the wire."""

    sent: FloatArray

    def enter(self, time_s: float) -> None:
        """Spawn the robot, put it on the field after a cycle and let it stand until ``time_s``."""
        still = np.zeros((1, len(self.robot.joints)))
        self._engine.beam(SPAWN)
        self._engine.step(still)
        self._engine.beam(*ENTRY)
        while self._engine.perceptors.time[0] < time_s - 0.01:
            self._engine.step(still)

    def start(self, rows: IntArray, starts: IntArray, following: IntArray | None = None) -> None:
        """Leave the robot where it stands."""

    def step_async(self, targets_rad: FloatArray, rows: slice, active: BoolArray | None = None) -> None:
        """Store the targets of a step."""
        self._targets = np.array(targets_rad)
        assert active is None and rows == slice(0, self.n)

    def step_wait(self, rows: slice) -> None:
        """Run a step with joint speeds as they are sent."""
        speeds = motor_speeds(self._targets, self.perceptors["joint_angles"], self._max_speed)
        self.sent = speeds.astype(np.float32).astype(np.float64)
        self._engine.step(self.sent)


class Server(RemoteSimulator):
    """Server whose robot starts from where it stands."""

    leader: Engine | None = None
    """Engine whose joint speeds it repeats: one angle rounded the other way sends a robot on another path."""

    def _commands_of(self, targets_rad: FloatArray, rows: slice) -> FloatArray:
        return super()._commands_of(targets_rad, rows) if self.leader is None else self.leader.sent

    def start(self, rows: IntArray, starts: IntArray, following: IntArray | None = None) -> None:
        """Leave the robot where it stands."""


def environment_of(simulator: EmbeddedSimulator | RemoteSimulator, min_height_m: float = 0.27) -> Environment:
    """Return sprint task I on a simulator."""
    settings = SprintSettings(name="sprint1", reward_scale=1.0, drift_penalty=0.0, min_height_m=min_height_m)
    return Environment(simulator, Sprint1, settings)


def test_both_simulators_show_the_same_89_numbers() -> None:
    """Equal to the last digit of each; the torso's pose to the six digits in which a monitor gets it."""
    nao = robots.get("nao-0")
    engine = Engine(nao, 1)
    server = Server(embedded_launcher("--seed", "1"), nao, 1, max_failures=0, exact=True)
    ours, theirs = environment_of(engine), environment_of(server)
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


TOLERANCES = {"force": 0.1, "origin": 0.01, "accel": 0.05, "gyro": 2e-3, "com": 1e-4}
"""By part of an observation's name: twice the league's digit for what is read, four times for a difference of two."""


def tolerance_of(observation: str) -> float:
    return next((value for part, value in TOLERANCES.items() if part in observation), 5e-4)


def test_every_tolerance_is_one_of_an_observation() -> None:
    environment = environment_of(EmbeddedSimulator(robots.get("nao-0"), 1))
    try:
        names = environment.observer.names
    finally:
        environment.close()
    assert [part for part in TOLERANCES if not any(part in name for name in names)] == []


@pytest.mark.rcssserver3d
@pytest.mark.skipif(shutil.which("rcssserver3d") is None, reason="no rcssserver3d in the search path")
@pytest.mark.parametrize("robot_type", range(5))
def test_the_real_server_shows_the_numbers_of_the_engine(robot_type: int) -> None:
    """One sequence of actions from the same fall: equal but for rounding, until contacts amplify what was rounded."""
    nao = robots.get(f"nao-{robot_type}")
    engine = Engine(nao, 1)
    server = Server(ProcessLauncher(RCSSSERVER3D), nao, 1, max_failures=0, exact=True)
    ours, theirs = (environment_of(simulator, min_height_m=0.1) for simulator in (engine, server))
    try:
        remote, x, y, z = server._remote, -10.0, 0.0, nao.standing_height_m + 0.1
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
            engine._engine.step(remote._nudge)
        for _ in range(30):
            engine._engine.step(remote._nudge)
            remote.step(remote._nudge)
        server._refresh(slice(0, 1))
        server.leader = engine
        rows = np.array([0])
        ours.restart(rows, rows)
        theirs.restart(rows, rows)
        tolerance = np.array([tolerance_of(name) for name in ours.observer.names])
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


class Killer(NullReporter):
    """Reporter that kills a server after each of the first updates."""

    def __init__(self, handles: list[ServerHandle], deaths: int) -> None:
        self.handles, self.deaths = handles, deaths
        self.rows: list[dict[str, float]] = []
        self.lines: list[tuple[str, str]] = []

    def metrics(self, row: dict[str, float]) -> None:
        """Keep the metrics."""
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
    """Return the list of servers started from now on."""
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
        "simulator": "server",
        "standby_servers": False,
        "n_envs": 2,
        "n_steps": 64,
        "batch_size": 64,
        "n_epochs": 1,
        "total_steps": 384,
        "hidden_sizes": (16, 16),
        "learner_threads": 1,
    }
    return TrainingSpec.model_validate(nest({**defaults, **fields}))


def test_training_survives_a_server_that_is_killed_and_is_evaluated_on_servers(
    tmp_path: Path,
    handles: list[ServerHandle],
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """One episode is truncated with the reason, told once, and counted; the other environment is not affected."""
    reporter = Killer(handles, deaths=1)
    result = train(small_spec(), workdir=tmp_path, reporter=reporter)
    assert (result.status, result.steps) == ("finished", 384)
    assert [row["server_failures"] for row in reporter.rows] == [0.0, 1.0, 1.0]
    (warning,) = [line for level, line in reporter.lines if level == "warning"]
    assert warning.startswith("environment ")
    assert "episode truncated after" in warning
    assert "exit code -9" in warning
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == []
    assert len(handles) == 3
    assert not any(handle.alive() for handle in handles)

    # an episode whose server dies is run again
    killed: list[int] = []

    def progress(done: int, total: int) -> None:
        if not killed:
            killed.append(done)
            kill(handles[-1])

    spec = EvaluationSpec.model_validate({"episodes": 4, "n_envs": 2, "task": "sprint2", "bootstrap_resamples": 100})
    evaluation = evaluate(result.checkpoint, spec, progress=progress)
    assert evaluation.summary["server_failures"] == 1
    (told,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "is run again, its robot was lost" in told
    assert evaluation.summary["episodes"] == 4
    assert len(evaluation.trajectories.x) == 4
    assert np.abs(evaluation.trajectories.x[:, 0] + 14.0).max() < 0.1
    assert np.isfinite(evaluation.replay.positions).all()

    started = len(handles)
    twice = small_spec(standby_servers=True)
    assert train(twice, workdir=tmp_path / "standby", reporter=NullReporter()).steps == 384
    assert len(handles) == started + 4

    words = f"evaluate --json {result.checkpoint} --simulator server --task sprint2 --episodes 1 --n-envs 1"
    capsys.readouterr()
    assert main(words.split()) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 1


def test_too_many_failures_end_training_with_the_reason(tmp_path: Path, handles: list[ServerHandle]) -> None:
    """The training until then is saved."""
    reporter = Killer(handles, deaths=1)
    with pytest.raises(ServerLostError, match=r"1 servers were lost, 0 are allowed; .*exit code -9"):
        train(small_spec(max_server_failures=0, n_envs=1), workdir=tmp_path, reporter=reporter)
    assert (tmp_path / "step-000000000064" / "checkpoint.json").is_file()
    assert not any(handle.alive() for handle in handles)


def test_the_gymnasium_environment_says_why_an_episode_was_truncated(handles: list[ServerHandle]) -> None:
    """Truncated, not terminated; the observation is the last that the server gave."""
    env = gymnasium.make("naosprint/Sprint-v0", simulator="server").unwrapped
    try:
        before, _ = env.reset(seed=0)
        kill(handles[0])
        for _ in range(3):  # a reply may still be on its way
            observation, _, terminated, truncated, info = env.step(np.zeros(20, np.float32))
            if truncated:
                break
            before = observation
        assert truncated
        assert not terminated
        assert "exit code -9" in info["server_lost"]
        assert np.array_equal(observation, before)
        again, _ = env.reset(seed=0)
        assert again[0] == 0.0
        assert not env.step(np.zeros(20, np.float32))[3]
    finally:
        env.close()
