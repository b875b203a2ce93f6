"""Compare a study with a grid on equal budget: preset `fast`, the same settings, ranges, trials and steps.

    python benchmarks/learning/search.py [--repeats 3] [--steps 700000] [--record FILE]

Starts a whole service with one worker of two slots, and for each repeat, whose trainings have a seed of their own,
submits a grid (`POST /groups`) and then a study of as many trials (`POST /studies`, TPE, without pruning). Prints the
best evaluation of each; exits with 1 unless the study's is better in every repeat.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import httpx
from naospec.json_text import json_text
from naosprint.programs import integer, run_program

sys.path.insert(0, str(Path(__file__).parents[1] / "service"))

from stack import Stack

OBJECTIVE = "distance_m"
SPACE: dict[str, dict[str, Any]] = {
    "target_kl": {"type": "float", "low": 0.005, "high": 0.08, "log": True},
    "initial_log_std": {"type": "float", "low": -2.2, "high": -1.0},
    "n_epochs": {"type": "int", "low": 3, "high": 10},
}
PARTS = {"target_kl": 3, "initial_log_std": 3, "n_epochs": 2}
"""Values of the grid by setting: the middles of equal parts of its range."""


def grid() -> dict[str, list[float]]:
    """Return the grid's values by setting."""
    values: dict[str, list[float]] = {}
    for name, item in SPACE.items():
        shares = [(part + 0.5) / PARTS[name] for part in range(PARTS[name])]
        low, high = item["low"], item["high"]
        if item.get("log"):
            found = [low * (high / low) ** share for share in shares]
        else:
            found = [low + share * (high - low) for share in shares]
        values[name] = [round(value) if item["type"] == "int" else round(value, 4) for value in found]
    return values


def main() -> int:
    """Run all repeats."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--repeats", type=integer(), default=3)
    parser.add_argument("--steps", type=integer(), default=700_000)
    parser.add_argument("--episodes", type=integer(), default=200)
    parser.add_argument("--record", type=Path, help="file for the results, as JSON")
    options = parser.parse_args()
    trials = math.prod(PARTS.values())
    evaluation = {"task": "sprint1", "episodes": options.episodes}
    # Two trainings of one thread each, at the same time.
    os.environ |= {"NAOSPRINT_WORKER_CONCURRENCY": "2", "NAOSPRINT_WORKER_REPORT": "off"}
    stack = Stack(workers=1, store_mb=2048)
    repeats: list[dict[str, Any]] = []
    try:
        headers = {"Authorization": f"Bearer {stack.token}"}
        with httpx.Client(base_url=stack.url, headers=headers, timeout=60) as client:
            for seed in range(options.repeats):
                spec = {
                    "task": "sprint1",
                    "algorithm": {"preset": "fast"},
                    "total_steps": options.steps,
                    "seed": seed,
                    "runtime": {"simulator_threads": 1, "learner_threads": 1},
                }
                job = {"spec": spec, "evaluation": evaluation}
                began = time.monotonic()
                group = client.post("/groups", json={"job": job, "grid": grid()}).raise_for_status().json()
                found = [result_of(client, entry["id"]) for entry in group["jobs"]]
                between = time.monotonic()
                search = {
                    "space": SPACE,
                    "objectives": [{"metric": OBJECTIVE}],
                    "trials": trials,
                    "parallel": 2,
                    "startup_trials": 6,
                    "seed": seed,
                }
                study = client.post("/studies", json={"job": job, "search": search}).raise_for_status().json()
                study = wait(client, f"/studies/{study['id']}")
                values = [trial["values"][0] for trial in study["trials"] if trial["values"]]
                assert len(found) == len(values) == trials
                best = max(study["trials"], key=lambda trial: (trial["values"] or [-1.0])[0])
                repeat = {
                    "seed": seed,
                    "grid": summary(found),
                    "study": {**summary(values), "best_settings": best["params"]},
                    "grid_s": round(between - began),
                    "study_s": round(time.monotonic() - between),
                }
                repeats.append(repeat)
                print(json.dumps(repeat), flush=True)
    finally:
        stack.close()
    figures: dict[str, Any] = {
        "machine": {"cpus": os.cpu_count(), "python": platform.python_version()},
        "objective": f"{OBJECTIVE}, {options.episodes} episodes",
        "steps": options.steps,
        "trials": trials,
        "space": SPACE,
        "grid": grid(),
        "repeats": repeats,
    }
    if options.record:
        options.record.write_text(json_text(figures), encoding="utf-8")
    return 0 if all(repeat["study"]["best"] > repeat["grid"]["best"] for repeat in repeats) else 1


def wait(client: httpx.Client, path: str) -> dict[str, Any]:
    """Return a job or study once it has ended."""
    while True:
        found: dict[str, Any] = client.get(path).raise_for_status().json()
        if found["state"] in ("succeeded", "finished"):
            return found
        if found["state"] in ("failed", "cancelled"):
            raise RuntimeError(f"{path}: {found['state']}: {found['error']}")
        time.sleep(2)


def result_of(client: httpx.Client, job_id: str) -> float:
    """Return the objective of a job once it has ended."""
    job = wait(client, f"/jobs/{job_id}")
    return next(float(result["value"]) for result in job["result"]["results"] if result["name"] == OBJECTIVE)


def summary(values: list[float]) -> dict[str, Any]:
    """Return what the values of all trials come to."""
    return {
        "best": round(max(values), 3),
        "third": round(sorted(values)[-3], 3),
        "median": round(statistics.median(values), 3),
        "values": [round(value, 3) for value in values],
    }


if __name__ == "__main__":
    run_program(main)
