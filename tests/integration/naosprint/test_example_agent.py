"""The example agent plays on real rcssservermj servers as the policy does in naosprint's own simulators."""

from __future__ import annotations

import importlib
import importlib.util
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naosim.launchers import Address, ProcessLauncher, ServerProgram
from naosim.mujoco.program import RCSSSERVERMJ
from naospec import TrainingSpec
from naosprint.export import policy_arrays
from naosprint.rl.checkpoint import Manifest
from naosprint.rl.policy import NetworkPolicy
from naosprint.tasks.environment import open_environment

from tests.integration.naosim.wire import Player
from tests.integration.naosim.wire import serving as serving_naos

EXAMPLES = Path(__file__).parents[3] / "packages/naosprint/examples"
AGENT = EXAMPLES / "run_policy_t1.py"
PROGRAM = (sys.executable, "-m", "rcsssmj")
REALTIME = ServerProgram(
    name="rcssservermj",
    arguments=("--aport", "{agent_port}", "--mport", "{monitor_port}", "--no-render"),
    stop_signal=RCSSSERVERMJ.stop_signal,
)
RESULT = re.compile(r"(-?\d+\.\d\d) m in (\d+\.\d\d) s\n")


@contextmanager
def serving(program: ServerProgram) -> Iterator[Address]:
    """Run a server; yield its address once it listens."""
    server = ProcessLauncher(program, PROGRAM).start()
    try:
        deadline = time.monotonic() + 60.0
        while not server.owns(server.address.monitor_port):
            assert server.alive() and time.monotonic() < deadline, server.describe()
            time.sleep(0.05)
        yield server.address
    except BaseException as error:
        error.add_note(server.describe())
        raise
    finally:
        server.stop()


def exported(robot: str, folder: Path, spread: float, task: str = "sprint1") -> tuple[NetworkPolicy, Path]:
    """Export an untrained policy, which falls sooner with a wider spread of its weights."""
    spec = TrainingSpec.model_validate({"robot": robot, "task": task})
    environment = open_environment(spec, 1, threads=1)
    names, actions = environment.observer.names, environment.actuation.names
    environment.close()
    rng = np.random.default_rng(4)
    sizes = (len(names), 16, len(actions))
    layers = tuple(
        (rng.normal(0.0, spread, (after, before)).astype(np.float32), rng.normal(0.0, spread, after).astype(np.float32))
        for before, after in pairwise(sizes)
    )
    policy = NetworkPolicy(np.zeros(len(names)), np.ones(len(names)), 10.0, layers, np.zeros(len(actions), np.float32))
    manifest = Manifest.model_construct(
        spec=spec, spec_sha256=spec.digest(), steps=0, stage=0, observations=names, actions=actions
    )
    path = folder / f"{robot}.npz"
    np.savez(path, **policy_arrays(policy, manifest))
    return policy, path


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[np.ndarray, ...]]:
    """Run the agent on a server; return its observations, actions and targets."""

    def run(path: Path, address: Address) -> tuple[np.ndarray, ...]:
        spec = importlib.util.spec_from_file_location("run_policy_t1", AGENT)
        assert spec is not None and spec.loader is not None
        agent: Any = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(agent)
        agent.NOISE_DEG = 0.0
        observe, act = agent.PolicyAgent.observe, agent.PolicyAgent.act
        observations: list[np.ndarray] = []
        actions: list[np.ndarray] = []
        targets: list[np.ndarray] = []

        def watched_observe(self: Any) -> np.ndarray:
            observations.append(observe(self))
            return observations[-1]

        def watched_act(self: Any, observation: np.ndarray) -> np.ndarray:
            targets.append(act(self, observation))
            actions.append(self.action)
            return targets[-1]

        monkeypatch.setattr(agent.PolicyAgent, "observe", watched_observe)
        monkeypatch.setattr(agent.PolicyAgent, "act", watched_act)
        agent.main(path, address.host, address.agent_port, address.monitor_port)
        return np.array(observations), np.array(actions), np.array(targets)

    return run


@pytest.mark.parametrize(("robot", "simulator"), [("t1", "embedded"), ("t1", "server"), ("k1", "embedded")])
def test_the_agent_plays_as_the_policy_does_in_the_simulator(
    robot: str, simulator: str, tmp_path: Path, recorded: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """The agent's actions, repeated in naosprint's simulator, give its observations; the policy gives its actions for
    these.

    The latency is the same as well: one step later, most numbers would differ.
    """
    policy, path = exported(robot, tmp_path, 0.2)
    with serving(RCSSSERVERMJ) as address:
        seen, actions, targets = recorded(path, address)
    assert RESULT.fullmatch(capsys.readouterr().out)
    assert 20 < len(seen) < 1000
    section = {"name": simulator, **({"engine": "mujoco"} if simulator == "embedded" else {})}
    environment = open_environment(
        TrainingSpec.model_validate({"robot": robot, "simulator": section, "task": "sprint1"}), 1, threads=1
    )
    environment.load_starts(environment.task.starts(1, 0, 0.0))
    environment.restart(np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64))
    names = np.array(environment.observer.names)
    # one digit: a thousandth of position and quaternion, a hundredth of a degree; velocities are differences in 20 ms
    digit = np.where(np.char.startswith(names, "velocity_"), 0.06, 2.1e-3)
    differing = 0
    for step in range(20):
        difference = np.abs(seen[step] - environment.observations[0])
        assert (difference < digit).all(), f"step {step}: {names[difference >= digit]}"
        differing += int((difference > 1e-6).sum())
        wanted = policy.act(seen[step][None])
        np.testing.assert_allclose(actions[step], wanted[0], atol=1e-5)
        np.testing.assert_allclose(targets[step], environment.actuation.targets(wanted)[0], atol=1e-5)
        environment.step(actions[step][None])
    environment.close()
    # another server's last bits are others, so that a number may be truncated to the digit beside
    assert differing < 0.02 * 20 * len(names)
    assert np.ptp(targets[:20], axis=0).max() > 0.1


def test_two_agents_play_in_real_time_on_one_field(tmp_path: Path) -> None:
    """A T1 and a K1 of two teams, in lanes of their own; the one that enters second disturbs the first."""
    paths = {robot: exported(robot, tmp_path, 0.3)[1] for robot in ("t1", "k1")}
    with serving(REALTIME) as address:
        agents = [
            subprocess.Popen(
                [
                    *(sys.executable, AGENT, paths[robot], address.host, str(address.agent_port)),
                    *(str(address.monitor_port), team, "3", lane),
                ],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            for robot, team, lane in (("t1", "ours", "4"), ("k1", "theirs", "6"))
        ]
        for agent in agents:
            out, err = agent.communicate(timeout=120)
            assert RESULT.fullmatch(out), (out, err)


def played(program: str, *arguments: object) -> tuple[int, str, str]:
    """Run an example; return its exit status and what it wrote."""
    command = [sys.executable, str(EXAMPLES / program), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    return done.returncode, done.stdout, done.stderr


@contextmanager
def entered(address: Address, text: str) -> Iterator[None]:
    """Send a robot's first message; at the end it leaves, after reading all: unread messages can end the server."""
    data = text.encode()
    with socket.create_connection((address.host, address.agent_port)) as agent:
        agent.sendall(len(data).to_bytes(4, "big") + data)
        assert agent.recv(4, socket.MSG_WAITALL)
        yield
        agent.shutdown(socket.SHUT_WR)
        while agent.recv(1 << 16):
            pass


def run_on(address: Address, path: Path, team: str, number: int) -> tuple[int, str, str]:
    """Run the example agent beside the field's middle."""
    return played(AGENT.name, path, address.host, address.agent_port, address.monitor_port, team, number, -4)


def test_a_run_that_did_not_happen_on_rcssservermj_is_one_sentence(tmp_path: Path) -> None:
    """Names that no server can read, a number that is taken; other names are runs."""
    _, path = exported("t1", tmp_path, 0.3)
    with serving(REALTIME) as address:
        status, out, err = run_on(address, path, "two words", 2)
        assert (status, out) == (1, "")
        assert err == "no run: team 'two words': a name without spaces and parentheses is needed\n"
        with entered(address, "(init T1 gr\u00fcn 3)"):
            status, out, err = run_on(address, path, "gr\u00fcn", 3)
        assert (status, out, err.count("\n")) == (1, "", 1), err
        assert err.startswith("no run: refused: is number 3 of team gr\u00fcn taken")
    with serving(REALTIME) as address:  # another one: a connection that ends may end the server
        status, out, err = run_on(address, path, "gr\u00fcn", 2)
        assert (status, bool(RESULT.fullmatch(out))) == (0, True), (out, err)
    status, out, err = run_on(address, path, "ours", 2)
    assert (status, out, err.count("\n")) == (1, "", 1), err
    assert err.startswith("no run: [Errno"), err


@pytest.mark.parametrize("example", ["run_policy_t1.py", "play_t1.py"])
def test_a_run_in_a_play_mode_without_beams_is_one_sentence(example: str, tmp_path: Path) -> None:
    _, path = exported("t1", tmp_path, 0.3, "sprint1" if example == AGENT.name else "velocity")
    with serving(REALTIME) as address:
        # which stays until the run is over: a connection that ends may end the server
        with socket.create_connection((address.host, address.monitor_port)) as monitor:
            monitor.recv(1)
            monitor.sendall((14).to_bytes(4, "big") + b"(kickOff Left)")
            if example == AGENT.name:
                place, (status, out, err) = "(-14.0, -4.0)", run_on(address, path, "gr\u00fcn", 2)
            else:
                ports = ("--ports", address.agent_port, address.monitor_port)
                place, (status, out, err) = "(-5.0, 0.0)", played(example, path, "--host", address.host, *ports)
        assert (status, out, err.count("\n")) == (1, "", 1), err
        assert f"not at {place}, in play mode KickOff_Left; it can be beamed in BeforeKickOff" in err


def test_a_run_that_did_not_happen_on_naosim_serve_is_one_sentence(tmp_path: Path) -> None:
    """A number that is taken, other robots in the scene, a server in real time; on the right side a run is a run."""
    _, path = exported("nao-0", tmp_path, 0.3)

    def run(server: Any) -> tuple[int, str, str]:
        return played("run_policy.py", path, "127.0.0.1", server.agent_port, server.monitor_port)

    with serving_naos(seed=1) as server:
        for team, reason in (("A", "refused: is number 1 of team A taken"), ("B", "other robots are on the field")):
            player = Player(server.agent_port, team, 1)
            status, out, err = run(server)
            assert (status, out, err.count("\n")) == (1, "", 1), err
            assert err.startswith(f"no run: {reason}")
            player.close()
    with serving_naos(seed=1) as server:
        Player(server.agent_port, "B", 1).close()
        status, out, err = run(server)
        assert status == 0, err
        metres, seconds = map(float, re.findall(r"-?\d+\.\d\d", out)[:2])
        assert 0.0 < seconds < 20.0
        assert abs(metres) < 3.0
    with serving_naos(seed=1, realtime=True) as server:
        status, out, err = run(server)
        assert (status, out, err) == (1, "", "no run: the server runs in real time; start it in sync mode\n")
    with socket.create_server(("127.0.0.1", 0)) as ending:
        port = ending.getsockname()[1]
        agent = subprocess.Popen(
            [sys.executable, EXAMPLES / "run_policy.py", path, "127.0.0.1", str(port), str(port)],
            stderr=subprocess.PIPE,
            text=True,
        )
        for _ in range(2):
            ending.accept()[0].close()
        _, err = agent.communicate(timeout=60)
        assert (agent.returncode, err.count("\n"), err[:7]) == (1, 1, "no run:"), err


def test_the_player_observes_and_commands_as_task_velocity_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its observations while it steers to a point are those of our simulator under the same commands and actions."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    player: Any = importlib.import_module("play_t1")
    _, path = exported("t1", tmp_path, 0.05, "velocity")
    observe, give = player.Player.observe, player.Player.give
    seen: list[np.ndarray] = []
    actions: list[np.ndarray] = []
    given: dict[int, tuple[float, ...]] = {}

    def watched_observe(self: Any) -> np.ndarray:
        seen.append(observe(self))
        return seen[-1]

    def watched_act(self: Any, observation: np.ndarray) -> Any:
        targets = player.PolicyAgent.act(self, observation)
        actions.append(self.action)
        return targets

    def watched_give(self: Any, command: tuple[float, ...]) -> None:
        given[len(seen)] = command
        give(self, command)

    monkeypatch.setattr(player.Player, "observe", watched_observe)
    monkeypatch.setattr(player.Player, "act", watched_act)
    monkeypatch.setattr(player.Player, "give", watched_give)
    monkeypatch.setattr(player, "PATIENCE_S", 1.0)
    with serving(RCSSSERVERMJ) as address:
        ports = (str(address.agent_port), str(address.monitor_port))
        # it hardly moves, so that it misses its target
        assert player.main([str(path), "--targets", "1", "--host", address.host, "--ports", *ports]) == 1
    section = {"name": "embedded", "engine": "mujoco"}
    environment = open_environment(
        TrainingSpec.model_validate({"robot": "t1", "simulator": section, "task": "velocity"}), 1, threads=1
    )
    environment.load_starts(environment.task.starts(1, 0, 0.0))
    everyone = np.zeros(1, dtype=np.int64)
    environment.restart(everyone, everyone)
    task: Any = environment.task
    names = list(environment.observer.names)
    path_names = ("command_forward", "command_sideways", "command_turn", "line_offset", "heading_sin", "heading_cos")
    path_columns = [names.index(name) for name in path_names]
    digit = np.where(np.char.startswith(np.array(names), "velocity_"), 0.06, 3e-3)
    assert len(seen) > 40 and len(given) > 5
    for step in range(40):
        expected = environment.observations[0].copy()
        if step in given:
            task.set_command(everyone, np.array([given[step]]))
            expected[path_columns] = (*given[step], 0.0, 0.0, 1.0)
        difference = np.abs(seen[step] - expected)
        assert (difference < digit).all(), f"step {step}: {[names[i] for i in np.flatnonzero(difference >= digit)]}"
        environment.step(actions[step][None])
    environment.close()
