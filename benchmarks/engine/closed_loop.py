"""Evaluate bundled policies of the T1 in the world of trainings and in the exact one, and compare the results.

    python benchmarks/engine/closed_loop.py t1-sprint t1-run t1-getup --episodes 200

Prints each headline result in both worlds with its interval, and exits with 1 if the intervals of one do not overlap.
The speeds are steps a second of CPU time, policy and task included.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

import naopolicies
from naospec import EvaluationSpec, TrainingSpec
from naosprint import evaluate
from naosprint.analysis.results import by_name, interval_text, value_text


class TrainingWorld(EvaluationSpec):
    """Evaluation in the world in which trainings run."""

    def applied_to(self, trained: TrainingSpec) -> TrainingSpec:
        """Return the evaluation's specification with the fast world in place of the exact one."""
        spec = super().applied_to(trained)
        return spec.model_copy(update={"simulator": spec.simulator.model_copy(update={"engine": "fast"})})


def evaluated(name: str, spec: EvaluationSpec) -> dict[str, Any]:
    """Evaluate a policy, print the steps a second, and return its results by name."""
    began = time.process_time()
    summary = evaluate(naopolicies.folder(name), spec, threads=1).summary
    steps = sum(result["value"] * spec.episodes for result in summary["results"] if result["name"] == "episode_length")
    pace = f", {steps / (time.process_time() - began):,.0f} steps/s" if steps else ""
    print(f"{name} in the {'fast' if isinstance(spec, TrainingWorld) else 'exact'} world{pace}")
    results = by_name(summary)
    return {title: results[title] for title in summary["headline"]}


def main() -> int:
    """Compare the policies that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", metavar="POLICY")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=5)
    options = parser.parse_args()
    settings = {"episodes": options.episodes, "seed": options.seed, "n_envs": 64}
    apart = 0
    for name in options.names:
        fast, exact = evaluated(name, TrainingWorld(**settings)), evaluated(name, EvaluationSpec(**settings))
        for title, one in exact.items():
            other = fast[title]
            words = [
                f"{value_text(result)} ({interval_text(result, 0.95) or 'no interval'})" for result in (other, one)
            ]
            print(f"  {one['title']}: {words[0]}, exact {words[1]}")
            if one["interval"] and other["interval"]:
                (low, high), (other_low, other_high) = one["interval"], other["interval"]
                apart += not (low <= other_high and other_low <= high)
    print(f"{apart} results outside of each other's intervals")
    return int(apart > 0)


if __name__ == "__main__":
    sys.exit(main())
