"""Examine how a policy of a Booster robot moves, and how robust it is; bundle.py writes both on the policy's card.

    python benchmarks/learning/examine.py t1-sprint [--episodes 200]

Motion: the largest joint speed, force on a foot, and depth of a contact in episodes without a fall, beside those of the
same robot standing, and how much of the time motors are at their torque limit. A policy that exploits the solver shows
here: joints faster than motors turn, or soles deep in the ground.

Robustness: the headline results with one disturbance at a time, in the server's own world otherwise.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import naopolicies
import numpy as np
from naosim.mujoco.embedded import MujocoSimulator
from naosim.robots.booster import FAMILY
from naospec import EvaluationSpec
from naospec.json_text import json_text
from naosprint import evaluate
from naosprint.analysis.results import headline, value_text
from naosprint.rl.checkpoint import read_manifest
from naosprint.rl.policy import load_policy
from naosprint.tasks.base import Task
from naosprint.tasks.environment import Environment, open_environment

CONDITIONS: dict[str, dict[str, Any]] = {
    "none": {},
    "pushes of up to 0.5 m/s every 2 s": {"push_mps": 0.5, "push_steps": 100},
    "masses of bodies up to 10 % different": {"mass_variation": 0.1},
    "friction times 0.6": {"friction_min": 0.6, "friction_max": 0.6},
    "friction times 1.4": {"friction_min": 1.4, "friction_max": 1.4},
    "20 ms more delay": {"extra_delay": 1},
    "sensor noise (0.5 degrees, 5 deg/s, 5 mm)": {"sensor_noise": 1.0},
}
"""Settings of the task by the name of a disturbance."""

MOTION_EPISODES, MOTION_STEPS = 16, 500
AT_LIMIT, FALLEN = 0.99, 0.6
SEED = 4242


def motion(checkpoint: Path) -> dict[str, dict[str, float]]:
    """Return peaks of a run and of standing: joint speed in rad/s, foot force in N, contact depth in mm, and more."""
    policy, manifest = load_policy(checkpoint)
    spec = EvaluationSpec().applied_to(manifest.stage_spec)
    environment = open_environment(spec, MOTION_EPISODES, threads=2, seed=SEED)
    try:
        task, noise_deg = environment.task, spec.task.start_noise_deg
        everyone = np.arange(MOTION_EPISODES)
        found = {}
        for name, drawn in (("running", task.starts), ("standing", partial(Task.starts, task))):
            starts = drawn(MOTION_EPISODES, SEED, noise_deg)
            environment.load_starts(starts)
            environment.restart(everyone, everyone % len(starts))
            found[name] = _peaks(environment, policy if name == "running" else None)
    finally:
        environment.close()
    return found


def _peaks(environment: Environment, policy: Any) -> dict[str, float]:
    simulator = environment.simulator
    assert isinstance(simulator, MujocoSimulator)
    active, fell = np.ones(environment.n, dtype=np.bool_), np.zeros(environment.n, dtype=np.bool_)
    peaks = np.zeros((3, environment.n))  # joint speed, foot force, contact depth
    limited = samples = 0.0
    still = np.zeros((environment.n, environment.actuation.n_actions))
    for _ in range(MOTION_STEPS):
        actions = still if policy is None else policy.act(environment.observations, None)
        environment.step(actions, active)
        fell |= active & environment.failed
        active &= ~environment.terminated & ~environment.truncated
        if policy is None:  # of the tasks, getup does not end with a fall
            active &= simulator.truth.torso_position[:, 2] > FALLEN * simulator.robot.standing_height_m
        if not active.any():
            break
        depths = [-data.contact.dist.min(initial=0.0) for data in simulator.batch.data]
        now = np.stack(
            [
                np.radians(np.abs(environment.world.perceptors["joint_speeds"]).max(axis=1)),
                simulator.foot_frames().max(axis=(1, 2)),
                1000.0 * np.array(depths),
            ]
        )
        peaks[:, active] = np.maximum(peaks, now)[:, active]
        shares = np.abs(simulator.torque_shares(slice(0, environment.n))[active])
        limited += float((shares > AT_LIMIT).sum())
        samples += shares.size
    speed, force, depth = peaks[:, ~fell].max(axis=1, initial=0.0).tolist()
    return {
        "joint_speed_rad_s": round(speed, 1),
        "foot_force_n": round(force),
        "contact_depth_mm": round(depth, 1),
        "torque_at_limit": round(limited / max(samples, 1.0), 3),
    }


def robustness(checkpoint: Path, episodes: int) -> list[dict[str, Any]]:
    """Return the headline results under each disturbance."""
    task = read_manifest(checkpoint).stage_spec.task.for_evaluation()
    found = []
    for name, settings in CONDITIONS.items():
        section = {**task.model_dump(exclude_none=True), **settings}
        spec = EvaluationSpec(episodes=episodes, seed=SEED, task=section)
        found.append({"disturbance": name, "results": headline(evaluate(checkpoint, spec, threads=2).summary)})
    return found


def examine(checkpoint: Path, episodes: int) -> dict[str, Any]:
    """Return what a card shows of motion and robustness; nothing for other families of robots."""
    if read_manifest(checkpoint).stage_spec.robot_description.family != FAMILY:
        return {}
    return {"motion": motion(checkpoint), "robustness": robustness(checkpoint, episodes)}


def page(examined: dict[str, Any]) -> list[str]:
    """Return the lines of a policy's page in the docs."""
    if not examined:
        return []
    running, standing = examined["motion"]["running"], examined["motion"]["standing"]
    rows = (
        ("Largest joint speed", "joint_speed_rad_s", "rad/s"),
        ("Largest force on a foot", "foot_force_n", "N"),
        ("Deepest contact", "contact_depth_mm", "mm"),
    )
    lines = ["## Motion", "", "| | Running | Standing |", "|---|---|---|"]
    lines += [f"| {title} | {running[name]:g} {unit} | {standing[name]:g} {unit} |" for title, name, unit in rows]
    shares = (f"{100.0 * each['torque_at_limit']:.1f} %" for each in (running, standing))
    lines += [f"| Motors at their torque limit | {' | '.join(shares)} |", "", "## Robustness", ""]
    titles = [result["title"] for result in examined["robustness"][0]["results"]]
    lines += [f"| Disturbance | {' | '.join(titles)} |", "|---" * (1 + len(titles)) + "|"]
    for row in examined["robustness"]:
        lines.append(f"| {row['disturbance']} | {' | '.join(value_text(result) for result in row['results'])} |")
    return [*lines, ""]


def main() -> None:
    """Print a policy's motion and robustness."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="checkpoint, or name of a bundled policy")
    parser.add_argument("--episodes", type=int, default=200, help="episodes under each disturbance (default: 200)")
    parser.add_argument("--json", type=Path, help="write it here as well")
    options = parser.parse_args()
    examined = examine(naopolicies.resolve(options.policy), options.episodes)
    if not examined:
        parser.error(f"{options.policy}: only policies of robots t1 and k1 can be examined")
    print("\n".join(page(examined)))
    if options.json:
        options.json.write_text(json_text(examined), encoding="utf-8")


if __name__ == "__main__":
    main()
