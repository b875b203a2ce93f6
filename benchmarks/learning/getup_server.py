"""Throw a T1 over on a real rcssservermj again and again, and measure how a policy of task ``getup`` stands it up.

    python benchmarks/learning/getup_server.py [t1-getup] [--falls 100] [--seed 0]

Falls are those of packages/naosprint/examples/play_t1.py: random angles for a second, then two seconds at rest with
limbs at random. The policy then has 5 s, over the agent port, with what the robot perceives. It stands when the torso
is as high and as upright as task ``getup`` asks for half a second; the attempt counts within 3 s.
"""

from __future__ import annotations

import argparse
import socket
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import naopolicies
import numpy as np
from naosim.mujoco.program import server_launcher
from naosprint.analysis.results import interval_text, value_text
from naosprint.export import export_policy
from naosprint.programs import integer, run_program
from naosprint.tasks.episodes import Statistics
from naosprint.tasks.getup import LIMIT_S, STANDING_RATE, SUCCESS_RATE, TIME
from player import running

if TYPE_CHECKING:
    from naosim.launchers import Address

EXAMPLES = Path(__file__).parents[2] / "packages" / "naosprint" / "examples"
CONFIDENCE, SAMPLES = 0.95, 1000


def attempts(path: Path, address: Address, falls: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the (n,) times of standing up, NaN for never, and whether the robot stands at the end of each attempt."""
    sys.path.insert(0, str(EXAMPLES))
    import play_t1

    agent, monitor = (
        socket.create_connection((address.host, port)) for port in (address.agent_port, address.monitor_port)
    )
    play_t1.receive(monitor)
    robot = play_t1.Riser(path)
    play_t1.send(agent, f"(init {robot.model} naosprint 2)")
    play_t1.receive(agent)
    play_t1.send(monitor, "(ball (pos 25 16 0.11)(vel 0 0 0))")

    def step(who: Any, targets: np.ndarray, beam: str = "") -> None:
        play_t1.send(agent, beam + who.command(targets))
        who.perceive(play_t1.receive(agent))

    for cycle in range(6 + robot.settling_cycles):
        step(robot, robot.start_pose_rad, "(beam -5 0 0)" if cycle == 5 else "")
    monitor.close()
    rng, times, stands = np.random.default_rng(seed), [], []
    for _ in range(falls):
        play_t1.tumble(robot, step, rng)
        robot.begin()
        while robot.cycles < play_t1.GETUP_CYCLES:
            step(robot, robot.act(robot.observe()))
        times.append(robot.stood_s or np.nan)
        stands.append(robot.stands)
        print(f"\r{len(times)} falls, {np.isfinite(times).sum()} times up", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    agent.close()
    return np.array(times), np.array(stands)


def main() -> None:
    """Print how often and how fast the robot stands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", nargs="?", default="t1-getup", help="checkpoint, or name of a bundled policy")
    parser.add_argument("--falls", type=integer(), default=100)
    parser.add_argument("--seed", type=integer(0), default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch, running(server_launcher()) as address:
        path = export_policy(naopolicies.resolve(options.policy), Path(scratch), ["numpy"])[0]
        times, stands = attempts(path, address, options.falls, options.seed)
    statistics = Statistics(CONFIDENCE, SAMPLES, options.seed)
    for result in (
        statistics.rate(SUCCESS_RATE, times <= LIMIT_S),
        statistics.rate(STANDING_RATE, stands),
        statistics.mean(TIME, times[np.isfinite(times)]),
    ):
        shown = result.to_json()
        print(f"{result.metric.title}: {value_text(shown)}, {interval_text(shown, CONFIDENCE)}")


if __name__ == "__main__":
    run_program(main)
