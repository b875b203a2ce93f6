"""Check policies of task ``velocity`` against gate R2, point by point; exit with 0 only if every point is met.

    python tools/gate_r2.py POLICY [POLICY ...]           # checkpoints or bundled policies, one a seed
    python tools/gate_r2.py t1-run --simulator server     # on the real rcssservermj
    python tools/gate_r2.py t1-run --gate-only --json gate.json

Gate R2 is written down in the public repository My3DProject, docs/run-policy-training.md: 200 held-out deterministic
episodes of a policy at a command of 1.5 m/s for 10 s. To release, policies of three seeds pass. It names further
commands without bounds, which ``--gate-only`` leaves out; here each has to keep 95 % of the episodes upright, an
RMSE of 0.35 m/s (and rad/s, where the robot turns), a drift of 0.25 m from the commanded path, and the speed itself
within 0.15 m/s. RMSE and drift are medians over the episodes. The RMSE is that of the whole episode, the start from
standing included; a robot that falls is measured until then. Flight is two successive frames of 5 ms without contact; a
server reports no contacts, so there it is determined by the height of the soles every 20 ms.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

import naopolicies
import numpy as np
from naosim.simulator import STEP_S
from naospec import EvaluationSpec
from naospec.json_text import json_text
from naosprint import evaluate
from naosprint.analysis.results import by_name
from naosprint.programs import integer, run_program
from naosprint.rl.policy import load_policy
from naosprint.tasks.environment import open_environment
from naosprint.tasks.velocity import Velocity
from points import Point, at_least, at_most

EPISODES, STEPS, SEED = 200, 500, 90_000
"""Episodes of a command, steps of an episode, and a seed that no training uses."""

LEAST_UPRIGHT, LARGEST_RMSE, LARGEST_DRIFT, LARGEST_SPEED_ERROR = 0.95, 0.35, 0.25, 0.15

FAST_MPS, CHANGE_S, REACHED_MPS, STOPPED_MPS = 2.5, 1.5, 2.25, 0.25
"""Start and stop: from standing to nine tenths of 2.5 m/s, and down to a tenth of it, in 1.5 s each."""

STRAIGHT = {"sideways_max_mps": 0.0, "turn_max_rad_s": 0.0}


def command(forward: float, **others: Any) -> dict[str, Any]:
    """Return the settings of the task for one forward speed."""
    fixed = {"name": "velocity", "forward_min_mps": forward, "forward_max_mps": forward, "episode_steps": STEPS}
    return {**fixed, **STRAIGHT, "stand_fraction": 0.0, "straight_fraction": 0.0, "command_steps": 100_000, **others}


GATE = "forward 1.5 m/s"
COMMANDS: dict[str, dict[str, Any]] = {
    GATE: command(1.5),
    "stand": command(0.0),
    "forward 0.5 m/s": command(0.5),
    "forward 1.0 m/s": command(1.0),
    "sideways, up to 0.5 m/s": command(0.0, sideways_max_mps=0.5),
    "turn, up to 1 rad/s": command(0.5, turn_max_rad_s=1.0),
    "abrupt changes, 0 to 2 m/s every second": command(0.0, forward_max_mps=2.0, command_steps=50),
}


def steady(checkpoint: Path, name: str, options: argparse.Namespace) -> list[Point]:
    """Evaluate one command."""
    spec = EvaluationSpec.model_validate(
        {
            "episodes": options.episodes,
            "seed": SEED,
            "task": COMMANDS[name],
            "simulator": options.simulator,
            "n_envs": options.n_envs,
        }
    )
    results = {key: one["value"] for key, one in by_name(evaluate(checkpoint, spec, threads=2).summary).items()}
    points = [
        at_least(name, "upright", results["upright_rate"], LEAST_UPRIGHT),
        at_most(name, "median RMSE, m/s", results["median_rmse_whole_mps"], LARGEST_RMSE),
    ]
    asked, speed = COMMANDS[name]["forward_max_mps"], results["median_forward_mps"]
    if name == GATE:
        points += [
            at_least(name, "median speed after 2 s, m/s", speed, 1.2),
            at_least(name, "episodes with flight", results["flight_rate"], 0.8),
        ]
    elif asked == COMMANDS[name]["forward_min_mps"] and speed is not None:
        points.append(at_most(name, "error of the median speed, m/s", abs(speed - asked), LARGEST_SPEED_ERROR))
    if not COMMANDS[name]["turn_max_rad_s"] and COMMANDS[name]["command_steps"] > STEPS:
        points.append(at_most(name, "median drift, m", results["median_drift_m"], LARGEST_DRIFT))
    if COMMANDS[name]["turn_max_rad_s"]:
        points.append(at_most(name, "turn RMSE, rad/s", results["turn_rmse_rad_s"], LARGEST_RMSE))
    return points


def start_and_stop(checkpoint: Path, options: argparse.Namespace) -> list[Point]:
    """Run from standing to 2.5 m/s and stop again."""
    spec = EvaluationSpec.model_validate(
        {"episodes": options.episodes, "task": command(FAST_MPS), "simulator": options.simulator}
    )
    policy, manifest = load_policy(checkpoint)
    setting = spec.applied_to(manifest.stage_spec)
    n = min(options.episodes, options.n_envs)
    change, hold = round(CHANGE_S / STEP_S), round(2.0 / STEP_S)
    reached, stopped, upright = [], [], []
    environment = open_environment(setting, n, threads=2, seed=SEED)
    try:
        starts = environment.task.starts(options.episodes, SEED, setting.task.start_noise_deg)
        environment.load_starts(starts)
        task = environment.task
        assert isinstance(task, Velocity)
        everyone = np.arange(n)
        for first in range(0, options.episodes, n):
            environment.restart(everyone, (first + everyone) % len(starts))
            speeds, active = [], np.ones(n, dtype=np.bool_)
            for step in range(change + hold + change):
                if step == change + hold:
                    task.set_command(everyone, np.zeros((n, 3)))
                environment.step(policy.act(environment.observations, None), active)
                active &= ~environment.terminated & ~environment.lost
                speeds.append(np.where(active, task.velocity[:, 0], np.nan))
                if not active.any():
                    break
            # half a second is a stride or more
            window = round(0.5 / STEP_S)
            ran = np.array(speeds)
            for row in range(min(n, options.episodes - first)):
                upright.append(bool(active[row]))
                reached.append(float(ran[change : change + window, row].mean()) if len(ran) >= change + window else 0.0)
                stopped.append(float(np.abs(ran[-1, row])) if active[row] else np.inf)
    finally:
        environment.close()
    name = f"start to {FAST_MPS:g} m/s and stop"
    return [
        at_least(name, "upright", float(np.mean(upright)), LEAST_UPRIGHT),
        at_least(name, f"speed after {CHANGE_S:g} s, m/s", float(np.median(np.nan_to_num(reached))), REACHED_MPS),
        at_most(name, f"speed {CHANGE_S:g} s after the stop, m/s", float(np.median(stopped)), STOPPED_MPS),
    ]


def main() -> int:
    """Check each policy, print the gate, and return 0 if all have passed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", nargs="+", metavar="POLICY", help="checkpoint, or name of a bundled policy")
    parser.add_argument("--simulator", choices=("embedded", "server"), default="embedded", help="where episodes run")
    parser.add_argument("--episodes", type=integer(), default=EPISODES, help="episodes of each command (the gate: 200)")
    parser.add_argument("--n-envs", type=integer(0), default=0, help="episodes at a time (default: 128; 4 on servers)")
    parser.add_argument("--gate-only", action="store_true", help="check the gate itself, without further commands")
    parser.add_argument("--json", type=Path, help="write the points here")
    options = parser.parse_args()
    options.n_envs = options.n_envs or (4 if options.simulator == "server" else 128)
    found: dict[str, list[Point]] = {}
    for policy in options.policies:
        checkpoint = naopolicies.resolve(policy)
        commands = [GATE] if options.gate_only else list(COMMANDS)
        points = [point for name in commands for point in steady(checkpoint, name, options)]
        if not options.gate_only:
            points += start_and_stop(checkpoint, options)
        found[policy] = points
        print(f"{policy}, {options.simulator}, {options.episodes} episodes a command")
        for point in points:
            print(point, flush=True)
    if options.json:
        document = {name: [asdict(point) for point in points] for name, points in found.items()}
        options.json.write_text(json_text(document), encoding="utf-8")
    failed = sum(not point.passed for points in found.values() for point in points)
    few = options.episodes < EPISODES
    print(f"{failed} points failed" if failed else "all points passed")
    if few:
        print(f"the gate asks for {EPISODES} episodes: not decided")
    return int(failed > 0 or few)


if __name__ == "__main__":
    run_program(main)
