"""Run the example agent from point to point on a real rcssservermj, and film it.

    python benchmarks/learning/player.py [--policy t1-run] [--tumble] [--targets 10] [--seed 0] [--film FOLDER]

Exports bundled policies of tasks velocity and getup, starts a server in real time on loopback, and runs
packages/naosprint/examples/play_t1.py, which knows only what the robot perceives. With ``--tumble`` the robot throws
itself over before each target and has to get up first. Prints what the agent prints. The
film shows the first targets by forward kinematics from the perceived pose and angles. Exits with the agent's code: 0
if every target was reached.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import naopolicies
import numpy as np
from naosim import robots
from naosim.launchers import ProcessLauncher, ServerProgram
from naosim.mujoco.program import RCSSSERVERMJ
from naosim.mujoco.shapes import body_poses
from naosim.mujoco.world import library, world_of
from naosim.simulator import STEP_S
from naospec import TrainingSpec, read_stored
from naosprint.analysis.film import write_gif, write_mp4
from naosprint.analysis.replay import Replay
from naosprint.export import export_policy
from naosprint.programs import integer, run_program

if TYPE_CHECKING:
    from collections.abc import Iterator

    from naosim.launchers import Address, Launcher

AGENT = Path(__file__).parents[2] / "packages" / "naosprint" / "examples" / "play_t1.py"
REALTIME = ServerProgram(
    name="rcssservermj",
    arguments=("--aport", "{agent_port}", "--mport", "{monitor_port}", "--no-render"),
    stop_signal=RCSSSERVERMJ.stop_signal,
)
FILM_S, GIF_S = 20.0, 8.0


@contextmanager
def running(launcher: Launcher) -> Iterator[Address]:
    """Run a server, and yield its address once it listens."""
    server = launcher.start()
    try:
        deadline = time.monotonic() + 60.0
        while not server.owns(server.address.monitor_port):
            if not server.alive() or time.monotonic() > deadline:
                raise TimeoutError(f"the server does not listen: {server.describe()}")
            time.sleep(0.05)
        yield server.address
    finally:
        server.stop()


def main() -> int:
    """Play once; return the agent's exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--policy", default="t1-run", help="bundled policy of task velocity")
    parser.add_argument("--getup", default="t1-getup", help="bundled policy of task getup")
    parser.add_argument("--tumble", action="store_true", help="throw the robot over before each target")
    parser.add_argument("--targets", type=integer(), default=10)
    parser.add_argument("--seed", type=integer(0), default=0)
    parser.add_argument("--film", type=Path, metavar="FOLDER", help="write player.mp4 and player.gif there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        record, names = Path(scratch) / "cycles.npz", (options.policy, options.getup)
        paths = [
            export_policy(naopolicies.resolve(name), Path(scratch) / Path(name).name, ["numpy"])[0] for name in names
        ]
        with running(ProcessLauncher(REALTIME, (sys.executable, "-m", "rcsssmj"))) as address:
            play = [sys.executable, str(AGENT), str(paths[0]), "--getup", str(paths[1])]
            play += ["--tumble"] if options.tumble else []
            play += ["--host", address.host, "--record", str(record)]
            play += ["--ports", str(address.agent_port), str(address.monitor_port)]
            play += ["--targets", str(options.targets), "--seed", str(options.seed)]
            code = subprocess.run(play, check=False).returncode
        if options.film and record.exists():
            replay = replay_of(np.load(record), read_stored(TrainingSpec, naopolicies.spec(options.policy)))
            options.film.mkdir(parents=True, exist_ok=True)
            frames = min(len(replay.positions), round(FILM_S / STEP_S))
            write_mp4(replay, options.film / "player.mp4", frames=range(frames))
            write_gif(replay, options.film / "player.gif", frames=range(min(frames, round(GIF_S / STEP_S))))
    return code


def replay_of(cycles: np.lib.npyio.NpzFile, spec: TrainingSpec) -> Replay:
    """Return what the agent recorded as a replay, from the cycle on in which the robot stands at its start."""
    robot = robots.configured(spec.robot)
    rotations = cycles["rotations"]
    quaternions = np.empty((len(rotations), 4))
    for quaternion, rotation in zip(quaternions, rotations, strict=True):
        library().mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    coordinates = np.concatenate((cycles["positions"], quaternions, cycles["angles"]), axis=1)
    beamed = np.linalg.norm(np.diff(cycles["positions"], axis=0), axis=1).argmax() + 1
    poses = body_poses(world_of(robot), coordinates[beamed:]).astype(np.float32)
    feet = np.zeros((len(poses), 2), np.float32)
    return Replay(robot, poses[:, :, :3], poses[:, :, 3:], feet, end="", failed=False)


if __name__ == "__main__":
    run_program(main)
