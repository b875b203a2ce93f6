"""Bundle the policy of a finished training: weights, card, replay, and its page in the docs.

    naoctl submit --recipe sprint                            # train it, hours of a core
    python tools/bundle.py sprint --job JOB # evaluate it, and bundle it
    python tools/bundle.py t1-sprint --training FOLDER  # the latest of `naosprint train`, or of a chain
    python tools/bundle.py sprint-blind --training FOLDER --after sprint
    python tools/bundle.py --refresh sprint    # evaluate a bundled policy again
    python tools/bundle.py --examine sprint    # only what its card says of motion and robustness

The service is the one that naoctl talks to. A job's policy is one of its latest checkpoints: of those whose first
headline result is within SLACK of the best, the one with the lowest first rate of the headline, such as that of falls.
The results on the card come from an evaluation of their own, with another seed than the one that chose.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from naospec.json_text import json_text
from naosprint.programs import integer, run_program

# the same floating-point kernels on every x86-64 machine with AVX2, so that a refresh repeats a card to the last digit
os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")

import matplotlib as mpl
import naopolicies
from naosim import robots
from naospec import EvaluationSpec, TrainingSpec, recipes
from naospec.metrics import for_family
from naosprint import evaluate, tasks
from naosprint.analysis import examination, figures
from naosprint.analysis.report import read_metrics, write_report
from naosprint.analysis.results import by_name, headline, interval_text, value_text
from naosprint.rl.checkpoint import ENVIRONMENT, LEARNER, MANIFEST, POLICY, read_manifest
from naosprint.rl.columns import columns

ROOT = Path(__file__).parents[1]
BUNDLED = ROOT / "packages" / "naopolicies" / "src" / "naopolicies" / "bundled"
PAGES = ROOT / "docs" / "policies"

EPISODES = 1000
CHOOSING_EPISODES, CHOOSING_SEED, EVALUATION_SEED = 5000, 1, 2026
SLACK = 0.01
CURVE_POINTS = 200


def main() -> int:
    """Bundle or refresh policies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", metavar="NAME", help="name of the policy for users")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--job", help="finished job whose policy it is; its parents are its lineage")
    source.add_argument(
        "--training",
        type=Path,
        nargs="+",
        metavar="FOLDER",
        help="folders of trainings without the service, each of which started from the policy of the one before it",
    )
    source.add_argument("--refresh", action="store_true", help="evaluate bundled policies again, with the card's seed")
    source.add_argument("--examine", action="store_true", help="examine bundled policies again, and nothing else")
    parser.add_argument("--after", metavar="POLICY", help="bundled policy that the first training started from")
    parser.add_argument(
        "--earlier",
        type=Path,
        help="checkpoint shortly before, kept for `naosprint verify NAME`",
    )
    parser.add_argument("--naoctl", default="naoctl", help="the naoctl to call (default: the one in PATH)")
    parser.add_argument("--episodes", type=integer(), default=EPISODES, help=f"of the evaluation (default: {EPISODES})")
    parser.add_argument("--parts", type=lambda text: text.split(","), default=(), help="parts of the examination")
    parser.add_argument("--latest", type=integer(), default=5, help="latest checkpoints to choose from (default: 5)")
    options = parser.parse_args()
    if options.refresh:
        for name in options.names:
            refresh(name, options.parts)
        return 0
    if options.examine:
        for name in options.names:
            write_card({**naopolicies.card(name), **examined(name, options.parts)})
        return 0
    (name,) = options.names
    if options.training:
        parts = list(naopolicies.card(options.after)["lineage"]) if options.after else []
        for folder in options.training:
            checkpoint = max(folder.glob("step-*"), key=lambda path: read_manifest(path).steps)
            manifest = read_manifest(checkpoint)
            # a training that was killed has gone on after its last checkpoint
            rows = [row for row in read_metrics(folder / "metrics.jsonl") if row["step"] <= manifest.steps]
            parts += stages(folder.name, manifest.spec, rows)
        put_in_place(name, checkpoint, options.earlier)
        write(name, EvaluationSpec(episodes=options.episodes, seed=EVALUATION_SEED), parts, options.parts)
        return 0

    def naoctl(*words: str) -> Any:
        done = subprocess.run([options.naoctl, *words, "--json"], check=True, capture_output=True, text=True)
        return json.loads(done.stdout)

    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        jobs = lineage(naoctl, options.job)
        checkpoint = choose(naoctl, jobs[-1], work, options.latest)
        for job in jobs:
            naoctl("download", job["id"], "--what", "metrics", "--output", str(work / job["id"]))
        parts = [
            part
            for job in jobs
            for part in stages(
                job["name"], TrainingSpec.model_validate(job["spec"]), read_metrics(work / job["id"] / "metrics.jsonl")
            )
        ]
        # the last job may have continued beyond the checkpoint that was chosen
        manifest = read_manifest(checkpoint)
        own = [part for part in parts if part["job"].startswith(jobs[-1]["name"])]
        before = sum(part["steps"] for part in own[:-1])
        parts[-1] |= {"steps": manifest.steps - before}
        put_in_place(name, checkpoint, options.earlier)
    write(name, EvaluationSpec(episodes=options.episodes, seed=EVALUATION_SEED), parts, options.parts)
    return 0


def put_in_place(name: str, checkpoint: Path, earlier: Path | None) -> None:
    """Copy the policy's files from its checkpoint, and a whole earlier checkpoint if there is one.

    The card of the policy before stays until there is another: it has the sentence.
    """
    target = BUNDLED / name
    target.mkdir(parents=True, exist_ok=True)
    (target / "replay.json").unlink(missing_ok=True)
    shutil.rmtree(target / naopolicies.EARLIER, ignore_errors=True)
    # unchanged: the specification's digest includes every field of that version
    slim = json.loads((checkpoint / MANIFEST).read_text(encoding="utf-8"))
    slim["files"] = {key: entry for key, entry in slim["files"].items() if key not in (LEARNER, ENVIRONMENT)}
    (target / MANIFEST).write_text(json_text(slim), encoding="utf-8")
    shutil.copy(checkpoint / POLICY, target / POLICY)
    if earlier is not None:
        shutil.copytree(earlier, target / naopolicies.EARLIER)


def examined(name: str, parts: Sequence[str]) -> dict[str, Any]:
    """Examine a bundled policy, and return what a card says of these parts; of all if there are none."""
    found = examination.examine(BUNDLED / name, names=parts).to_dict()
    others = {"motion", "conditions"}
    asked = {"motion": "motion" in parts, "robustness": "conditions" in parts, "ranges": not others.issuperset(parts)}
    return {key: part for key, part in found.items() if asked[key] or not parts}


def refresh(name: str, parts: Sequence[str]) -> None:
    """Evaluate a bundled policy with its card's settings, rewrite card, replay and page, and print what changed."""
    card = naopolicies.card(name)
    write(name, EvaluationSpec.model_validate(card["evaluation"]), card["lineage"], parts, card)
    old, new = by_name(card), by_name(naopolicies.card(name))
    changed = [key for key in old.keys() | new.keys() if old.get(key) != new.get(key)]
    print(f"  {'no result has changed' if not changed else 'changed: ' + ', '.join(sorted(changed))}")


def lineage(naoctl: Any, job_id: str | None) -> list[dict[str, Any]]:
    """Return a job and those whose policies it started from, oldest first."""
    jobs: list[dict[str, Any]] = []
    while job_id is not None:
        job = naoctl("status", job_id)
        jobs.insert(0, job)
        job_id = job["parent_job_id"]
    return jobs


def choose(naoctl: Any, job: dict[str, Any], work: Path, latest: int) -> Path:
    """Return the folder of the best checkpoint."""
    found: list[tuple[float, float, Path]] = []
    points = sorted(naoctl("checkpoints", job["id"]), key=lambda point: point["step"])[-latest:]
    for point in points:
        folder = work / "points"
        naoctl("download", job["id"], "--what", "checkpoint", "-c", point["id"], "--output", str(folder))
        path = folder / f"checkpoint-{point['step']:012d}"
        if len(points) == 1:
            return path
        summary = evaluate(path, EvaluationSpec(episodes=CHOOSING_EPISODES, seed=CHOOSING_SEED), threads=2).summary
        first, *others = headline(summary)
        rate = next((result["value"] for result in others if result["kind"] == "rate"), 0.0)
        print(f"{point['step']:,}: {', '.join(value_text(result) for result in (first, *others))}", flush=True)
        sign = -1.0 if first["better"] == "lower" else 1.0
        found.append((sign * (first["value"] or 0.0), rate, path))
    if not found:
        raise SystemExit(f"job {job['id']} has no checkpoint")
    best = max(value for value, _, _ in found)
    close = [one for one in found if one[0] >= best - SLACK * abs(best)]
    return min(close, key=lambda one: (one[1], -one[0]))[2]


def stages(job: str, spec: TrainingSpec, rows: list[dict[str, float]]) -> list[dict[str, Any]]:
    """Describe each stage of a job of the lineage, or the whole job if it has none."""
    found, steps, time_s = [], 0.0, 0.0
    for number, stage in enumerate(spec.stage_specs, start=1):
        mine = [row for row in rows if row.get("stage", 1.0) == number]
        if not mine:
            break
        # a long training's rows are thinned, so the last of a stage may be missing
        ended = rows[-1].get("stage", 1.0) > number
        shown = mine[:: max(1, len(mine) // CURVE_POINTS)]
        names = ("step", *tasks.get(stage.task.name).presentation.listed)
        complete = [row for row in shown if all(name in row for name in names)]
        curve = {name: [round(row[name] - (steps if name == "step" else 0.0), 4) for row in complete] for name in names}
        found.append(
            {
                "job": job + (f", stage {number}" if spec.stages else ""),
                "task": stage.task.name,
                "robot": stage.robot.name,
                "preset": spec.algorithm.preset,
                "seed": stage.seed,
                "steps": stage.planned_steps if ended else int(mine[-1]["step"] - steps),
                "training_s": round(mine[-1]["time_s"] - time_s),
                "overrides": stage.overrides(),
                "curve": curve,
            }
        )
        steps += stage.planned_steps
        time_s = mine[-1]["time_s"]
    return found


def write(
    name: str,
    spec: EvaluationSpec,
    parts: list[dict[str, Any]],
    parts_examined: Sequence[str] = (),
    before: Mapping[str, Any] = MappingProxyType({"motion": {}, "robustness": [], "ranges": {}}),
) -> None:
    """Evaluate a policy whose weights are in place; write its card, its replay and its page.

    Parts of the examination that are not asked for are those of the card ``before``.
    """
    target = BUNDLED / name
    trained = read_manifest(target).stage_spec
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        evaluation = evaluate(target, spec, threads=2)
        evaluation.save(work)
        summary = evaluation.summary
        shutil.copy(work / "replay.json", target / "replay.json")
        card = {
            "name": name,
            "sentence": sentence_of(name, trained),
            "summary": summary_text(summary),
            "robot": trained.robot.name,
            "task": trained.task.name,
            "steps": sum(int(one["steps"]) for one in parts),
            "training_s": sum(int(one["training_s"]) for one in parts),
            **{key: summary[key] for key in ("episodes", "results", "headline", "tables", "evaluation")},
            "lineage": parts,
            **{key: before[key] for key in ("motion", "robustness", "ranges")},
            **examined(name, parts_examined),
        }
        report = write_report(work / "report", evaluation=work, title=name).parent
        pictures = PAGES / name
        shutil.rmtree(pictures, ignore_errors=True)
        pictures.mkdir(parents=True)
        for picture in pictures_of(card):
            shutil.copy(report / f"{picture}.png", pictures)
        shutil.copy(report / "run.mp4", pictures)
        with mpl.rc_context(figures.style()):
            learning_curves(trained, card).savefig(pictures / "learning-curve.png", dpi=150)
    write_card(card)
    print(f"{name}: {card['summary']}")


def write_card(card: dict[str, Any]) -> None:
    """Write a policy's card, and its page in the docs."""
    (BUNDLED / card["name"] / "card.json").write_text(json_text(naopolicies.stored(card)), encoding="utf-8")
    (PAGES / f"{card['name']}.md").write_text(page(card), encoding="utf-8")


def sentence_of(name: str, trained: TrainingSpec) -> str:
    """Return what a policy does in a sentence: as its card says it, else as its task does."""
    known = naopolicies.card(name) if (BUNDLED / name / naopolicies.CARD).is_file() else {}
    return str(known.get("sentence") or tasks.get(trained.task.name).summary)


def pictures_of(card: dict[str, Any]) -> list[str]:
    """Return the names of a policy's pictures."""
    return [*(table["name"].replace("_", "-") for table in card["tables"]), "trajectories", "frames", "gait"]


def summary_text(summary: dict[str, Any]) -> str:
    """Return the headline results in one line."""
    titles = ((one["title"], one) for one in headline(summary))
    results = ", ".join(f"{title if title.isupper() else title.lower()} {value_text(one)}" for title, one in titles)
    return f"{results} over {summary['episodes']:,} episodes"


def learning_curves(spec: TrainingSpec, card: dict[str, Any]) -> Any:
    """Plot the metrics of the whole lineage, with the policy's results at its end."""
    rows: list[dict[str, float]] = []
    steps = 0
    for number, part in enumerate(card["lineage"], start=1):
        for values in zip(*part["curve"].values(), strict=True):
            row = dict(zip(part["curve"], values, strict=True))
            rows.append({**row, "step": steps + row["step"], "stage": float(number)})
        steps += part["steps"]
    presentation = tasks.get(spec.task.name).presentation
    results = {name: one["value"] for name, one in by_name(card).items() if one["value"] is not None}
    metrics = {metric.name: metric for metric in columns(spec)}
    references = for_family(robots.configured(spec.robot).family, presentation.references)
    return figures.learning_curves(rows, presentation.charts, metrics, references, (steps, results))


def page(card: dict[str, Any]) -> str:
    """Return a policy's page for the docs."""
    name, confidence = card["name"], card["evaluation"]["confidence"]
    lines = [f"# {name}", "", f"[![{name} in pictures]({name}/frames.png)]({name}/run.mp4)", ""]
    lines += [f"[Film]({name}/run.mp4)", ""]
    lines += [card["sentence"], ""]
    lines += [f"Robot {card['robot']}, task {card['task']}: {card['summary']}.", ""]
    lines += [f"| {card['episodes']:,} episodes, deterministic | | |", "|---|---|---|"]
    lines += [f"| {one['title']} | {value_text(one)} | {interval_text(one, confidence)} |" for one in card["results"]]
    lines += [f"| Training | {card['steps'] / 1e6:.0f} million steps | {card['training_s'] / 60:.0f} minutes |", ""]
    lines += [
        "## Training",
        "",
        "| Job | Training | Steps | Minutes | Overrides of the preset |",
        "|---|---|---|---|---|",
    ]
    for one in card["lineage"]:
        changes = ", ".join(f"`{key}` {json.dumps(value)}" for key, value in one["overrides"].items()) or "none"
        training = f"{one['task']}, {one['robot']}, preset {one['preset']}, seed {one['seed']}"
        lines.append(
            f"| {one['job']} | {training} | {one['steps'] / 1e6:.0f} M | {one['training_s'] / 60:.0f} | {changes} |"
        )
    lines += ["", f"![learning curves]({name}/learning-curve.png)", ""]
    for title, (header, *rows) in examination.rows(card):
        lines += [f"## {title}", "", *(f"| {' | '.join(row)} |" for row in (header, ["---"] * len(header), *rows)), ""]
    repeats = tasks.get(card["task"]).presentation.repeats
    lines += ["## Gait" if repeats else "## Motion in pictures", ""]
    lines += [f"![{picture}]({name}/{picture}.png)\n" for picture in pictures_of(card) if picture != "frames"]
    lines += [
        "## Try it",
        "",
        f"    python -m naosprint evaluate {name}",
        f"    python -m naosprint replay {name} {name}-run",
        f"    python -m naosprint export {name} {name}-export",
    ]
    if (BUNDLED / name / naopolicies.EARLIER).is_dir():
        lines += [
            "",
            "Train its last segment again, and compare every bit:",
            "",
            f"    python -m naosprint verify {name}",
        ]
    if name in recipes.names():
        parent = recipes.job(name).get("parent_policy")
        jobs = "all of the jobs above" if parent is None else "the jobs after that policy's"
        start = "" if parent is None else f" from `{parent}`"
        lines += ["", f"Train it again{start}, {jobs} as the stages of one:", ""]
        lines.append(f"    naoctl submit --recipe {name}")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    run_program(main)
