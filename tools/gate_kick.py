"""Check policies of task ``kick``, point by point; exit with 0 only if every point is met.

    python tools/gate_kick.py t1-kick                      # checkpoints or bundled policies, one a seed
    python tools/gate_kick.py t1-kick --episodes 50 --json gate.json

200 deterministic episodes of each class of starts, from states of the walker that no training has seen, in all
directions of the field; the ball is rolled to its stop. A kick through a corridor stays within 0.5 m of its line.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

import naopolicies
from naospec import EvaluationSpec
from naospec.json_text import json_text
from naosprint import evaluate
from naosprint.analysis.results import by_name
from naosprint.programs import integer, run_program
from naosprint.rl.checkpoint import read_manifest
from naosprint.tasks.kick_results import CORRIDORS_M
from points import Point, at_least, at_most

EPISODES, SEED = 200, 90_000
"""Episodes of a class of starts, and a seed that no training uses."""

CLASSES: dict[str, tuple[float, dict[str, tuple[float, ...]]]] = {
    "aligned": (
        1.0,
        {"touched": (1.0, 0.98), "corridors": (0.95, 0.90, 0.90), "error": (4.0, 9.0), "goal": (0.9,), "way": (0.15,)},
    ),
    "wide": (
        0.0,
        {"touched": (0.99, 0.95), "corridors": (0.9, 0.8, 0.7), "error": (6.0, 15.0), "goal": (0.8,), "way": (0.2,)},
    ),
}
"""By class of starts: fraction of aligned ones, and bounds."""

FAR_M = 14.0
"""Mean distance of power kicks."""


def points(checkpoint: Path, name: str, episodes: int, threads: int) -> list[Point]:
    """Evaluate the passes and the power kicks of one class of starts."""
    aligned, bounds = CLASSES[name]
    passes = results(checkpoint, episodes, threads, aligned_fraction=aligned, power_fraction=0.0)
    powerful = results(checkpoint, episodes, threads, aligned_fraction=aligned, power_fraction=1.0)
    found = [
        at_least(name, "touched", passes["contact_rate"], bounds["touched"][0]),
        at_least(name, "upright 3 s after the touch", passes["upright_rate"], bounds["touched"][1]),
        *(
            at_least(name, f"corridor of {length:g} m", passes[f"corridor_{length:g}"], bound)
            for length, bound in zip(CORRIDORS_M, bounds["corridors"], strict=True)
        ),
        at_most(name, "direction error, median, degrees", passes["stop_error_deg"], bounds["error"][0]),
        at_most(name, "direction error, p90, degrees", passes["stop_error_90_deg"], bounds["error"][1]),
        at_most(name, "distance error, 2 to 6 m, median", passes["distance_error"], bounds["way"][0]),
        at_least(name, "power kick into a goal at 8 m", powerful["goal_rate"], bounds["goal"][0]),
        *(
            at_least(name, f"power kick, corridor of {length:g} m", powerful[f"corridor_{length:g}"], bound)
            for length, bound in zip(CORRIDORS_M, bounds["corridors"], strict=True)
        ),
    ]
    if name == "aligned":
        found.append(at_least(name, "power kick, mean distance, m", powerful["power_distance_m"], FAR_M))
    return found


def results(checkpoint: Path, episodes: int, threads: int, **settings: Any) -> dict[str, float | None]:
    """Evaluate kicks with these settings of the task; return its results and corridors by name."""
    task = read_manifest(checkpoint).stage_spec.task.for_evaluation().model_copy(update=settings)
    spec = EvaluationSpec(episodes=episodes, seed=SEED, task=task.model_dump(exclude_none=True))
    summary = evaluate(checkpoint, spec, threads=threads).summary
    found = {name: one["value"] for name, one in by_name(summary).items()}
    (table,) = summary["tables"]
    (column,) = table["columns"]
    for length, result in zip(table["at"], column["results"], strict=True):
        found[f"corridor_{length:g}"] = result["value"]
    return found


def main() -> int:
    """Check each policy, print the gate, and return 0 if all have passed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", nargs="+", metavar="POLICY", help="checkpoint, or name of a bundled policy")
    parser.add_argument("--episodes", type=integer(), default=EPISODES, help="episodes of each class (default: 200)")
    parser.add_argument("--threads", type=integer(), default=2, help="threads of the simulator (default: 2)")
    parser.add_argument("--json", type=Path, help="write the points here")
    options = parser.parse_args()
    found: dict[str, list[Point]] = {}
    for policy in options.policies:
        checkpoint = naopolicies.resolve(policy)
        task = read_manifest(checkpoint).stage_spec.task.name
        if task != "kick":
            raise ValueError(f"{policy}: a policy of task {task}, not of kick")
        print(f"{policy}, {options.episodes} episodes of each class of starts")
        found[policy] = []
        for name in CLASSES:
            for point in points(checkpoint, name, options.episodes, options.threads):
                found[policy].append(point)
                print(point, flush=True)
    if options.json:
        document = {name: [asdict(point) for point in each] for name, each in found.items()}
        options.json.write_text(json_text(document), encoding="utf-8")
    failed = sum(not point.passed for each in found.values() for point in each)
    print(f"{failed} points failed" if failed else "all points passed")
    few = options.episodes < EPISODES
    if few:
        print(f"the gate needs {EPISODES} episodes: not decided")
    return 1 if failed or few else 0


if __name__ == "__main__":
    run_program(main)
