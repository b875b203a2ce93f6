"""Measure what each means of robust training is worth; write ablation.json and the plot beside this file.

    python benchmarks/learning/ablation.py WORKDIR --jobs 2    # hours of two cores
    python benchmarks/learning/ablation.py WORKDIR --only plot # draw again from ablation.json

The policy of `t1-sprint`, which one floor and one delay have made fast, is trained for equally many steps in a
disturbed world, three seeds for each variant: with all means, and with one of them other than in it. Every training has
a core of its own. Trainings are stored in WORKDIR and are continued, not repeated, when the script is called again.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
from naospec.json_text import json_text
from naosprint.threads import quiet_openmp

quiet_openmp()

import naopolicies  # noqa: E402
from naosprint.analysis import figures, robustness  # noqa: E402
from naosprint.analysis.results import by_name  # noqa: E402
from naosprint.rl.checkpoint import read_manifest  # noqa: E402
from naosprint.threads import set_learner_threads  # noqa: E402
from run import ONE_CORE, machine, spec_of, trained  # noqa: E402

HERE = Path(__file__).parent
RECORD = HERE / "ablation.json"

PARENT = "t1-sprint"
SEEDS = (1, 2, 3)
RESULTS = ("top_speed_mps", "fall_rate")

ALL: dict[str, Any] = {
    "robot": "t1",
    "history_steps": 2,
    "friction_min": 0.5,
    "friction_max": 1.2,
    "sensor_noise": 1.0,
    "push_mps": 1.0,
    "mass_variation": 0.1,
    "extra_delay_max": 1,
    "undisturbed_fraction": 0.25,
    "fall_penalty_m": 2.0,
    "gamma": 0.99,
    "gamma_steps": 0,
    "learning_rate": 3.0e-4,
    "initial_log_std": -2.0,
    "final_log_std": -2.3,
    "critic_observations": True,
}

VARIANTS: dict[str, dict[str, Any]] = {
    "all means": {},
    "no earlier steps observed": {"history_steps": 0},
    "four earlier steps instead of two": {"history_steps": 4},
    "critic sees what the policy sees": {"critic_observations": False},
    "disturbances that grow": {"disturbance_growth": 0.1},
}
"""Settings in which each variant differs."""


def measured(workdir: Path, variant: str, seed: int, steps: int, episodes: int) -> dict[str, Any]:
    """Train one seed of a variant on one core, and evaluate it under each condition; once, then read what was found."""
    name = f"{list(VARIANTS).index(variant)}-{seed}"
    found = workdir / f"{name}.json"
    if not found.exists():
        set_learner_threads(1)
        settings = {**ALL, **VARIANTS[variant], **ONE_CORE}
        spec = spec_of(seed=seed, total_steps=steps, log_std_steps=steps, **settings)
        began = time.process_time()
        folder = trained(workdir, name, spec, naopolicies.folder(PARENT))
        core_s = time.process_time() - began
        checkpoint = max(folder.glob("step-*"), key=lambda path: read_manifest(path).steps)
        conditions = {}
        for condition in robustness.conditions(checkpoint, episodes=episodes, threads=1):
            results = by_name(condition)
            conditions[condition["disturbance"]] = {name: results[name]["value"] for name in RESULTS}
        record = {"steps": read_manifest(checkpoint).steps, "core_s": round(core_s), "conditions": conditions}
        found.write_text(json_text({**record, "machine": machine()}), encoding="utf-8")
    record = json.loads(found.read_text(encoding="utf-8"))
    return {"variant": variant, "seed": seed, **record}


def table(runs: list[dict[str, Any]]) -> str:
    """Return top speed and falls of each variant as a Markdown table: the mean of its seeds, and each."""
    conditions = list(runs[0]["conditions"])
    lines = ["| Variant | " + " | ".join(conditions) + " |", "|---" * (1 + len(conditions)) + "|"]
    for variant in dict.fromkeys(run["variant"] for run in runs):
        cells = []
        for condition in conditions:
            found = [run["conditions"][condition] for run in runs if run["variant"] == variant]
            falls = [100.0 * one["fall_rate"] for one in found]
            speeds = [one["top_speed_mps"] for one in found if one["top_speed_mps"] is not None]
            speed = f"{np.mean(speeds):.2f} m/s" if speeds else "none"
            each = ", ".join(f"{value:.0f}" for value in falls)
            cells.append(f"{speed}, {np.mean(falls):.0f} % ({each})")
        lines.append(f"| {variant} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plot(runs: list[dict[str, Any]]) -> None:
    """Draw falls and top speed under every condition: a point for each seed, a bar for their mean."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    conditions = list(runs[0]["conditions"])
    variants = list(dict.fromkeys(run["variant"] for run in runs))
    palette = ("#1b8a6b", "#2c6fbb", "#8a6fb8", "#c2703d", "#555c65")
    width = 0.8 / len(variants)
    with mpl.rc_context(figures.style()):
        figure = Figure(figsize=(9.0, 6.4), layout="constrained")
        panels = figure.subplots(2, 1, sharex=True)
        for axes, result, factor in zip(panels, RESULTS, (1.0, 100.0), strict=True):
            for number, variant in enumerate(variants):
                at = np.arange(len(conditions)) + (number - (len(variants) - 1) / 2) * width
                members = [run["conditions"] for run in runs if run["variant"] == variant]
                # None where every robot fell before its top speed could be measured
                found = factor * np.array([[one[name][result] for one in members] for name in conditions], float)
                height = [row[np.isfinite(row)].mean() if np.isfinite(row).any() else 0.0 for row in found]
                axes.bar(at, height, 0.9 * width, color=palette[number], alpha=0.55, label=variant)
                for seed in range(found.shape[1]):
                    axes.plot(at, found[:, seed], "o", ms=2.5, color=palette[number])
        panels[0].set_ylabel("top speed, m/s")
        panels[1].set_ylabel("falls, %")
        labels = [name.split(" (")[0] for name in conditions]
        panels[1].set_xticks(np.arange(len(conditions)), labels, rotation=25, ha="right", rotation_mode="anchor")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=8.5)
        figure.savefig(HERE / "ablation.svg", metadata={"Date": None})
        figure.savefig(HERE / "ablation.png", dpi=130)


def main() -> int:
    """Measure, write, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workdir", type=Path, help="directory for trainings; may be deleted afterwards")
    parser.add_argument("--steps", type=int, default=7_000_000, help="of each training (default: %(default)s)")
    parser.add_argument("--episodes", type=int, default=50, help="under each condition (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="trainings at a time, a core each (default: %(default)s)")
    parser.add_argument("--only", choices=["plot"], help="draw again what ablation.json contains")
    options = parser.parse_args()
    if options.only != "plot":
        wanted = [(variant, seed) for variant in VARIANTS for seed in SEEDS]
        with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
            size = (options.steps, options.episodes)
            futures = {pool.submit(measured, options.workdir, *one, *size): one for one in wanted}
            runs = []
            for future in as_completed(futures):
                runs.append(future.result())
                print(*futures[future], runs[-1]["conditions"], flush=True)
        runs.sort(key=lambda run: wanted.index((run["variant"], run["seed"])))
        record = {"steps": options.steps, "episodes": options.episodes, "runs": runs}
        RECORD.write_text(json_text(record), encoding="utf-8")
    runs = json.loads(RECORD.read_text(encoding="utf-8"))["runs"]
    print(table(runs))
    plot(runs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
