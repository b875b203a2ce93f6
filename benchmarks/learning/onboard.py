"""Run a policy with onboard sensing on the real rcssserver3d, as a player: no connection to the monitor port.

    NAOSPRINT_SIMSERVER=rcssserver3d python benchmarks/learning/onboard.py [--policy sprint-blind] [--episodes 100]

Every episode has a server of its own. The robot beams itself to its half, with the server's noise of 0.05 m and 10
degrees at most, holds its start pose, and runs once the game is on; the server kicks off by itself. What it observes
comes from the agent port only; true poses are NaN. Speeds and falls are read from the server's own log file after the
episode. Prints speed by the paper's measure, mean speed, distance, falls and the deviation from the field's axis, as
JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import naopolicies
import numpy as np
from naosim import robots
from naosim.launchers import ProcessLauncher
from naosim.robots.nao import model_of
from naosim.simspark import _core, protocol
from naosim.simspark.control import motor_speeds
from naosim.simspark.program import PROGRAM_VARIABLE, RCSSSERVER3D, SERVER_SCRIPT
from naosim.simulator import STEP_S, NativeHandle, Simulator, Truth
from naosprint import tasks
from naosprint.programs import integer, run_program
from naosprint.rl.policy import load_policy
from naosprint.tasks.environment import Environment
from naosprint.tasks.sprint import FINISH_X_M, MIN_SAMPLES, START_LINES_M, START_X_M, deviation_deg, speeds_beyond

if TYPE_CHECKING:
    from naosim.launchers import ServerHandle
    from naosim.robots import Robot
    from naosim.robots.description import Shape
    from naosim.simulator import Flags, Floats, Ints, Starts
    from naosprint.arrays import FloatArray

LANE_M, HEADING_DEG, RUN_S = 3.0, 0.0, 12.0
FALL_HEIGHT_M = 0.27  # of the paper
REPLY_S, START_S, KICK_OFF_S = 20.0, 60.0, 60.0

SCRIPT = SERVER_SCRIPT.replace(
    "$recordLogfile = false", "$recordLogfile = true\n$recordLogfileName = '{log}'\n$monitorLoggerStep = 0.02"
).replace(
    'run "naosoccersim.rb"',
    """\
alias stock_variable createVariable
def createVariable(space, name, value)
  value = true if name == 'AutomaticKickOff'
  value = 2.0 if name == 'WaitBeforeKickOff'
  stock_variable(space, name, value)
end
run "naosoccersim.rb\"""",
)
"""The server's settings for training, except that it kicks off by itself and records every cycle."""


class Player(Simulator):
    """One robot of a game, known only by what it perceives.

    Args:
        robot: the robot.
        launcher: starts a server.
    """

    latency_steps = 2
    native = NativeHandle()

    def __init__(self, robot: Robot, launcher: ProcessLauncher) -> None:
        super().__init__(robot, 1)
        self._model = model_of(robot)
        self._launcher = launcher
        self._exchange = _core.Exchange(
            1,
            list(self._model.joint_names),
            [joint.effector for joint in self._model.joints],
            [name for name, _ in protocol.LANDMARKS],
        )
        views = self._exchange.views()
        self.perceptors = {each.name: views[each.name] for each in robot.perceptors}
        self.truth = Truth(np.full((1, 3), np.nan), np.full((1, 3, 3), np.nan))
        self.game_time = views["game_time"]
        self._server: ServerHandle | None = None

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """None: a player does not know where its body is."""
        return ()

    def load_starts(self, starts: Starts) -> None:
        """Keep the poses; a player beams itself to its own half."""
        self._starts = starts

    def start(self, rows: Ints, starts: Ints, following: Ints | None = None) -> None:
        """Enter a new game, and hold the start's pose until it is on."""
        del rows, following
        self.end()
        self._enter()
        pose = self._starts.poses_rad[starts[:1]]
        self._say(f"(beam {START_X_M} {LANE_M} {HEADING_DEG})")
        for _ in range(round(KICK_OFF_S / STEP_S)):
            self.step(pose)
            if self._exchange.game(0)[2] == "PlayOn":
                return
        raise TimeoutError(f"the game is not on after {KICK_OFF_S} s: {self._exchange.game(0)}")

    def step_async(self, targets_rad: Floats, rows: slice, active: Flags | None = None) -> None:
        """Send joint speeds."""
        del rows
        if active is None or active[0]:
            speeds = motor_speeds(targets_rad, self.perceptors["joint_angles"], self._model.max_speed)
            self._exchange.dispatch(speeds, None)

    def step_wait(self, rows: slice) -> None:
        """Read the reply."""
        del rows
        if self._exchange.gather(None, REPLY_S, False):
            raise ConnectionError(self._exchange.failure(0))

    def end(self) -> None:
        """Leave the game and stop its server, which closes its log file."""
        if self._server is not None:
            self._server.stop()
            self._server = None
            self._exchange.detach(0)

    def close(self) -> None:
        """Stop the server."""
        self.end()
        super().close()

    def _say(self, text: str) -> None:
        self._exchange.post(0, False, text.encode() + b"(syn)")
        self._exchange.collect(None, 1, 0, REPLY_S)  # one reply a cycle, however busy the machine is

    def _enter(self) -> None:
        server = self._server = self._launcher.start()
        deadline = time.monotonic() + START_S
        while not server.owns(server.address.agent_port):
            if not server.alive() or time.monotonic() > deadline:
                raise TimeoutError(f"the server does not listen: {server.describe()}")
            time.sleep(0.02)
        agent = socket.create_connection((server.address.host, server.address.agent_port))
        self._exchange.attach(0, agent.detach(), -1)
        self._exchange.choose(0, 1, 1)
        self._say(f"(scene rsg/agent/nao/nao_hetero.rsg {self._model.robot_type})")
        for _ in range(10):
            self._say("")
        self._say("(init (unum 1)(teamname naosprint))")
        for _ in range(20):
            self._say("")
            if self._exchange.game(0)[0]:
                return
        raise ConnectionError(f"the server does not give the robot a team: {self._exchange.failure(0)}")


def recorded(log: Path, since_s: float) -> FloatArray:
    """Return the (k, 3) torso positions in metres of the frames of a server's log after this game time."""
    scene, position, rotation = _core.SceneReader(), np.zeros(3), np.zeros((3, 3))
    path = []
    for line in log.read_bytes().splitlines():
        try:
            scene.read(line)
        except ValueError:
            continue  # the last one may be cut off
        if scene.time > since_s and scene.torso(1, 1, position, rotation):
            path.append(position.copy())
    return np.array(path)


def until_over(path: FloatArray) -> FloatArray:
    """Return the part of a run's path, (k, 3) torso positions in metres, until a fall, the finish line or the end."""
    over = np.flatnonzero((path[:, 0] - path[0, 0] >= FINISH_X_M - START_X_M) | (path[:, 2] < FALL_HEIGHT_M))
    return path[: over[0] + 1] if len(over) else path


def summary(paths: list[FloatArray]) -> dict[str, Any]:
    """Return the statistics of several runs; `top_speed_mps` is the paper's measure."""
    xs = [path[:, 0] for path in paths]
    by_line = [speeds_beyond(xs, line, MIN_SAMPLES) for line in START_LINES_M]
    distances = [x[-1] - x[0] for x in xs]
    return {
        "episodes": len(paths),
        "top_speed_mps": max((float(speeds.mean()) for speeds in by_line if len(speeds)), default=None),
        "speed_mps": float(np.mean([d / ((len(x) - 1) * STEP_S) for d, x in zip(distances, xs, strict=True)])),
        "distance_m": float(np.mean(distances)),
        "falls": sum(bool(path[-1, 2] < FALL_HEIGHT_M) for path in paths),
        "deviation_deg": float(np.mean([deviation_deg(path[:, 0], path[:, 1]) for path in paths])),
    }


def play(checkpoint: Path, episodes: int, seed: int, program: str) -> list[FloatArray]:
    """Run episodes one after another and return the path of each, (k, 3) torso positions in metres, one a cycle.

    Raises:
        ValueError: if the policy was trained without onboard sensing.
    """
    policy, manifest = load_policy(checkpoint)
    spec = manifest.stage_spec
    robot = robots.configured(spec.robot)
    if not any(each.name == "vision" for each in robot.perceptors):
        raise ValueError(f"robot.onboard_sensing: {checkpoint} was trained without it")
    paths = []
    with tempfile.TemporaryDirectory() as scratch:
        log = Path(scratch) / "game.log"
        launched = replace(RCSSSERVER3D, files={"trainer.rb": SCRIPT.replace("{log}", str(log))})
        player = Player(robot, ProcessLauncher(launched, (program,)))
        environment = Environment(player, tasks.get(spec.task.name), spec.task, seed)
        try:
            environment.load_starts(environment.task.starts(episodes, seed, spec.task.start_noise_deg))
            for episode in range(episodes):
                environment.restart(np.zeros(1, np.int64), np.array([episode]))
                since_s = float(player.game_time[0])
                for _ in range(round(RUN_S / STEP_S)):
                    environment.step(policy.act(environment.observer.observations))
                player.end()
                paths.append(until_over(recorded(log, since_s)))
                path = paths[-1]
                end = "fallen" if path[-1, 2] < FALL_HEIGHT_M else "upright"
                seconds = (len(path) - 1) * STEP_S
                print(f"{episode + 1}: {path[-1, 0] - path[0, 0]:.2f} m in {seconds:.2f} s, {end}", file=sys.stderr)
        finally:
            environment.close()
    return paths


def main() -> None:
    """Print the statistics."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--policy", default="sprint-blind", help="bundled policy, or a checkpoint's folder")
    parser.add_argument("--episodes", type=integer(), default=100)
    parser.add_argument("--seed", type=integer(0), default=0)
    options = parser.parse_args()
    paths = play(
        naopolicies.resolve(options.policy),
        options.episodes,
        options.seed,
        os.environ.get(PROGRAM_VARIABLE) or RCSSSERVER3D.name,
    )
    print(json.dumps(summary(paths), indent=2))


if __name__ == "__main__":
    run_program(main)
