"""Measure what each means of training is worth; write the study's record and plot.

They replace those beside this file, unless steps or episodes are chosen: then they are below build.

    python benchmarks/learning/ablation.py ablation WORKDIR --jobs 2    # hours of two cores
    python benchmarks/learning/ablation.py teacher WORKDIR --jobs 2
    python benchmarks/learning/ablation.py teacher WORKDIR --only plot  # draw again from teacher.json

A bundled policy is trained further for equally many steps, three seeds for each variant. Study `ablation`: the policy
of `t1-sprint`, which one floor and one delay have made fast, in a disturbed world, with all means and with one of them
other than in it. Study `teacher`: a T1 that follows velocities without being told its own, alone and with a teacher
that is told. Every training has a core of its own. Trainings are stored in WORKDIR and are continued, not repeated,
when the script is called again.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from naospec.files import write_whole
from naospec.json_text import json_text
from naosprint.programs import integer, run_program
from naosprint.threads import quiet_openmp

quiet_openmp()

import naopolicies  # noqa: E402
from naosprint.analysis import figures, robustness  # noqa: E402
from naosprint.analysis.results import by_name  # noqa: E402
from naosprint.rl.checkpoint import read_manifest  # noqa: E402
from naosprint.threads import set_learner_threads  # noqa: E402
from run import ONE_CORE, TRIALS, machine, require_writable, spec_of, trained  # noqa: E402

HERE = Path(__file__).parent
SEEDS = (1, 2, 3)
EPISODES = 50


@dataclass(frozen=True)
class Study:
    """Trainings that are compared.

    Attributes:
        parent: bundled policy whose training they continue.
        steps: steps of each.
        settings: settings of all.
        variants: settings in which each variant differs, by its name.
        result: the result that is shown besides falls.
        label: axis of the plot.
    """

    parent: str
    steps: int
    settings: dict[str, Any]
    variants: dict[str, dict[str, Any]]
    result: str
    label: str

    @property
    def results(self) -> tuple[str, str]:
        """What is recorded under each condition."""
        return self.result, "fall_rate"


DISTURBED: dict[str, Any] = {
    "robot": "t1",
    "friction_min": 0.5,
    "friction_max": 1.2,
    "sensor_noise": 1.0,
    "mass_variation": 0.1,
    "extra_delay_max": 1,
    "gamma": 0.99,
    "gamma_steps": 0,
    "learning_rate": 3.0e-4,
    "critic_observations": True,
}

STUDIES = {
    "ablation": Study(
        "t1-sprint",
        7_000_000,
        DISTURBED
        | {
            "history_steps": 2,
            "push_mps": 1.0,
            "undisturbed_fraction": 0.25,
            "fall_penalty_m": 2.0,
            "initial_log_std": -2.0,
            "final_log_std": -2.3,
        },
        {
            "all means": {},
            "no earlier steps observed": {"history_steps": 0},
            "four earlier steps instead of two": {"history_steps": 4},
            "critic sees what the policy sees": {"critic_observations": False},
            "disturbances that grow": {"disturbance_growth": 0.1},
        },
        "top_speed_mps",
        "top speed, m/s",
    ),
    "teacher": Study(
        "t1-run-steady",
        4_000_000,
        DISTURBED
        | {
            "task": "velocity",
            "onboard_sensing": True,
            "history_steps": 5,
            "push_mps": 0.8,
            "undisturbed_fraction": 0.4,
            "fall_penalty": 200.0,
            "flight_weight": 0.5,
            "speed_weight": 0.8,
            "stand_fraction": 0.1,
            "forward_min_mps": -1.0,
            "forward_max_mps": 3.0,
            "sideways_max_mps": 1.0,
            "turn_max_rad_s": 2.0,
            "straight_fraction": 0.4,
            "command_steps": 100,
            "command_ellipsoid": True,
            "forward_acceleration_mps2": 4.0,
            "sideways_acceleration_mps2": 2.5,
            "turn_acceleration_rad_s2": 5.0,
            "n_steps": 256,
            "batch_size": 8192,
            "target_kl": 0.016,
            "initial_log_std": -2.6,
            "final_log_std": -3.2,
        },
        {
            "alone": {},
            "with a teacher": {"teacher": "t1-run-steady", "imitation_steps": 2_000_000},
        },
        "rmse_mps",
        "RMSE, m/s",
    ),
}


def measured(workdir: Path, study: Study, variant: str, seed: int, steps: int, episodes: int) -> dict[str, Any]:
    """Train one seed of a variant on one core, and evaluate it under each condition; once, then read what was found."""
    name = f"{list(study.variants).index(variant)}-{seed}"
    kept = workdir / f"{name}.json"
    if not kept.exists():
        set_learner_threads(1)
        settings = {**study.settings, **study.variants[variant], **ONE_CORE}
        spec = spec_of(seed=seed, total_steps=steps, log_std_steps=steps, **settings)
        began = time.process_time()
        folder = trained(workdir, name, spec, naopolicies.folder(study.parent))
        core_s = time.process_time() - began
        checkpoint = max(folder.glob("step-*"), key=lambda path: read_manifest(path).steps)
        conditions = {}
        for condition in robustness.conditions(checkpoint, episodes=episodes, threads=1):
            found = {name: result["value"] for name, result in by_name(condition).items()}
            if "fall_rate" not in found:
                found["fall_rate"] = 1.0 - found["upright_rate"]
            conditions[condition["disturbance"]] = {name: found[name] for name in study.results}
        record = {"steps": read_manifest(checkpoint).steps, "core_s": round(core_s) or None, "conditions": conditions}
        kept.write_text(json_text({**record, "machine": machine()}), encoding="utf-8")
    record = json.loads(kept.read_text(encoding="utf-8"))
    return {"variant": variant, "seed": seed, **record}


def table(study: Study, runs: list[dict[str, Any]]) -> str:
    """Return result and falls of each variant as a Markdown table: the mean of its seeds, and each."""
    conditions = list(runs[0]["conditions"])
    lines = ["| Variant | " + " | ".join(conditions) + " |", "|---" * (1 + len(conditions)) + "|"]
    for variant in dict.fromkeys(run["variant"] for run in runs):
        cells = []
        for condition in conditions:
            found = [run["conditions"][condition] for run in runs if run["variant"] == variant]
            falls = [100.0 * one["fall_rate"] for one in found]
            speeds = [one[study.result] for one in found if one[study.result] is not None]
            speed = f"{np.mean(speeds):.2f} m/s" if speeds else "none"
            each = ", ".join(f"{value:.0f}" for value in falls)
            cells.append(f"{speed}, {np.mean(falls):.0f} % ({each})")
        lines.append(f"| {variant} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plot(path: Path, study: Study, runs: list[dict[str, Any]]) -> None:
    """Draw falls and the result under every condition: a point for each seed, a bar for their mean."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    conditions = list(runs[0]["conditions"])
    variants = list(dict.fromkeys(run["variant"] for run in runs))
    palette = ("#1b8a6b", "#2c6fbb", "#8a6fb8", "#c2703d", "#555c65")
    width = 0.8 / len(variants)
    with mpl.rc_context(figures.style()):
        figure = Figure(figsize=(9.0, 6.4), layout="constrained")
        panels = figure.subplots(2, 1, sharex=True)
        for axes, result, factor in zip(panels, study.results, (1.0, 100.0), strict=True):
            for number, variant in enumerate(variants):
                at = np.arange(len(conditions)) + (number - (len(variants) - 1) / 2) * width
                members = [run["conditions"] for run in runs if run["variant"] == variant]
                # None where every robot fell before its top speed could be measured
                found = factor * np.array([[one[each][result] for one in members] for each in conditions], float)
                height = [row[np.isfinite(row)].mean() if np.isfinite(row).any() else 0.0 for row in found]
                axes.bar(at, height, 0.9 * width, color=palette[number], alpha=0.55, label=variant)
                for seed in range(found.shape[1]):
                    axes.plot(at, found[:, seed], "o", ms=2.5, color=palette[number])
        panels[0].set_ylabel(study.label)
        panels[1].set_ylabel("falls, %")
        labels = [each.split(" (")[0] for each in conditions]
        panels[1].set_xticks(np.arange(len(conditions)), labels, rotation=25, ha="right", rotation_mode="anchor")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=8.5)
        figure.savefig(path, dpi=130)


def main() -> int:
    """Measure, write, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("workdir", type=Path, help="directory for trainings; may be deleted afterwards")
    parser.add_argument("--steps", type=integer(), help="of each training (default: the study's)")
    parser.add_argument(
        "--episodes", type=integer(), default=EPISODES, help="under each condition (default: %(default)s)"
    )
    parser.add_argument(
        "--jobs", type=integer(), default=2, help="trainings at a time, a core each (default: %(default)s)"
    )
    parser.add_argument("--only", choices=["plot"], help="draw again what the study's record contains")
    parser.add_argument("-o", "--output", type=Path, help="folder for record and plot")
    options = parser.parse_args()
    study = STUDIES[options.study]
    size = (options.steps or study.steps, options.episodes)
    output = options.output or (HERE if size == (study.steps, EPISODES) else TRIALS)
    record = output / f"{options.study}.json"
    require_writable(output)
    if options.only != "plot":
        wanted = [(variant, seed) for variant in study.variants for seed in SEEDS]
        with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
            futures = {pool.submit(measured, options.workdir, study, *one, *size): one for one in wanted}
            runs = []
            for future in as_completed(futures):
                runs.append(future.result())
                print(*futures[future], runs[-1]["conditions"], flush=True)
        runs.sort(key=lambda run: wanted.index((run["variant"], run["seed"])))
        found = {"steps": size[0], "episodes": options.episodes, "runs": runs}
        write_whole(record, json_text(found))
    runs = json.loads(record.read_text(encoding="utf-8"))["runs"]
    print(table(study, runs))
    plot(record.with_suffix(".png"), study, runs)
    return 0


if __name__ == "__main__":
    run_program(main)
