"""Measure results and speed of learning; write results.json and the plots.

They replace those beside this file; of some sections they are below build, or where --output says.

    python benchmarks/learning/run.py WORKDIR                    # everything, hours of two quiet cores
    python benchmarks/learning/run.py WORKDIR --only throughput  # or some of it
    python benchmarks/learning/run.py WORKDIR --only plots -o benchmarks/learning  # draw again from results.json

Trainings are stored in WORKDIR and are continued, not repeated, when the script is called again. Each runs on one core,
so that two sections can be measured in parallel on two.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from naospec.files import write_whole
from naospec.json_text import json_text
from naosprint.programs import run_program
from naosprint.threads import quiet_openmp, set_learner_threads

quiet_openmp()

import numpy as np  # noqa: E402
from naospec import EvaluationSpec, TrainingSpec, plugins  # noqa: E402
from naospec.flat import nest  # noqa: E402
from naosprint import evaluate, tasks, train  # noqa: E402
from naosprint.analysis import figures  # noqa: E402
from naosprint.analysis.report import read_metrics  # noqa: E402
from naosprint.analysis.results import by_name  # noqa: E402
from naosprint.console import listed_text  # noqa: E402
from naosprint.rl.checkpoint import read_manifest  # noqa: E402
from naosprint.rl.columns import columns  # noqa: E402
from naosprint.rl.ppo import PPO  # noqa: E402
from naosprint.rl.rollout import TrainingEnvironment  # noqa: E402
from naosprint.tasks.environment import open_training_environment  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

HERE = Path(__file__).parent
TRIALS = HERE.parents[1] / "build" / "benchmarks" / "learning"
"""Folder of what replaces no committed results."""

SEEDS = (0, 1, 2)
STEPS = 10_000_000
LONG_STEPS = 50_000_000
SAC_STEPS = 500_000
SAC_PACKAGE = HERE.parents[1] / "tests" / "packages" / "naosprint-sac"
EPISODES = 1000
OTHER_ROBOTS = ("t1", "k1")
CURVE_EPISODES = {"nao": 200, "booster": 50}
"""Episodes behind each point of a curve of evaluations, by robot family."""

MEASURE_S = 20.0
"""Seconds that each throughput is measured."""


CHAIN: tuple[dict[str, Any], ...] = (
    {"total_steps": LONG_STEPS},
    # four times as many samples an update, and the spread held
    {
        "total_steps": 45_000_000,
        "gamma": 0.99,
        "n_steps": 256,
        "batch_size": 4096,
        "start_episode_fraction": 0.125,
        "initial_log_std": -2.0,
        "final_log_std": -2.0,
        "log_std_steps": None,
        "ema_decay": 0.95,
    },
    # a last part with small updates
    {
        "total_steps": 15_000_000,
        "gamma": 0.99,
        "n_steps": 256,
        "batch_size": 8192,
        "target_kl": 0.02,
        "target_kl_final": 0.01,
        "initial_log_std": -2.0,
        "final_log_std": -2.3,
        "log_std_steps": None,
        "ema_decay": 0.95,
    },
)
"""The recipe that seeds follow: what each stage sets other than preset ``fast``; it starts from the one before."""

ONE_CORE: dict[str, Any] = {"simulator_threads": 1, "learner_threads": 1}

OTHERS = ("flight_share", "run_challenge_score")
"""Results that are recorded besides the headline."""


def spec_of(**settings: Any) -> TrainingSpec:
    """Return a specification with settings by their short names."""
    return TrainingSpec.model_validate(nest(settings))


DEFAULT = spec_of()
TASK = tasks.get(DEFAULT.task.name)
METRICS = {metric.name: metric for metric in columns(DEFAULT)}


class Log:
    """Reporter that appends metrics to a file, as the command line does, and prints some of them."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / "metrics.jsonl"
        self._shown = 0.0

    def metrics(self, row: dict[str, float]) -> None:
        """Keep a row."""
        with self._path.open("a") as stream:
            stream.write(json.dumps(row, allow_nan=False) + "\n")
        if time.monotonic() - self._shown > 30.0:
            self._shown = time.monotonic()
            parts = [
                f"{row['step'] / 1e6:.2f}M steps",
                *listed_text(DEFAULT, row),
                f"{row['steps_per_s']:,.0f} steps/s",
            ]
            print(f"  {', '.join(parts)}")

    def checkpoint(self, path: Path, step: int) -> None:
        """Ignore it: the directory shows it."""

    def log(self, level: str, message: str) -> None:
        """Show a line."""
        print(f"  {level}: {message}")


class _Rows(Log):
    """Reporter that keeps metrics in memory."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.rows: list[dict[str, float]] = []

    def metrics(self, row: dict[str, float]) -> None:
        """Keep a row."""
        self.rows.append(row)


def trained(workdir: Path, name: str, spec: TrainingSpec, initial_policy: Path | None = None) -> Path:
    """Return the folder of a finished training, which is begun or continued as needed."""
    folder = workdir / name
    checkpoints = sorted(folder.glob("step-*"))
    latest = checkpoints[-1] if checkpoints else None
    if latest is None or read_manifest(latest).steps < spec.planned_steps:
        print(f"{name}: training to {spec.total_steps:,} steps")
        first = initial_policy if latest is None else None
        train(spec, workdir=folder, reporter=Log(folder), resume=latest, initial_policy=first)
    return folder


def evaluated(checkpoint: Path, episodes: int) -> dict[str, Any]:
    """Return the evaluation of a checkpoint, which is run once and kept beside it."""
    folder = checkpoint.parent / f"evaluation-{checkpoint.name}-{episodes}"
    if not (folder / "evaluation.json").exists():
        began = time.perf_counter()
        evaluation = evaluate(checkpoint, EvaluationSpec(episodes=episodes, seed=1000))
        evaluation.save(folder)
        print(f"  {checkpoint.name}: {episodes} episodes in {time.perf_counter() - began:.1f} s")
    summary: dict[str, Any] = json.loads((folder / "evaluation.json").read_text(encoding="utf-8"))
    return summary


def digest(folder: Path, spec: TrainingSpec, *, steps: int) -> dict[str, Any]:
    """Return a training's record: settings, time, final results, and results along the way."""
    rows = [row for row in read_metrics(folder / "metrics.jsonl") if row["step"] <= steps + spec.rollout_steps]
    curve = []
    for checkpoint in sorted(folder.glob("step-*")):
        at = read_manifest(checkpoint).steps
        if 0 < at < steps:
            episodes = CURVE_EPISODES[spec.family]
            curve.append({"step": at, **_short(evaluated(checkpoint, episodes))})
    final_checkpoint = max(
        (path for path in folder.glob("step-*") if read_manifest(path).steps <= steps + spec.rollout_steps),
        key=lambda path: read_manifest(path).steps,
    )
    began = time.perf_counter()
    summary = evaluated(final_checkpoint, EPISODES)
    evaluation_s = time.perf_counter() - began
    final = {"step": read_manifest(final_checkpoint).steps, **_short(summary)}
    return {
        "preset": spec.algorithm.preset,
        "seed": spec.seed,
        "overrides": spec.overrides(),
        "training_s": rows[-1]["time_s"],
        "steps_per_s": rows[-1]["step"] / rows[-1]["time_s"],
        "evaluation_s": round(evaluation_s, 1) if evaluation_s > 1.0 else None,
        "final": final,
        "curve": [*curve, final],
        "training_curve": _thinned(rows),
    }


def _short(summary: dict[str, Any]) -> dict[str, Any]:
    """Return the most important results of an evaluation by name, with the intervals of rates."""
    results = by_name(summary)
    chosen = [results[name] for name in (*summary["headline"], *OTHERS) if name in results]
    return {
        "episodes": summary["episodes"],
        **{result["name"]: result["value"] for result in chosen},
        **{f"{result['name']}_ci": result["interval"] for result in chosen if result["kind"] == "rate"},
    }


def _thinned(rows: Sequence[dict[str, float]], points: int = 200) -> dict[str, list[float]]:
    all_names = ("step", "time_s", *TASK.presentation.listed, "episode_length", "approx_kl", "action_std")
    names = [name for name in all_names if name in rows[-1]]
    kept = [row for row in rows if all(name in row for name in names)]
    parts = np.array_split(np.arange(len(kept)), min(points, len(kept)))
    return {name: [float(np.mean([kept[i][name] for i in part])) for part in parts] for name in names}


def seeds(robot: str | None = None) -> Callable[[Path], dict[str, Any]]:
    """Return a section that trains preset fast with every seed and averages, for the default robot or another."""

    def section(workdir: Path) -> dict[str, Any]:
        runs = []
        for seed in SEEDS:
            spec = spec_of(seed=seed, total_steps=STEPS, **ONE_CORE, **({"robot": robot} if robot else {}))
            name = f"fast-{robot}-{seed}" if robot else f"fast-{seed}"
            runs.append(digest(trained(workdir, name, spec), spec, steps=STEPS))
        names = TASK.presentation.headline
        mean = {name: float(np.mean([run["final"][name] for run in runs])) for name in names}
        mean["training_s"] = float(np.mean([run["training_s"] for run in runs]))
        return {"mean": mean, "runs": runs}

    return section


def sac(workdir: Path) -> dict[str, Any]:
    """Train with the algorithm of another package, stable-baselines3's SAC in tests/packages."""
    if "sac" not in plugins.names(plugins.LEARNERS):
        # installed beside the environment, where only this measurement finds it
        folder = workdir / "packages"
        pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--upgrade"]
        subprocess.run([*pip, "--target", str(folder), str(SAC_PACKAGE)], check=True)
        command = [sys.executable, __file__, str(workdir), "--only", "sac", "--output", str(folder)]
        subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": str(folder)})
        found: dict[str, Any] = json.loads((folder / "results.json").read_text(encoding="utf-8"))["sac"]
        return {name: value for name, value in found.items() if name != "measured"}
    chosen = {
        "n_envs": 32,
        "n_steps": 8,
        "units": 128,
        "gradient_steps": 32,
        "buffer_steps": 300_000,
        "reward_scale": 10.0,
        "fall_penalty_m": 0.5,
        "ground_velocity": True,
        "checkpoint_interval_steps": SAC_STEPS // 5,
    }
    spec = spec_of(algorithm="sac", total_steps=SAC_STEPS, **chosen, **ONE_CORE)
    return digest(trained(workdir, "sac", spec), spec, steps=SAC_STEPS)


def long(workdir: Path) -> dict[str, Any]:
    """Continue the first seed to fifty million steps."""
    trained(workdir, "fast-0", spec_of(seed=0, total_steps=STEPS, **ONE_CORE))
    spec = spec_of(seed=0, total_steps=LONG_STEPS, checkpoint_interval_steps=5_000_000, **ONE_CORE)
    folder = workdir / "fast-0-long"
    if not folder.exists():
        # a resumed training equals one that never stopped, so the first part need not be repeated
        subprocess.run(["cp", "-r", str(workdir / "fast-0"), str(folder)], check=True)
        for left_over in folder.glob("evaluation-*"):
            subprocess.run(["rm", "-r", str(left_over)], check=True)
    return digest(trained(workdir, "fast-0-long", spec), spec, steps=LONG_STEPS)


def chain(seed: int) -> Callable[[Path], dict[str, Any]]:
    """Return a section that trains a seed through all stages of the chain."""

    def section(workdir: Path) -> dict[str, Any]:
        stages: list[dict[str, Any]] = []
        latest: Path | None = None
        for number, settings in enumerate(CHAIN):
            spec = spec_of(seed=seed, checkpoint_interval_steps=5_000_000, **settings, **ONE_CORE)
            name = f"chain-{seed}-{number + 1}" if number else f"fast-{seed}-long"
            folder = trained(workdir, name, spec, latest)
            latest = max(folder.glob("step-*"), key=lambda path: read_manifest(path).steps)
            stages.append(digest(folder, spec, steps=spec.planned_steps))
        return {"seed": seed, "final": stages[-1]["final"], "stages": stages}

    return section


def paper(workdir: Path) -> dict[str, Any]:
    """Train the paper's settings for as many steps."""
    spec = spec_of(preset="paper", total_steps=STEPS, **ONE_CORE)
    return digest(trained(workdir, "paper-0", spec), spec, steps=STEPS)


def random_policy(workdir: Path) -> dict[str, Any]:
    """Draw every action uniformly, for as many episodes as policies are evaluated by."""
    del workdir
    environment, n_starts = open_training_environment(spec_of(start_episode_fraction=0.0))
    rng = np.random.default_rng(0)
    n, task = environment.n, environment.task
    environment.restart(np.arange(n), np.arange(n) % n_starts)
    measured: list[np.ndarray] = []
    while len(measured) < EPISODES:
        environment.step(rng.uniform(-1.0, 1.0, (n, environment.actuation.n_actions)))
        ended = np.flatnonzero(environment.terminated | environment.truncated)
        started = n + len(measured)
        measured += list(task.measure(ended))
        environment.restart(ended, (started + np.arange(len(ended))) % n_starts)
    environment.close()
    names = [metric.name for metric in task.metrics if metric.live]
    return {"episodes": len(measured), **dict(zip(names, np.mean(measured, axis=0).tolist(), strict=True))}


def throughput(workdir: Path) -> dict[str, Any]:
    """Measure the NAO's engine alone, the environments, the learner alone, and the whole loop of preset fast.

    Those of T1 and K1 are measured by throughput.py.
    """
    spec = spec_of(total_steps=10_000_000_000)
    set_learner_threads(spec.runtime.learner_threads)
    environment, n_starts = open_training_environment(spec)
    env = TrainingEnvironment.from_spec(spec, environment, n_starts)
    ppo = PPO(spec, env)
    ppo.begin()
    ppo.collect()
    rng = np.random.default_rng(0)
    actions = 0.2 * rng.standard_normal((64, env.n, env.n_actions))
    targets = [environment.actuation.targets(a) for a in actions]
    simulator, turn = environment.simulator, iter(range(1 << 62))

    def engine() -> int:
        simulator.step(targets[next(turn) % len(targets)])
        return env.n

    def environments() -> int:
        drawn = actions[next(turn) % len(actions)]
        for group in env.groups:
            env.step_wait(group)
            env.step_async(drawn[group], group)
        return env.n

    def learner() -> int:
        # with a learning rate of 0, so that the divergence that ends an update early does not grow
        ppo.rate_factor = 0.0
        ppo.update()
        return spec.rollout_steps

    env.reset()
    for group in env.groups:
        env.step_async(actions[0][group], group)
    found = {"environments": _rate(environments)}
    for group in env.groups:
        env.step_wait(group)
    found["learner"] = _rate(learner)
    env.reset()
    # robots that lie on the ground cost more than running ones: they are restarted now and then
    found["engine"] = _rate(engine, every=100, then=lambda: env.reset())
    environment.close()
    folder = workdir / ("throughput-" + spec.robot.name)
    log = _Rows(folder)
    limit = time.monotonic() + MEASURE_S + 5.0
    train(spec, workdir=folder, reporter=log, stop=lambda: time.monotonic() > limit)
    late = [row for row in log.rows if row["time_s"] > 5.0]
    span = late[-1]["time_s"] - late[0]["time_s"]
    found["whole_loop"] = (late[-1]["step"] - late[0]["step"]) / span
    found["collect_share"] = float(np.mean([row["collect_s"] / (row["collect_s"] + row["learn_s"]) for row in late]))
    bound = 1.0 / (1.0 / found["engine"] + 1.0 / found["learner"])
    found["bound_of_engine_and_learner"] = bound
    found["whole_loop_of_bound"] = found["whole_loop"] / bound
    return found


def threads(workdir: Path) -> dict[str, Any]:
    """Measure rollouts that one thread collects and that two collect, actor included, in turns."""
    del workdir
    learners = {}
    for count in (1, 2):
        spec = spec_of(total_steps=10_000_000_000, simulator_threads=count, learner_threads=1)
        set_learner_threads(1)
        environment, n_starts = open_training_environment(spec)
        env = TrainingEnvironment.from_spec(spec, environment, n_starts)
        learners[count] = PPO(spec, env)
        learners[count].begin()

    def collected(count: int) -> int:
        learners[count].collect()
        return learners[count].spec.rollout_steps

    rounds = [
        {str(count): _rate(partial(collected, count), seconds=MEASURE_S / 4) for count in learners} for _ in range(4)
    ]
    for learner in learners.values():
        learner.environment.close()
    return {"steps_per_s": rounds, "ratios": [found["2"] / found["1"] for found in rounds]}


def _rate(
    work: Callable[[], int], *, every: int = 0, then: Callable[[], object] = lambda: None, seconds: float = MEASURE_S
) -> float:
    """Return units of work per second of ``work``, not counting what is done after each ``every`` calls."""
    work()
    done, spent, calls = 0, 0.0, 0
    while spent < seconds:
        began = time.perf_counter()
        done += work()
        spent += time.perf_counter() - began
        calls += 1
        if every and calls % every == 0:
            then()
    return done / spent


SECTIONS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "throughput": throughput,
    "threads": threads,
    "random": random_policy,
    "seeds": seeds(),
    **{f"seeds-{robot}": seeds(robot) for robot in OTHER_ROBOTS},
    "paper": paper,
    "sac": sac,
    "long": long,
    **{f"chain-{seed}": chain(seed) for seed in SEEDS},
}


def machine() -> dict[str, Any]:
    """Return a description of the machine."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    model = next(
        (line.split(":")[1].strip() for line in lines if "model name" in line),
        platform.processor(),
    )
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("torch", "stable-baselines3", "numpy", "naosim", "naosprint")},
    }


def require_writable(output: Path) -> None:
    """Make a folder, and write there before anything is measured for it. Raises OSError."""
    output.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=output).close()


def plots(results: dict[str, Any], output: Path) -> None:
    """Plot the curves in results.json."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    palette = ("#1b8a6b", "#2c6fbb", "#8a6fb8")
    references = TASK.presentation.references
    top, mean = TASK.presentation.headline[:2]
    with mpl.rc_context(figures.style()):
        if "seeds" in results:
            lines = [(f"fast, seed {run['seed']}", run, palette[i]) for i, run in enumerate(results["seeds"]["runs"])]
            if "paper" in results:
                lines.append(("paper, seed 0", results["paper"], "#555c65"))
            _curves(lines, output / "learning.png")
        if "sac" in results:
            _curves([("sac, seed 0", results["sac"], palette[1])], output / "sac.png")
        if "long" in results:
            run = results["long"]
            figure = Figure(figsize=(9.0, 4.0), layout="constrained")
            axes = figure.subplots()
            marks = [(point["step"] / 1e6, point[mean]) for point in run["curve"]]
            axes.plot(*zip(*marks, strict=True), "o-", ms=3.5, lw=1.5, color=palette[0], label="mean, start included")
            marks = [(p["step"] / 1e6, p[top]) for p in run["curve"] if p[top] is not None]
            axes.plot(
                *zip(*marks, strict=True), "^-", ms=3.5, lw=1.2, color=palette[1], label="top, the paper's measure"
            )
            figures.draw_references(axes, METRICS[mean], references)
            axes.set_ylim(0.0, 4.4)
            axes.set_ylabel("speed, m/s")
            axes.set_xlabel("environment steps, millions")
            axes.legend(loc="lower right", fontsize=8.5)
            figure.savefig(output / "long.png", dpi=130)


def _curves(runs: Sequence[tuple[str, dict[str, Any], str]], path: Path) -> None:
    """Plot what lists of jobs show of some trainings, each with label and color, and evaluations on the way."""
    from matplotlib.figure import Figure

    listed = TASK.presentation.listed
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    panels = figure.subplots(len(listed), 1, sharex=True)
    for label, run, colour in runs:
        for axes, metric in zip(panels, listed, strict=True):
            scale = figures.factor(METRICS[metric])
            curve = run["training_curve"]
            at = np.array(curve["step"]) / 1e6
            axes.plot(at, scale * np.array(curve[metric]), color=colour, lw=0.9, alpha=0.45)
            marks = [(point["step"] / 1e6, scale * point[metric]) for point in run["curve"]]
            axes.plot(*zip(*marks, strict=True), "o-", ms=3.5, lw=1.5, color=colour, label=label)
    for axes, metric in zip(panels, listed, strict=True):
        axes.set_ylabel(f"{METRICS[metric].title.lower()}, {METRICS[metric].unit}")
        axes.set_ylim(0.0, None)
    panels[0].legend(loc="lower right", fontsize=8.5)
    panels[0].set_title("points: the deterministic policy; thin lines: training, exploring", fontsize=8.5)
    panels[-1].set_xlabel("environment steps, millions")
    figure.savefig(path, dpi=130)


def main() -> int:
    """Run sections and write their results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workdir", type=Path, help="directory for trainings; may be deleted afterwards")
    parser.add_argument("--only", nargs="+", choices=[*SECTIONS, "plots"], help="some sections instead of all")
    parser.add_argument("-o", "--output", type=Path, help="folder for results.json and plots")
    options = parser.parse_args()
    output = options.output or (TRIALS if options.only else HERE)
    require_writable(output)
    stored = output / "results.json"
    results: dict[str, Any] = json.loads(stored.read_text(encoding="utf-8")) if stored.exists() else {}
    for name in options.only or [*SECTIONS, "plots"]:
        if name == "plots":
            plots(results, output)
            continue
        print(name)
        results[name] = {
            **SECTIONS[name](options.workdir),
            "measured": {"on": datetime.now(UTC).date().isoformat(), **machine()},
        }
        # another section may have been measured meanwhile
        latest = json.loads(stored.read_text(encoding="utf-8")) if stored.exists() else {}
        results = {**latest, name: results[name]}
        write_whole(stored, json_text(results))
    return 0


if __name__ == "__main__":
    run_program(main)
