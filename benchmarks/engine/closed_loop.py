"""Evaluate bundled policies of T1 and K1 on the fast engine and on MuJoCo, and compare the results.

    python benchmarks/engine/closed_loop.py [--episodes 200] [--json FILE] [POLICY]...

Prints each headline result on both engines with its interval, and exits with 1 if the intervals of one do not overlap.
The speeds are steps a second of CPU time, policy and task included. Without names all policies are compared; results of
others stay in the file.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import naopolicies
from naospec import EvaluationSpec
from naospec.json_text import json_text
from naosprint import evaluate
from naosprint.analysis.results import by_name, interval_text, value_text
from naosprint.programs import integer, run_program


def evaluated(name: str, engine: str, settings: dict[str, Any]) -> dict[str, Any]:
    """Evaluate a policy, print the steps a second, and return its headline results by name."""
    spec = EvaluationSpec.model_validate({**settings, "engine": engine})
    began = time.process_time()
    summary = evaluate(naopolicies.folder(name), spec, threads=1).summary
    steps = sum(result["value"] * spec.episodes for result in summary["results"] if result["name"] == "episode_length")
    pace = f", {steps / (time.process_time() - began):,.0f} steps/s" if steps else ""
    print(f"{name}, engine {engine}{pace}")
    results = by_name(summary)
    return {title: results[title] for title in summary["headline"]}


def main() -> int:
    """Compare the policies that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    everything = [name for name in naopolicies.names() if name.startswith(("t1-", "k1-"))]
    parser.add_argument("names", nargs="*", metavar="POLICY", default=everything)
    parser.add_argument("--episodes", type=integer(), default=200)
    parser.add_argument("--seed", type=integer(0), default=5)
    parser.add_argument("--json", type=Path, default=Path(__file__).with_name("closed_loop.json"))
    options = parser.parse_args()
    settings = {"episodes": options.episodes, "seed": options.seed, "n_envs": 64}
    apart = 0
    for name in options.names:
        fast, exact = (evaluated(name, engine, settings) for engine in ("fast", "mujoco"))
        found: dict[str, Any] = {"episodes": options.episodes, "results": {}}
        for title, one in exact.items():
            other = fast[title]
            words = [
                f"{value_text(result)} ({interval_text(result, 0.95) or 'no interval'})" for result in (other, one)
            ]
            print(f"  {one['title']}: {words[0]}, MuJoCo {words[1]}", flush=True)
            found["results"][title] = {
                engine: [result["value"], *(result["interval"] or ())]
                for engine, result in (("fast", other), ("mujoco", one))
            }
            if one["interval"] and other["interval"]:
                (low, high), (other_low, other_high) = one["interval"], other["interval"]
                apart += not (low <= other_high and other_low <= high)
        kept = json.loads(options.json.read_bytes()) if options.json.exists() else {}
        kept[name] = found
        options.json.write_text(json_text(dict(sorted(kept.items()))), encoding="utf-8")
    print(f"{apart} results outside of each other's intervals")
    return int(apart > 0)


if __name__ == "__main__":
    run_program(main)
