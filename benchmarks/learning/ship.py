"""Put the policy of a finished job into the box: weights, card, a run to look at, and its page in the docs.

    naoctl submit benchmarks/learning/recipes/sprint-1.yaml      # train it, hours of a core; then sprint-2 --from it
    python benchmarks/learning/ship.py sprint --job JOB          # judge it anew, and write what is shipped

The service is the one that naoctl talks to. The policy is one of the latest checkpoints: of those whose top speed, by
which the paper ranks, is within SPEED_SLACK of the best the one that falls least. The shipped figures come from an
evaluation of their own, with another seed than the one that chose.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from naospec import EvaluationSpec, TrainingSpec
from naosprint import evaluate
from naosprint.checkpoint import ENVIRONMENT, LEARNER, MANIFEST, POLICY, read_manifest
from naosprint.report import read_metrics, write_report

ROOT = Path(__file__).parents[2]
SHIPPED = ROOT / "packages" / "naopolicies" / "src" / "naopolicies" / "shipped"
PAGES = ROOT / "docs" / "policies"
PICTURES = ("learning-curve", "speed-profile", "trajectories", "frames", "gait")

EPISODES = 1000
CHOOSING_EPISODES, CHOOSING_SEED, JUDGING_SEED = 5000, 1, 2026
SPEED_SLACK = 0.01
CURVE_POINTS = 200


def main() -> int:
    """Ship one policy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", help="name of the policy, as users will call it")
    parser.add_argument("--job", required=True, help="finished job whose policy it is; its parents are its lineage")
    parser.add_argument("--naoctl", default="naoctl", help="the naoctl to call (default: the one in PATH)")
    parser.add_argument("--latest", type=int, default=5, help="choose among so many latest checkpoints (default: 5)")
    options = parser.parse_args()

    def naoctl(*words: str) -> Any:
        done = subprocess.run([options.naoctl, *words, "--json"], check=True, capture_output=True, text=True)
        return json.loads(done.stdout)

    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        jobs = lineage(naoctl, options.job)
        checkpoint, evaluation = choose(naoctl, jobs[-1], work, options.latest)
        metrics = work / "metrics.jsonl"
        for job in jobs:
            naoctl("download", job["id"], "--what", "metrics", "--output", str(work / job["id"]))
        metrics.write_text((work / jobs[-1]["id"] / "metrics.jsonl").read_text())
        ship(options.name, checkpoint, evaluation, metrics, [stage(job, work) for job in jobs])
    return 0


def lineage(naoctl: Any, job_id: str | None) -> list[dict[str, Any]]:
    """Return a job and those whose policies it started from, oldest first."""
    jobs: list[dict[str, Any]] = []
    while job_id is not None:
        job = naoctl("status", job_id)
        jobs.insert(0, job)
        job_id = job["parent_job_id"]
    return jobs


def choose(naoctl: Any, job: dict[str, Any], work: Path, latest: int) -> tuple[Path, Path]:
    """Return the folders of the best checkpoint and of its final evaluation."""
    found: list[tuple[float, float, Path]] = []
    points = sorted(naoctl("checkpoints", job["id"]), key=lambda point: point["step"])[-latest:]
    for point in points:
        folder = work / "candidates"
        naoctl("download", job["id"], "--what", "checkpoint", "-c", point["id"], "--output", str(folder))
        path = folder / f"checkpoint-{point['step']:012d}"
        summary = judged(path, job, CHOOSING_EPISODES, CHOOSING_SEED).summary
        speed, falls = summary["paper"]["top_speed_mps"] or 0.0, summary["falls"]["rate"]
        print(f"{point['step']:,}: {speed:.3f} m/s, {100 * falls:.2f} % falls", flush=True)
        found.append((speed, falls, path))
    if not found:
        raise SystemExit(f"job {job['id']} has no checkpoint")
    fastest = max(speed for speed, _, _ in found)
    _, _, best = min(
        (one for one in found if one[0] >= (1.0 - SPEED_SLACK) * fastest), key=lambda one: (one[1], -one[0])
    )
    evaluation = work / "evaluation"
    judged(best, job, EPISODES, JUDGING_SEED).save(evaluation)
    return best, evaluation


def judged(checkpoint: Path, job: dict[str, Any], episodes: int, seed: int) -> Any:
    """Evaluate a checkpoint as the paper does: over the whole field, whichever task it was trained on."""
    erect = job["spec"]["task"].endswith("-erect")
    spec = EvaluationSpec(task="sprint1-erect" if erect else "sprint1", episodes=episodes, seed=seed)
    return evaluate(checkpoint, spec, threads=2)


def stage(job: dict[str, Any], work: Path) -> dict[str, Any]:
    """Describe one job of the lineage."""
    spec = TrainingSpec.model_validate(job["spec"])
    rows = read_metrics(work / job["id"] / "metrics.jsonl")
    shown = rows[:: max(1, len(rows) // CURVE_POINTS)]
    names = ("step", "distance_m", "speed_mps", "fall_rate")
    return {
        "job": job["name"],
        "task": spec.task,
        "preset": spec.preset,
        "seed": spec.seed,
        "steps": int(rows[-1]["step"]),
        "training_s": round(rows[-1]["time_s"]),
        "departures": spec.departures(),
        "curve": {name: [round(row[name], 4) for row in shown if "speed_mps" in row] for name in names},
    }


def ship(name: str, checkpoint: Path, evaluation: Path, metrics: Path, stages: list[dict[str, Any]]) -> None:
    """Write the policy's folder and its page."""
    summary = json.loads((evaluation / "evaluation.json").read_text())
    manifest = read_manifest(checkpoint)
    # the last job may have gone on beyond the checkpoint that was chosen
    stages[-1] |= {"steps": manifest.steps, "training_s": round(manifest.training_s)}
    target = SHIPPED / name
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    # as it was written: the specification's digest counts every field that there was then
    slim = json.loads((checkpoint / MANIFEST).read_text())
    slim["files"] = {key: entry for key, entry in slim["files"].items() if key not in (LEARNER, ENVIRONMENT)}
    (target / MANIFEST).write_text(json.dumps(slim, indent=1) + "\n")
    shutil.copy(checkpoint / POLICY, target / POLICY)
    shutil.copy(evaluation / "replay.json", target / "replay.json")
    card = {
        "name": name,
        "summary": headline(manifest.spec, summary),
        "robot_type": manifest.spec.robot_type,
        "task": manifest.spec.task,
        "steps": sum(int(one["steps"]) for one in stages),
        "training_s": sum(int(one["training_s"]) for one in stages),
        "figures": {
            key: summary[key]
            for key in ("episodes", "distance_m", "speed_mps", "falls", "paper", "speed_by_line", "run_challenge")
        },
        "both_feet_off_ground": summary["both_feet_off_ground"],
        "evaluation": summary["evaluation"],
        "lineage": stages,
    }
    (target / "card.json").write_text(json.dumps(card, indent=1, allow_nan=False) + "\n")
    pictures = PAGES / name
    shutil.rmtree(pictures, ignore_errors=True)
    pictures.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as scratch:
        report = write_report(Path(scratch), evaluation=evaluation, metrics=metrics, title=name).parent
        for picture in PICTURES:
            shutil.copy(report / f"{picture}.png", pictures / f"{picture}.png")
        shutil.copy(report / "run.mp4", pictures / "run.mp4")
        shutil.copy(report / "run.gif", pictures / "run.gif")
    (PAGES / f"{name}.md").write_text(page(card))
    print(f"{name}: {card['summary']}")


def headline(spec: TrainingSpec, summary: dict[str, Any]) -> str:
    """Say in one line how good a policy is."""
    posture = ", torso kept erect" if spec.task.endswith("-erect") else ""
    return (
        f"robot type {spec.robot_type}{posture}: top speed {summary['paper']['top_speed_mps']:.2f} m/s, "
        f"{100 * summary['falls']['rate']:.1f} % falls, deviation {summary['paper']['deviation_deg']['mean']:.1f} deg "
        f"over {summary['episodes']} episodes"
    )


def page(card: dict[str, Any]) -> str:
    """Return a policy's page for the docs."""
    name, figures = card["name"], card["figures"]
    paper, falls, speed = figures["paper"], figures["falls"], figures["speed_mps"]
    low, high = (100 * bound for bound in falls["ci"])
    deviation = paper["deviation_deg"]
    rows = [
        ("Top speed, the paper's measure", f"{paper['top_speed_mps']:.3f} m/s"),
        ("Mean speed from the start on, all episodes", f"{speed['mean']:.3f} m/s"),
        ("Distance, all episodes", f"{figures['distance_m']['mean']:.2f} m"),
        ("Falls", f"{100 * falls['rate']:.1f} % (95 % interval {low:.1f} to {high:.1f} %)"),
        ("Deviation from the straight line", f"{deviation['mean']:.2f} ± {deviation['sd']:.2f}°"),
        ("Both feet off the ground", f"{100 * card['both_feet_off_ground']['mean']:.0f} % of the time"),
        ("Run challenge", f"{figures['run_challenge']['score']['mean']:.2f} m/s"),
        ("Trained", f"{card['steps'] / 1e6:.0f} million steps in {card['training_s'] / 60:.0f} minutes"),
    ]
    lines = [f"# {name}", "", f"![{name} runs]({name}/run.gif)", "", f"Summary: {card['summary']}.", ""]
    lines += [f"| Over {figures['episodes']} episodes, deterministic | |", "|---|---|"]
    lines += [f"| {label} | {value} |" for label, value in rows]
    lines += [
        "",
        "## How it came about",
        "",
        "| Job | Task | Steps | Minutes | Other than the preset |",
        "|---|---|---|---|---|",
    ]
    for one in card["lineage"]:
        changes = ", ".join(f"`{key}` {value}" for key, value in one["departures"].items()) or "nothing"
        lines.append(
            f"| {one['job']} | {one['task']}, preset {one['preset']}, seed {one['seed']} | {one['steps'] / 1e6:.0f} M "
            f"| {one['training_s'] / 60:.0f} | {changes} |"
        )
    lines += ["", "![learning curve]" + f"({name}/learning-curve.png)", "", "## How it runs", ""]
    lines += [f"![{picture}]({name}/{picture}.png)\n" for picture in PICTURES[1:]]
    lines += [
        "## Try it",
        "",
        f"    python -m naosprint evaluate {name}",
        f"    python -m naosprint replay {name} {name}-run",
        f"    python -m naosprint export {name} {name}-export",
        "",
        "and train it again:",
        "",
    ]
    recipes = sorted((ROOT / "benchmarks" / "learning" / "recipes").glob(f"{name}-[0-9].yaml"))
    # where others come before the policy's own, their page says how
    before = len(card["lineage"]) - len(recipes)
    for number, recipe in enumerate(recipes, start=before):
        lines.append(f"    naoctl submit {recipe.relative_to(ROOT)}" + (" --from JOB" if number else ""))
    lines += ["", "where `JOB` is the job before it, once that has come as far as the table says."]
    if before and (other := shares(card["lineage"][:before], name)):
        lines[-1] += f" The jobs before these are those of [{other}]({other}.md)."
    return "\n".join([*lines, ""])


def shares(stages: list[dict[str, Any]], name: str) -> str | None:
    """Return the shipped policy with the shortest lineage that begins with these jobs."""
    jobs = [one["job"] for one in stages]
    cards = [json.loads(path.read_text()) for path in sorted(SHIPPED.glob("*/card.json"))]
    known = [
        (len(card["lineage"]), card["name"])
        for card in cards
        if card["name"] != name and [one["job"] for one in card["lineage"]][: len(jobs)] == jobs
    ]
    return min(known)[1] if known else None


if __name__ == "__main__":
    sys.exit(main())
