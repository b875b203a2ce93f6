"""Kicks by exported skills, with nothing but a player's perceptions: on rcssservermj, or in the embedded world.

    python benchmarks/learning/kick_server.py t1-kick --kicks 30
    python benchmarks/learning/kick_server.py t1-kick --kicks 30 --simulator embedded

The walker's skill walks, the ball is placed before a foot, the kick's skill kicks, and the walker's continues after it.
Where the ball goes is what the robot sees of it. The server is started here, on the loopback interface.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import naopolicies
import numpy as np
from naosim import kinds, robots
from naosim.simulator import RuntimeOptions, Scene, Simulator, Starts
from naosprint.export import export_policy
from naosprint.programs import integer, run_program
from naosprint.rl.checkpoint import read_manifest
from naosprint.tasks.ball import UPRIGHT
from naosprint.tasks.kick_results import CORRIDOR_HALF_M, CORRIDORS_M, UPRIGHT_S
from naosprint.tasks.kick_settings import KickSettings

PERCEIVED = {
    "position": "torso_pos",
    "quaternion": "torso_quat",
    "gyro_deg": "gyro",
    "angles_deg": "joint_angles",
    "speeds_deg": "joint_speeds",
}
FALLEN_M, STEPS, RADIUS_M = 0.45, 600, 0.11


def runner_of(policy: str, folder: Path) -> Any:
    """Return the runner of a policy's exported skill."""
    export_policy(naopolicies.resolve(policy), folder, "skill")
    path = next(folder.rglob("runner.py"))
    spec = importlib.util.spec_from_file_location(f"runner_of_{folder.name}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Runner(path.with_name("policy.npz"))


class Player:
    """One robot: walks, kicks, stands."""

    def __init__(self, simulator: Simulator, walker: Any, kick: Any, head_pitch: float) -> None:
        self.simulator, self.walker, self.kick, self.head_pitch = simulator, walker, kick, head_pitch
        self.pitch = simulator.robot.joint_names.index("head_pitch")

    def perceived(self, name: str) -> np.ndarray:
        """Return what the robot perceives."""
        values: np.ndarray = self.simulator.perceptors[name][0].copy()
        return values

    def step(self, runner: Any, **more: Any) -> None:
        """Take one step by a skill."""
        seen = runner.observe(**{name: self.perceived(key) for name, key in PERCEIVED.items()}, **more)
        targets = runner.act(seen)
        targets[self.pitch] = self.head_pitch
        self.simulator.step(targets[None])

    @property
    def yaw(self) -> float:
        """Direction of the torso."""
        w, x, y, z = self.perceived("torso_quat")
        return float(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))

    @property
    def fallen(self) -> bool:
        """Whether the robot lies."""
        _, x, y, _ = self.perceived("torso_quat")
        return bool(self.perceived("torso_pos")[2] < FALLEN_M or 1 - 2 * (x * x + y * y) < UPRIGHT)


def kick_once(player: Player, rng: np.random.Generator, start: int, wide: bool) -> dict[str, Any]:
    """Walk, kick and stand; return what became of the ball and the robot."""
    simulator, walker, kick = player.simulator, player.walker, player.kick
    one = np.zeros(1, dtype=np.int64)
    simulator.start(one, one + start)
    walker.begin()
    command = np.array([rng.uniform(0.4, 1.1), rng.uniform(-0.3, 0.3), rng.uniform(-0.5, 0.5)])
    command[1:] *= rng.random() < 0.6
    command *= rng.random() < 0.8
    for _ in range(int(rng.integers(60, 140))):
        player.step(walker, command=command)
    aim = np.radians(30.0 if wide else 10.0) * rng.uniform(-1.0, 1.0)
    ahead = rng.uniform(0.35 if wide else 0.45, 0.9)
    line = rng.choice((-1.0, 1.0)) * (0.106 + rng.uniform(-0.06, 0.06))
    aside = rng.uniform(-0.22, 0.22) if wide else (line + np.sin(aim) * ahead) / np.cos(aim)
    yaw, torso = player.yaw, player.perceived("torso_pos")
    cosine, sine = np.cos(yaw), np.sin(yaw)
    ball = torso[:2] + np.array([cosine * ahead - sine * aside, sine * ahead + cosine * aside])
    simulator.place_ball(one, np.array([[*ball, RADIUS_M]]))
    if simulator.latency_steps:
        player.step(walker, command=command)  # after which it is there
    direction = yaw + aim
    kick.begin(target=(direction, np.inf), action=walker.action, position=walker.position)
    acting, path, touched, fell, since = kick, [ball], -1, False, 0
    for step in range(STEPS):
        if acting is kick:
            player.step(kick, ball=player.perceived("ball"))
            if kick.kicked:
                acting = walker
                walker.begin(action=kick.action, position=kick.position)
        else:
            player.step(walker, command=np.zeros(3))
        place = simulator.truth.bodies["ball"].position[0, :2].copy()
        moving = np.hypot(*(place - path[-1])) > 0.002
        if moving:
            path.append(place)
        since = 0 if moving else since + 1
        if touched < 0 and np.hypot(*(place - ball)) > 0.05:
            touched = step
        if player.fallen:
            fell = touched < 0 or step < touched + UPRIGHT_S / 0.02
            break
        if (touched < 0 and step > 200) or (touched >= 0 and step > touched + 150 and since > 15):
            break
    way = np.array(path) - ball
    along = np.cos(direction) * way[:, 0] + np.sin(direction) * way[:, 1]
    across = np.cos(direction) * way[:, 1] - np.sin(direction) * way[:, 0]
    through: dict[str, bool] = {}
    for length in CORRIDORS_M:
        beyond = np.flatnonzero(along >= length)
        within = len(beyond) and np.abs(across[: beyond[0] + 1]).max() <= CORRIDOR_HALF_M
        through[str(length)] = bool(within and not fell)
    error = float(np.degrees(abs(np.arctan2(across[-1], along[-1]))))
    return {"touched": touched >= 0, "upright": not fell, "m": float(np.hypot(*way[-1])), "deg": error, **through}


def main() -> int:
    """Read the options, kick, and print a line a kick and one for all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="checkpoint directory, or the name of a bundled policy")
    parser.add_argument("--kicks", type=integer(), default=30)
    parser.add_argument("--seed", type=integer(0), default=0)
    parser.add_argument("--wide", action="store_true", help="starts that are not aligned")
    parser.add_argument("--simulator", choices=("server", "embedded"), default="server")
    options = parser.parse_args()
    spec = read_manifest(naopolicies.resolve(options.policy)).stage_spec
    if not isinstance(spec.task, KickSettings):
        raise ValueError(f"{options.policy}: a policy of task {spec.task.name}, not of kick")
    robot = robots.configured(spec.robot)
    rng = np.random.default_rng(options.seed)
    kind = kinds.get(options.simulator)
    parameters = kind.parameters(robot)(name=options.simulator).for_evaluation()
    simulator = kind.open(robot, 1, parameters, RuntimeOptions(), Scene(ball=True))
    results = []
    try:
        with tempfile.TemporaryDirectory() as folder:
            walker = runner_of(str(spec.task.walker), Path(folder) / "walker")
            kick = runner_of(options.policy, Path(folder) / "kick")
        n = options.kicks
        places = np.column_stack([np.full(n, -6.0), rng.uniform(-4.0, 4.0, n)])
        poses = np.repeat(robot.nominal[None], n, axis=0)
        moved = [k for k, joint in enumerate(robot.joints) if joint.actuated]
        poses[:, moved] += np.radians(rng.uniform(-2.0, 2.0, (n, len(moved))))
        simulator.load_starts(Starts(poses, places, rng.uniform(-np.pi, np.pi, n)))
        player = Player(simulator, walker, kick, float(robot.nominal_rad["head_pitch"]))
        for start in range(n):
            results.append(kick_once(player, rng, start, options.wide))
            sys.stdout.write(json.dumps(results[-1]) + "\n")
            sys.stdout.flush()
    finally:
        simulator.close()
    hit, rolled = [each for each in results if each["touched"]], ""
    if hit:
        metres, degrees = (np.array([each[name] for each in hit]) for name in ("m", "deg"))
        rolled = f"distance {metres.mean():.1f} m, direction error median {np.median(degrees):.1f} degrees, "
    sys.stdout.write(
        f"{options.simulator}: touched {len(hit)} of {len(results)}, "
        f"upright {sum(each['upright'] for each in results)}, {rolled}corridors of "
        + ", ".join(f"{length:g} m {sum(each[str(length)] for each in results)}" for length in CORRIDORS_M)
        + "\n"
    )
    return 0


if __name__ == "__main__":
    run_program(main)
