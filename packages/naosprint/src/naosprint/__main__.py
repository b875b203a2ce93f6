"""The command line for use without the service: ``python -m naosprint --help``."""

from __future__ import annotations

import argparse
import io
import math
import os
import signal
import subprocess
import sys
import threading
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import naopolicies
from naosim.simulator import STEP_S, ServerLostError
from naospec import EvaluationSpec, TrainingSpec, plugins, recipes
from naospec.files import named_errors, replacing, write_whole
from naospec.flags import ALIASES, FlagError, explain, flag_name, help_text, parse_flags, read_switches
from naospec.flat import nest, settings, settings_of
from naospec.job_files import JOB_FIELDS, load_job_file
from pydantic import ValidationError
from pydantic_core import PydanticUndefined

from naosprint.matches.commands import add_parsers
from naosprint.matches.game import MatchError
from naosprint.threads import quiet_openmp

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from naospec.flat import Setting
    from pydantic import BaseModel

    from naosprint.rl.reporter import Reporter

EXIT_USAGE = 2
EXIT_FAILURE = 1
MAX_THREADS, MAX_FILM_S = 256, 3600.0
"""Threads of the simulator, and seconds of a film, at most."""

_CHECKPOINT_HELP = "checkpoint directory, or the name of a bundled policy"
_REPLAY_FIELDS = {"task", "seed", "simulator", "start_noise_deg"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    quiet_openmp()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # what the terminal's character set has not
    options = argparse.Namespace(model=TrainingSpec, settings={}, spec=None)
    try:
        _parser().parse_args(arguments, options)
        run: Callable[[argparse.Namespace], int] = options.run
        # of what is written there, an error of a disk may not name the file
        written = getattr(options, "output", None) or getattr(options, "workdir", None) or Path.cwd()
        with _interruptible(), named_errors(written):
            return run(options)
    except KeyboardInterrupt as error:
        number = signal.Signals(error.args[0] if error.args else signal.SIGINT)
        sys.stderr.write(f"stopped by {number.name}; no unfinished file is left\n")
        return 128 + number
    except ValidationError as error:
        from_flags = {name: options.settings[name] for name in _given(options)}
        where = f"{options.spec}: spec." if options.spec else ""
        sys.stderr.writelines(f"{line}\n" for line in explain(options.model, error, from_flags, where=where))
        return EXIT_USAGE
    except FlagError as error:
        sys.stderr.write(f"{error}\n")
        return EXIT_USAGE
    except (OSError, ValueError, MatchError, ServerLostError, plugins.BrokenPluginError) as error:
        sys.stderr.write(f"error: {error}\n")
        return EXIT_FAILURE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="naosprint", description="Train, evaluate, replay and export policies.")
    commands = parser.add_subparsers(required=True, metavar="command", parser_class=_CommandParser)

    train = commands.add_parser(
        "train", help="train a policy", description="Train a policy; Ctrl-C saves a checkpoint and ends the training."
    )
    train.add_argument("workdir", type=Path, help="directory for checkpoints and metrics.jsonl")
    begin = train.add_mutually_exclusive_group()
    begin.add_argument("--recipe", choices=recipes.names(), help="start from this recipe's specification")
    begin.add_argument(
        "--spec",
        type=Path,
        metavar="FILE",
        help="start from this job file of `naoctl submit`; options override it",
    )
    train.add_argument("--resume", type=Path, metavar="CHECKPOINT", help="continue this training")
    train.add_argument(
        "--from-policy", metavar="CHECKPOINT", help="start from the weights of this checkpoint or bundled policy"
    )
    _add_settings(train, TrainingSpec, settings(), title="training")
    train.set_defaults(run=_train)

    evaluate = commands.add_parser(
        "evaluate", help="evaluate a policy", description="Run episodes with a policy and print the results."
    )
    evaluate.add_argument("checkpoint", help=_CHECKPOINT_HELP)
    evaluate.add_argument("--output", type=Path, help="directory for evaluation.json, trajectories.npz and replay.json")
    evaluate.add_argument(
        "--json", action="store_true", help="print everything as JSON, also what the table leaves out"
    )
    evaluate.add_argument("--threads", type=_threads, default=2, help="threads of the simulator (default: 2)")
    _add_settings(evaluate, EvaluationSpec, settings_of(EvaluationSpec), title="evaluation")
    evaluate.set_defaults(run=_evaluate)

    examine = commands.add_parser(
        "examine",
        help="find out how robust a policy is",
        description="Print peaks of motion, results under disturbances, and for each disturbance the range within "
        "which few enough episodes fail.",
    )
    examine.add_argument("checkpoint", help=_CHECKPOINT_HELP)
    examine.add_argument("--output", type=Path, help="directory for examination.json and robustness.svg")
    examine.add_argument("--episodes", type=int, default=100, help="episodes at each strength (default: 100)")
    examine.add_argument(
        "--most-failures", type=float, default=0.05, metavar="SHARE", help="share that may fail (default: 0.05)"
    )
    examine.add_argument("--only", metavar="NAMES", help="motion, conditions, or disturbances with commas between")
    examine.add_argument("--threads", type=_threads, default=2, help="threads of the simulator (default: 2)")
    examine.set_defaults(run=_examine)

    handover = commands.add_parser(
        "handover",
        help="find out from which skills others can be entered",
        description="Print for every two skills of a robot the percentage of transitions after which it is upright and "
        "does what is commanded.",
    )
    handover.add_argument("--robot", default="t1", help="robot (default: t1)")
    handover.add_argument(
        "--policy", action="append", default=[], metavar="TASK=NAME", help="bundled policy for a task; repeatable"
    )
    handover.add_argument("--only", metavar="SKILLS", help="skills to choose, with commas between")
    handover.add_argument("--transitions", type=int, default=200, help="transitions of each two (default: 200)")
    handover.add_argument("--seed", type=int, default=1, help="seed of states and commands (default: 1)")
    handover.add_argument("--engine", default="mujoco", choices=("fast", "mujoco"), help="engine (default: mujoco)")
    handover.add_argument("--output", type=Path, metavar="FILE", help="JSON file with intervals")
    handover.add_argument("--threads", type=_threads, default=2, help="threads of the simulator (default: 2)")
    handover.set_defaults(run=_handover)

    verify = commands.add_parser(
        "verify",
        help="train a segment again and compare it bit by bit",
        description="Train again from a checkpoint to a later one of the same training. Exits with 1 if a bit differs.",
    )
    verify.add_argument(
        "earlier", help="checkpoint; or the folder of a training, or a bundled policy that has two: the last two"
    )
    verify.add_argument("later", type=Path, nargs="?", help="later checkpoint of the same training")
    verify.set_defaults(run=_verify)

    report = commands.add_parser(
        "report",
        help="write a report on a policy",
        description="Write a self-contained page, plots, tables and a film of an evaluated policy.",
    )
    report.add_argument("evaluation", type=Path, help="directory that `evaluate --output` wrote")
    report.add_argument("output", type=Path, help="directory for report.html and the files beside it")
    report.add_argument("--metrics", type=Path, metavar="FILE", help="the training's metrics.jsonl, for its curves")
    report.add_argument("--title", help="title of the page (default: the task's name)")
    report.add_argument("--no-film", action="store_true", help="omit the film, which takes most of the time")
    report.set_defaults(run=_report)

    export = commands.add_parser(
        "export",
        help="export a policy",
        description="Write policy.json, and policy.npz, policy.onnx, policy.h or a skill for team code.",
    )
    export.add_argument("checkpoint", help=_CHECKPOINT_HELP)
    export.add_argument("output", type=Path, help="directory for the files")
    export.add_argument(
        "--format",
        action="append",
        choices=("numpy", "onnx", "c", "skill"),
        help="format of the policy; may be given repeatedly (default: all that are possible)",
    )
    export.add_argument(
        "--name",
        default="policy",
        help="name of the files, of all that the C header defines, and of the skill (default: policy)",
    )
    export.set_defaults(run=_export)

    replay = commands.add_parser(
        "replay",
        help="record and film an episode",
        description="Run one episode; write replay.json, replay.npz and the film replay.mp4.",
    )
    replay.add_argument("checkpoint", help=_CHECKPOINT_HELP)
    replay.add_argument("output", type=Path, help="directory for the files")
    replay.add_argument("--no-film", action="store_true", help="omit the film, which takes most of the time")
    replay.add_argument("--film-seconds", type=_seconds, metavar="S", help="film the first S seconds (default: all)")
    recorded = settings_of(EvaluationSpec, leave_out=EvaluationSpec.model_fields.keys() - _REPLAY_FIELDS)
    _add_settings(replay, EvaluationSpec, recorded, title="evaluation")
    replay.set_defaults(run=_replay)

    add_parsers(commands, lambda: _stop_on_signals().is_set)

    policies = commands.add_parser("policies", help="list the bundled policies", description="List bundled policies.")
    policies.set_defaults(run=_policies)
    return parser


# --- options and specifications -----------------------------------------------------------------------------------


class _CommandParser(argparse.ArgumentParser):
    """Parser of a command, whose switches may stand alone or be followed by true or false."""

    switches: Sequence[str] = ()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Read the command's arguments. Raises FlagError."""
        return super().parse_known_args(read_switches(args, self.switches, paired=False), namespace)


def _add_settings(parser: _CommandParser, model: type[BaseModel], known: Mapping[str, Setting], *, title: str) -> None:
    """Add an option for every setting of a specification, grouped by section; those without one are under the title."""
    groups: dict[str, Any] = {}
    for name, setting in known.items():
        heading = setting.path[0] if len(setting.path) == 2 else title
        if heading not in groups:
            groups[heading] = parser.add_argument_group(heading)
        text, default = help_text(setting), setting.info.default
        if default is not None and default is not PydanticUndefined:
            text += f" (default: {','.join(map(str, default)) if isinstance(default, tuple) else default})"
        flags, dest = (*ALIASES.get(name, ()), flag_name(name)), f"setting_{name}"
        groups[heading].add_argument(*flags, dest=dest, metavar="VALUE", help=text.replace("%", "%%"))
    parser.switches = [flag_name(name) for name, setting in known.items() if setting.info.annotation is bool]
    parser.set_defaults(model=model, settings=known)


def _given(options: argparse.Namespace) -> dict[str, Any]:
    """Return the settings that were given as options, by short name."""
    texts = {name: getattr(options, f"setting_{name}") for name in options.settings}
    return parse_flags(options.settings, {name: text for name, text in texts.items() if text is not None})


def _threads(text: str) -> int:
    """Return a number of threads. Raises argparse.ArgumentTypeError."""
    if not text.isdecimal() or not 1 <= int(text) <= MAX_THREADS:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a number of 1 to {MAX_THREADS}")
    return int(text)


def _seconds(text: str) -> float:
    """Return a length of time, s. Raises argparse.ArgumentTypeError."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.0 < seconds <= MAX_FILM_S:
        raise argparse.ArgumentTypeError(f"{text!r}: expected seconds, more than 0 and at most {MAX_FILM_S:,}")
    return seconds


def _usable(output: Path | None, *, folder: bool) -> None:
    """Make the folder of an output before anything is computed for it. Raises OSError."""
    if output is not None:
        (output if folder else output.parent).mkdir(parents=True, exist_ok=True)


@contextmanager
def _interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt at SIGTERM, too, so that what was begun is cleaned up; restore both handlers."""

    def interrupt(number: int, frame: object) -> None:
        del frame
        raise KeyboardInterrupt(number)

    if threading.current_thread() is not threading.main_thread():
        yield  # which alone receives signals
        return
    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _stop_on_signals() -> threading.Event:
    """Return an event that Ctrl-C and SIGTERM set; a second one ends the process at once."""
    stop = threading.Event()

    def ask(number: int, frame: object) -> None:
        del frame
        stop.set()
        signal.signal(number, signal.SIG_DFL)

    signal.signal(signal.SIGINT, ask)
    signal.signal(signal.SIGTERM, ask)
    return stop


# --- commands -----------------------------------------------------------------------------------------------------


def _job_of(path: Path) -> dict[str, Any]:
    """Return the content of a job file that can be trained without the service. Raises ValueError."""
    job = load_job_file(path)
    for field in job:
        if field not in JOB_FIELDS:
            raise ValueError(f"{path}: {field}: no such field of a job; write settings of the training below `spec:`")
    if job.get("parent_job_id") is not None:
        raise ValueError(f"{path}: parent_job_id: jobs are at the service; download its checkpoint, use --from-policy")
    return job


def _train(options: argparse.Namespace) -> int:
    given = _given(options)
    base: Mapping[str, Any] = {}
    policy = options.from_policy
    if options.recipe is not None or options.spec is not None:
        job = recipes.job(options.recipe) if options.spec is None else _job_of(options.spec)
        base = job.get("spec") or {}
        if options.resume is None:
            policy = policy or job.get("parent_policy")
    if options.resume is not None:
        from naosprint.rl.checkpoint import read_manifest

        if str(options.resume) in naopolicies.names() and not options.resume.is_dir():
            raise ValueError(
                f"--resume: {options.resume} is a bundled policy, no training; start from it: --from-policy"
            )
        base = read_manifest(options.resume).spec.model_dump(mode="json")
        fixed = {name: base[name]["name"] for name in ("robot", "task", "algorithm") if name in given}
        if differing := [name for name, value in fixed.items() if given[name] != value]:
            flag, value = flag_name(differing[0]), fixed[differing[0]]
            raise ValueError(f"{flag}: a training that is resumed keeps {value}; start another one: --from-policy")
    spec = TrainingSpec.model_validate(nest(given, base))
    for sentence in spec.without_effect():
        sys.stderr.write(f"warning: {sentence}\n")
    initial_policy = None if policy is None else naopolicies.resolve(policy)
    if options.resume is None:
        _require_own_folder(options.workdir, spec)
    stop = _stop_on_signals()

    from naosprint.console import ConsoleReporter
    from naosprint.rl.processes import ProcessLostError, connected
    from naosprint.rl.reporter import NullReporter
    from naosprint.rl.runner import TrainingDivergedError, train

    with ExitStack() as stack:
        reporter: Reporter = NullReporter()
        try:
            processes = stack.enter_context(connected(spec))
            if processes.rank == 0:
                reporter = stack.enter_context(ConsoleReporter(options.workdir, spec))
            result = train(
                spec,
                workdir=options.workdir,
                reporter=reporter,
                resume=options.resume,
                initial_policy=initial_policy,
                stop=stop.is_set,
                processes=processes,
            )
        except (TrainingDivergedError, ProcessLostError) as error:
            reporter.log("error", str(error))
            return EXIT_FAILURE
    if processes.rank == 0:
        sys.stdout.write(f"{result.status} {result.steps} {result.checkpoint}\n")
    return 0


def _require_own_folder(workdir: Path, spec: TrainingSpec) -> None:
    """Refuse a folder with checkpoints of another training; metrics and checkpoints of both would mix."""
    from naosprint.rl.checkpoint import read_manifest

    for folder in sorted(workdir.glob("step-*"))[-1:]:
        if read_manifest(folder).spec.digest() != spec.digest():
            raise ValueError(f"{workdir}: has checkpoints of another specification ({folder.name}); use another folder")


def _evaluate(options: argparse.Namespace) -> int:
    spec = EvaluationSpec.model_validate(_given(options))
    checkpoint = naopolicies.resolve(options.checkpoint)
    _usable(options.output, folder=True)

    from rich.console import Console
    from rich.progress import Progress

    from naosprint.analysis.evaluation import evaluate
    from naosprint.analysis.results import summary_table

    with Progress(transient=True, console=Console(stderr=True)) as progress:
        bar = progress.add_task("episodes", total=spec.episodes)
        evaluation = evaluate(
            checkpoint,
            spec,
            threads=options.threads,
            progress=lambda done, total: progress.update(bar, completed=done, total=total),
        )
    if options.output is not None:
        evaluation.save(options.output)
    for warning in evaluation.warnings:
        sys.stderr.write(f"warning: {warning}\n")
    if options.json:
        sys.stdout.write(evaluation.to_json())
    else:
        Console(highlight=False).print(summary_table(evaluation.summary))
    return 0


def _examine(options: argparse.Namespace) -> int:
    if not 1 <= options.episodes <= 100_000:
        raise ValueError("--episodes: must be between 1 and 100,000")
    if not 0.0 <= options.most_failures < 1.0:
        raise ValueError("--most-failures: must be at least 0 and less than 1, for example 0.05")
    checkpoint = naopolicies.resolve(options.checkpoint)
    _usable(options.output, folder=True)

    from rich.console import Console
    from rich.progress import Progress

    from naosprint.analysis.examination import examine, tables

    with Progress(transient=True, console=Console(stderr=True)) as progress:
        bar = progress.add_task("examining", total=None)
        found = examine(
            checkpoint,
            episodes=options.episodes,
            most_failures=options.most_failures,
            names=options.only.split(",") if options.only else (),
            threads=options.threads,
            tell=lambda text: progress.update(bar, description=text),
        )
    console = Console()
    for table in tables(found.to_dict()):
        console.print(table)
    if options.output is not None:
        from matplotlib import rc_context
        from naospec.json_text import json_text

        from naosprint.analysis import figures

        write_whole(options.output / "examination.json", json_text(found.to_dict()))
        if found.ranges:
            with rc_context(figures.style()), replacing(options.output / "robustness.svg") as file:
                figures.robustness(found.ranges, found.most_failures).savefig(file, format="svg")
    return 0


def _handover(options: argparse.Namespace) -> int:
    if not 1 <= options.transitions <= 100_000:
        raise ValueError("--transitions: must be between 1 and 100,000")
    chosen = dict(each.split("=", 1) for each in options.policy if "=" in each)
    if len(chosen) < len(options.policy):
        raise ValueError(f"--policy: {options.policy[-1]!r}: write a task and a policy, for example kick=t1-kick")
    _usable(options.output, folder=False)

    from naospec.json_text import json_text
    from rich.console import Console
    from rich.progress import Progress
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
    with Progress(transient=True, console=Console(stderr=True)) as progress:
        bar = progress.add_task("recording", total=None)
        cells = list(
            transitions.matrix(
                members,
                count=options.transitions,
                seed=options.seed,
                engine=options.engine,
                threads=options.threads,
                tell=lambda text: progress.update(bar, description=text),
            )
        )
    header, lines = transitions.table(cells)
    table = Table(*header, box=None, pad_edge=False, header_style="bold", title="Upright and on command, %")
    for line in lines:
        table.add_row(*line)
    Console().print(table)
    if options.output is not None:
        found = transitions.to_dict(cells, members, options.engine, options.seed)
        options.output.write_text(json_text(found), encoding="utf-8")
    return 0


def _verify(options: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.progress import Progress

    from naosprint.rl.checkpoint import read_manifest
    from naosprint.rl.verification import last_two, verify
    from naosprint.threads import COMMON_KERNELS

    if str(options.earlier) in naopolicies.names() and not COMMON_KERNELS.items() <= os.environ.items():
        # libraries read these when they are loaded
        named = [str(path) for path in (options.earlier, options.later) if path is not None]
        command = [sys.executable, "-P", "-m", "naosprint", "verify", *named]
        return subprocess.run(command, env={**os.environ, **COMMON_KERNELS}, check=False).returncode
    folder = naopolicies.resolve(options.earlier)
    earlier, later = (folder, options.later) if options.later else last_two(folder)
    first, last = read_manifest(earlier).steps, read_manifest(later).steps
    with Progress(transient=True, console=Console(stderr=True)) as progress:
        bar = progress.add_task("training again", total=last - first)
        found = verify(earlier, later, lambda step: progress.update(bar, completed=step - first))
    for line in found.versions:
        sys.stderr.write(f"warning: another version: {line}\n")
    for file, count in found.arrays.items():
        differing = [name.removeprefix(f"{file}: ") for name in found.differing if name.startswith(f"{file}: ")]
        outcome = f"DIFFERENT: {', '.join(differing)}" if differing else "same bits"
        sys.stdout.write(f"{file:16} {count:3} arrays  {outcome}\n")
    verdict = "is not what" if found.differing else "is exactly what"
    sys.stdout.write(f"{later} {verdict} {last - first:,} steps from {earlier} give\n")
    return 1 if found.differing else 0


def _report(options: argparse.Namespace) -> int:
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


def _warn(sentence: str) -> None:
    sys.stderr.write(f"warning: {sentence}\n")


def _export(options: argparse.Namespace) -> int:
    from naosprint.export import export_policy

    checkpoint = naopolicies.resolve(options.checkpoint)
    for path in export_policy(checkpoint, options.output, options.format, options.name, warn=_warn):
        sys.stdout.write(f"{path}\n")
    return 0


def _replay(options: argparse.Namespace) -> int:
    spec = EvaluationSpec.model_validate({**_given(options), "episodes": 1})
    checkpoint = naopolicies.resolve(options.checkpoint)
    _usable(options.output, folder=True)

    from naosprint.analysis.evaluation import evaluate
    from naosprint.analysis.film import write_mp4

    replay = evaluate(checkpoint, spec).replay
    written = [*replay.save(options.output)]
    if not options.no_film:
        written.append(options.output / "replay.mp4")
        count = len(replay.positions)
        if options.film_seconds is not None:
            count = min(count, max(1, round(options.film_seconds / STEP_S)))
        write_mp4(replay, written[-1], frames=range(count))
    for path in written:
        sys.stdout.write(f"{path}\n")
    end = (replay.end or "time limit").lower()
    sys.stderr.write(f"{replay.moved_m():.2f} m from the start in {replay.duration_s:.2f} s, {end}\n")
    return 0


def _policies(options: argparse.Namespace) -> int:
    del options
    for name in naopolicies.names():
        sys.stdout.write(f"{name:14} {naopolicies.card(name)['summary']}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
