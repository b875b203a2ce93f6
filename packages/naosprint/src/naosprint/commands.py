"""What the commands of the command line do."""

from __future__ import annotations

import argparse
import errno
import os
import signal
import subprocess
import sys
import tempfile
import threading
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import naopolicies
from naosim.simulator import STEP_S
from naospec import EvaluationSpec, TrainingSpec, recipes
from naospec.files import drop, replacing, together, write_whole
from naospec.flags import flag_name, parse_flags
from naospec.flat import nest
from naospec.job_files import JOB_FIELDS, load_job_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from naosprint.rl.reporter import Reporter

EXIT_FAILURE = 1


def _usable(output: Path | None, *, folder: bool) -> None:
    """Make the folder of an output, and write there before anything is computed for it. Raises OSError."""
    if output is not None and (folder or not _is_special(output)):
        place = output if folder else output.parent
        place.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=place).close()


def _is_special(output: Path) -> bool:
    """Return whether a file is a device, pipe or link, whose name stays. Raises IsADirectoryError."""
    if output.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(output))
    return output.is_symlink() or (output.exists() and not output.is_file())


def stop_on_signals() -> threading.Event:
    """Return an event that Ctrl-C and SIGTERM set; a second one ends the process at once."""
    stop = threading.Event()

    def ask(number: int, frame: object) -> None:
        del frame
        stop.set()
        signal.signal(number, signal.SIG_DFL)

    signal.signal(signal.SIGINT, ask)
    signal.signal(signal.SIGTERM, ask)
    return stop


def _warn(sentence: str) -> None:
    sys.stderr.write(f"warning: {sentence}\n")


@contextmanager
def _progress(text: str, total: float | None = None) -> Iterator[Callable[..., None]]:
    """Show the progress of what takes long; the context is called with what of it has changed."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(transient=True, console=console, disable=not console.is_terminal) as progress:
        yield partial(progress.update, progress.add_task(text, total=total))


def _job_of(path: Path) -> dict[str, Any]:
    """Return the content of a job file that can be trained without the service. Raises ValueError."""
    job = load_job_file(path)
    for field in job:
        if field not in JOB_FIELDS:
            raise ValueError(f"{path}: {field}: no such field of a job; write settings of the training below `spec:`")
    if job.get("parent_job_id") is not None:
        raise ValueError(f"{path}: parent_job_id: jobs are at the service; download its checkpoint, use --from-policy")
    return job


def train(options: argparse.Namespace) -> int:
    """Train a policy; Ctrl-C saves a checkpoint and ends the training."""
    given: Mapping[str, Any] = options.given
    base: Mapping[str, Any] = {}
    policy = options.from_policy
    if options.recipe is not None or options.spec is not None:
        job = recipes.job(options.recipe, policy) if options.spec is None else _job_of(options.spec)
        base = job.get("spec") or {}
        if options.recipe is not None and policy is not None and (note := recipes.shortened(options.recipe, policy)):
            sys.stderr.write(f"{note}\n")
        policy = policy or job.get("parent_policy")
    if options.resume is not None:
        from naosprint.rl.checkpoint import read_manifest

        if str(options.resume) in naopolicies.names() and not options.resume.is_dir():
            raise ValueError(
                f"--resume: {options.resume} is a bundled policy, no training; start from it: --from-policy"
            )
        resumed = read_manifest(options.resume).spec.model_dump(mode="json")
        fixed = {name: resumed[name]["name"] for name in ("robot", "task", "algorithm") if name in given}
        if differing := [name for name, value in fixed.items() if given[name] != value]:
            flag, value = flag_name(differing[0]), fixed[differing[0]]
            raise ValueError(f"{flag}: a training that is resumed keeps {value}; start another one: --from-policy")
        base, policy = base or resumed, None  # it has begun: the policy that it started from is behind it
    given = parse_flags(options.settings, given, base=base)
    spec = TrainingSpec.model_validate(nest(given, base))
    for sentence in spec.without_effect():
        _warn(sentence)
    initial_policy = None if policy is None else naopolicies.resolve(policy)
    if options.resume is None:
        _require_own_folder(options.workdir, spec)
    stop = stop_on_signals()

    from naosprint.console import ConsoleReporter
    from naosprint.rl import runner
    from naosprint.rl.processes import ProcessLostError, connected
    from naosprint.rl.reporter import NullReporter

    with ExitStack() as stack:
        reporter: Reporter = NullReporter()
        try:
            processes = stack.enter_context(connected(spec))
            if processes.rank == 0:
                reporter = stack.enter_context(ConsoleReporter(options.workdir, spec))
            result = runner.train(
                spec,
                workdir=options.workdir,
                reporter=reporter,
                resume=options.resume,
                initial_policy=initial_policy,
                stop=stop.is_set,
                processes=processes,
            )
        except (runner.TrainingDivergedError, ProcessLostError) as error:
            reporter.log("error", str(error))
            return EXIT_FAILURE
    if processes.rank == 0:
        sys.stdout.write(f"{result.status} {result.steps} {result.checkpoint}\n")
    return 0


def _require_own_folder(workdir: Path, spec: TrainingSpec) -> None:
    """Refuse a folder with checkpoints of a training; metrics and checkpoints of both would mix."""
    from naosprint.rl.checkpoint import read_manifest

    for folder in sorted(workdir.glob("step-*"))[-1:]:
        manifest = read_manifest(folder)
        if manifest.spec.digest() != spec.digest():
            raise ValueError(
                f"{workdir}: has checkpoints of another specification ({folder.name}); use another folder, or continue "
                f"that training: --resume {folder}"
            )
        if manifest.steps > 0:
            raise ValueError(
                f"{workdir}: has checkpoints of this training already; continue it with --resume {folder}, or use "
                "another folder"
            )


def evaluate(options: argparse.Namespace) -> int:
    """Run episodes with a policy and print the results."""
    spec = EvaluationSpec.model_validate(parse_flags(options.settings, options.given))
    checkpoint = naopolicies.resolve(options.checkpoint)
    _usable(options.output, folder=True)

    from rich.console import Console

    from naosprint.analysis.evaluation import evaluate as evaluated
    from naosprint.analysis.results import summary_table

    with _progress("episodes", spec.episodes) as show:
        evaluation = evaluated(
            checkpoint,
            spec,
            threads=options.threads,
            progress=lambda done, total: show(completed=done, total=total),
        )
    if options.output is not None:
        evaluation.save(options.output)
    for warning in evaluation.warnings:
        _warn(warning)
    if options.json:
        sys.stdout.write(evaluation.to_json())
    else:
        Console(highlight=False).print(summary_table(evaluation.summary))
    return 0


def examine(options: argparse.Namespace) -> int:
    """Print how robust a policy is."""
    if not 1 <= options.episodes <= 100_000:
        raise ValueError("--episodes: must be between 1 and 100,000")
    if not 0.0 <= options.most_failures < 1.0:
        raise ValueError("--most-failures: must be at least 0 and less than 1, for example 0.05")
    checkpoint = naopolicies.resolve(options.checkpoint)
    _usable(options.output, folder=True)

    from rich.console import Console

    from naosprint.analysis import examination

    with _progress("examining") as show:
        found = examination.examine(
            checkpoint,
            episodes=options.episodes,
            most_failures=options.most_failures,
            names=options.only.split(",") if options.only else (),
            threads=options.threads,
            tell=lambda text: show(description=text),
        )
    console = Console()
    tables = list(examination.tables(found.to_dict()))
    if not tables:
        raise ValueError(f"--only: {options.only}: cannot be examined in the simulator of this policy")
    for table in tables:
        console.print(table)
    if options.output is not None:
        from matplotlib import rc_context
        from naospec.json_text import json_text

        from naosprint.analysis import figures

        with together():
            write_whole(options.output / "examination.json", json_text(found.to_dict()))
            if found.ranges:
                with rc_context(figures.style()), replacing(options.output / "robustness.svg") as file:
                    figures.robustness(found.ranges, found.most_failures).savefig(file, format="svg")
            else:
                drop(options.output / "robustness.svg")
    return 0


def handover(options: argparse.Namespace) -> int:
    """Print from which skills others can be entered."""
    if not 1 <= options.transitions <= 100_000:
        raise ValueError("--transitions: must be between 1 and 100,000")
    chosen = dict(each.split("=", 1) for each in options.policy if "=" in each)
    if len(chosen) < len(options.policy):
        raise ValueError(f"--policy: {options.policy[-1]!r}: write a task and a policy, for example kick=t1-kick")
    _usable(options.output, folder=False)

    from naospec.json_text import json_text
    from rich.console import Console
    from rich.table import Table

    from naosprint.analysis import transitions

    members = transitions.skills(options.robot, chosen)
    if options.only is not None:
        names = options.only.split(",")
        unknown = sorted(set(names) - {member.name for member in members})
        if unknown:
            known = ", ".join(member.name for member in members)
            raise ValueError(f"--only: {', '.join(unknown)}: unknown; choose among {known}")
        members = tuple(member for member in members if member.name in names)
    with _progress("recording") as show:
        cells = list(
            transitions.matrix(
                members,
                count=options.transitions,
                seed=options.seed,
                engine=options.engine,
                threads=options.threads,
                tell=lambda text: show(description=text),
            )
        )
    if not cells:
        raise ValueError(f"--only: {options.only}: no transition between these; name a skill that walks, too")
    header, lines = transitions.table(cells)
    table = Table(*header, box=None, pad_edge=False, header_style="bold", title="Upright and on command, %")
    for line in lines:
        table.add_row(*line)
    Console().print(table)
    if options.output is not None:
        found = transitions.to_dict(cells, members, options.engine, options.seed)
        if _is_special(options.output):
            options.output.write_text(json_text(found), encoding="utf-8")  # such as /dev/stdout
        else:
            write_whole(options.output, json_text(found))
    return 0


def verify(options: argparse.Namespace) -> int:
    """Train again from a checkpoint to a later one of the same training. Exits with 1 if a bit differs."""
    from naosprint.rl.checkpoint import read_manifest
    from naosprint.rl.verification import last_two
    from naosprint.rl.verification import verify as verified
    from naosprint.threads import COMMON_KERNELS

    if str(options.earlier) in naopolicies.names() and not COMMON_KERNELS.items() <= os.environ.items():
        # libraries read these when they are loaded
        named = [str(path) for path in (options.earlier, options.later) if path is not None]
        command = [sys.executable, "-P", "-m", "naosprint", "verify", *named]
        return subprocess.run(command, env={**os.environ, **COMMON_KERNELS}, check=False).returncode
    folder = naopolicies.resolve(options.earlier)
    earlier, later = (folder, options.later) if options.later else last_two(folder)
    first, last = read_manifest(earlier).steps, read_manifest(later).steps
    with _progress("training again", last - first) as show:
        found = verified(earlier, later, lambda step: show(completed=step - first))
    for line in found.versions:
        _warn(f"another version: {line}")
    for file, count in found.arrays.items():
        differing = [name.removeprefix(f"{file}: ") for name in found.differing if name.startswith(f"{file}: ")]
        outcome = f"DIFFERENT: {', '.join(differing)}" if differing else "same bits"
        sys.stdout.write(f"{file:16} {count:3} arrays  {outcome}\n")
    verdict = "is not what" if found.differing else "is exactly what"
    sys.stdout.write(f"{later} {verdict} {last - first:,} steps from {earlier} give\n")
    return 1 if found.differing else 0


def report(options: argparse.Namespace) -> int:
    """Write a self-contained page, plots, tables and a film of an evaluated policy."""
    from naosprint.analysis.report import write_report

    page = write_report(
        options.output,
        evaluation=options.evaluation,
        metrics=options.metrics,
        # what a locale cannot decode arrives as surrogates, which no file can hold
        title=options.title and os.fsencode(options.title).decode("utf-8", "replace"),
        film=not options.no_film,
    )
    sys.stdout.write(f"{page}\n")
    return 0


def export(options: argparse.Namespace) -> int:
    """Write policy.json, and policy.npz, policy.onnx, policy.h or a skill for team code."""
    from naosprint.export import export_policy

    checkpoint = naopolicies.resolve(options.checkpoint)
    for path in export_policy(checkpoint, options.output, options.format, options.name, warn=_warn):
        sys.stdout.write(f"{path}\n")
    return 0


def replay(options: argparse.Namespace) -> int:
    """Run one episode; write replay.json, replay.npz and the film replay.mp4."""
    given = parse_flags(options.settings, options.given)
    spec = EvaluationSpec.model_validate({**given, "episodes": 1})
    checkpoint = naopolicies.resolve(options.checkpoint)
    _usable(options.output, folder=True)

    from naosprint.analysis.evaluation import evaluate as evaluated
    from naosprint.analysis.film import write_mp4

    recorded = evaluated(checkpoint, spec).replay
    with together():
        written = [*recorded.save(options.output)]
        if options.no_film:
            drop(options.output / "replay.mp4")
        else:
            written.append(options.output / "replay.mp4")
            count = len(recorded.positions)
            if options.film_seconds is not None:
                count = min(count, max(1, round(options.film_seconds / STEP_S)))
            write_mp4(recorded, written[-1], frames=range(count))
    for path in written:
        sys.stdout.write(f"{path}\n")
    end = (recorded.end or "time limit").lower()
    sys.stderr.write(f"{recorded.moved_m():.2f} m from the start in {recorded.duration_s:.2f} s, {end}\n")
    return 0


def policies(options: argparse.Namespace) -> int:
    """List bundled policies."""
    del options
    width = max(map(len, naopolicies.names()), default=0)
    for name in naopolicies.names():
        sys.stdout.write(f"{name:{width}} {naopolicies.card(name)['summary']}\n")
    return 0
