"""The command line for people without the service: ``python -m naosprint --help``."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import naopolicies
from naosim.simulator import ServerLostError
from naospec import EvaluationSpec, TrainingSpec
from pydantic import ValidationError

from naosprint.threads import quiet_openmp

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pydantic import BaseModel

EXIT_USAGE = 2
EXIT_FAILURE = 1

_CHECKPOINT_HELP = "checkpoint directory, or the name of a shipped policy"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    quiet_openmp()
    options = _parser().parse_args(arguments)
    run: Callable[[argparse.Namespace], int] = options.run
    try:
        return run(options)
    except ValidationError as error:
        for problem in error.errors():
            name = "".join(f"--{part} ".replace("_", "-") for part in problem["loc"] if isinstance(part, str))
            sys.stderr.write(f"{name.strip() or 'error'}: {problem['msg'].removeprefix('Value error, ')}\n")
        return EXIT_USAGE
    except (OSError, ValueError, ServerLostError) as error:
        sys.stderr.write(f"error: {error}\n")
        return EXIT_FAILURE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="naosprint", description="Train, judge, show and export sprint policies.")
    commands = parser.add_subparsers(required=True, metavar="command")

    train = commands.add_parser("train", help="train a policy", description="Train a policy; Ctrl-C saves and ends.")
    train.add_argument("workdir", type=Path, help="directory for checkpoints and metrics.jsonl")
    train.add_argument("--resume", type=Path, metavar="CHECKPOINT", help="continue this training")
    train.add_argument(
        "--initial-policy", metavar="CHECKPOINT", help="start from the weights of this checkpoint or shipped policy"
    )
    _add_fields(train, TrainingSpec)
    train.set_defaults(run=_train)

    evaluate = commands.add_parser("evaluate", help="judge a policy", description="Run a policy and print its figures.")
    evaluate.add_argument("checkpoint", help=_CHECKPOINT_HELP)
    evaluate.add_argument("--output", type=Path, help="directory for evaluation.json, trajectories.npz and replay.json")
    evaluate.add_argument("--threads", type=int, default=2, help="threads of the simulator (default: 2)")
    _add_fields(evaluate, EvaluationSpec)
    evaluate.set_defaults(run=_evaluate)

    report = commands.add_parser(
        "report",
        help="write a page about a policy",
        description="Write a self-contained page, pictures, tables and a film about an evaluated policy.",
    )
    report.add_argument("evaluation", type=Path, help="directory that `evaluate --output` wrote")
    report.add_argument("output", type=Path, help="directory for report.html and what belongs to it")
    report.add_argument("--metrics", type=Path, metavar="FILE", help="the training's metrics.jsonl, for its curve")
    report.add_argument("--title", default="Sprint", help="headline (default: Sprint)")
    report.add_argument("--no-film", action="store_true", help="leave out the film, which takes most of the time")
    report.set_defaults(run=_report)

    export = commands.add_parser(
        "export",
        help="write a policy for use elsewhere",
        description="Write policy.onnx, policy.npz and policy.json.",
    )
    export.add_argument("checkpoint", help=_CHECKPOINT_HELP)
    export.add_argument("output", type=Path, help="directory for the files")
    export.set_defaults(run=_export)

    replay = commands.add_parser(
        "replay",
        help="let a policy run, and film it",
        description="Run one episode; write replay.json, replay.npz and the film replay.mp4.",
    )
    replay.add_argument("checkpoint", help=_CHECKPOINT_HELP)
    replay.add_argument("output", type=Path, help="directory for the files")
    replay.add_argument("--no-film", action="store_true", help="leave out the film, which takes most of the time")
    replay.add_argument("--film-seconds", type=float, metavar="S", help="film the first S seconds (default: all)")
    _add_fields(replay, EvaluationSpec, only=("task", "seed", "simulator", "start_noise_deg"))
    replay.set_defaults(run=_replay)

    policies = commands.add_parser("policies", help="list the shipped policies", description="List shipped policies.")
    policies.set_defaults(run=_policies)
    return parser


def _add_fields(parser: argparse.ArgumentParser, model: type[BaseModel], *, only: Sequence[str] | None = None) -> None:
    """Add an option for each field of a specification, or some; pydantic reads and checks the values."""
    group = parser.add_argument_group("specification")
    for name, field in model.model_fields.items():
        if only is not None and name not in only:
            continue
        default = "from the preset or the task" if field.default is None else field.default
        text = f"{field.description} (default: {default})"
        group.add_argument(
            f"--{name.replace('_', '-')}", dest=f"field_{name}", metavar="VALUE", help=text.replace("%", "%%")
        )


def _fields(options: argparse.Namespace) -> dict[str, Any]:
    given = {
        key.removeprefix("field_"): value
        for key, value in vars(options).items()
        if key.startswith("field_") and value is not None
    }
    parsed: dict[str, Any] = {name: None if value in ("null", "none") else value for name, value in given.items()}
    if isinstance(parsed.get("hidden_sizes"), str):
        parsed["hidden_sizes"] = [part for part in parsed["hidden_sizes"].replace(",", " ").split() if part]
    if "sensor_digits" in parsed and str(parsed["sensor_digits"]).isdigit():
        parsed["sensor_digits"] = int(parsed["sensor_digits"])
    return parsed


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


def _train(options: argparse.Namespace) -> int:
    fields = _fields(options)
    if options.resume is not None:
        from naosprint.checkpoint import read_manifest

        known = read_manifest(options.resume).spec.model_dump(mode="json")
        spec = TrainingSpec.model_validate({**known, **fields})
    else:
        spec = TrainingSpec.model_validate(fields)
    initial_policy = None if options.initial_policy is None else naopolicies.resolve(options.initial_policy)
    stop = _stop_on_signals()

    from naosprint.console import ConsoleReporter
    from naosprint.training import TrainingDivergedError, train

    with ConsoleReporter(options.workdir, spec.planned_steps) as reporter:
        try:
            result = train(
                spec,
                workdir=options.workdir,
                reporter=reporter,
                resume=options.resume,
                initial_policy=initial_policy,
                stop=stop.is_set,
            )
        except TrainingDivergedError as error:
            reporter.log("error", str(error))
            return EXIT_FAILURE
    sys.stdout.write(f"{result.status} {result.steps} {result.checkpoint}\n")
    return 0


def _evaluate(options: argparse.Namespace) -> int:
    spec = EvaluationSpec.model_validate(_fields(options))
    checkpoint = naopolicies.resolve(options.checkpoint)
    stop = _stop_on_signals()

    from rich.progress import Progress

    from naosprint.evaluation import evaluate

    with Progress(transient=True) as progress:
        bar = progress.add_task("episodes", total=spec.episodes)
        try:
            evaluation = evaluate(
                checkpoint,
                spec,
                threads=options.threads,
                progress=lambda done, total: progress.update(bar, completed=done, total=total),
                stop=stop.is_set,
            )
        except InterruptedError as error:
            sys.stderr.write(f"{error}; nothing was written\n")
            return 128 + signal.SIGINT
    if options.output is not None:
        evaluation.save(options.output)
    sys.stdout.write(evaluation.to_json())
    return 0


def _report(options: argparse.Namespace) -> int:
    from naosprint.report import write_report

    page = write_report(
        options.output,
        evaluation=options.evaluation,
        metrics=options.metrics,
        title=options.title,
        film=not options.no_film,
    )
    sys.stdout.write(f"{page}\n")
    return 0


def _export(options: argparse.Namespace) -> int:
    from naosprint.export import export_policy

    for path in export_policy(naopolicies.resolve(options.checkpoint), options.output):
        sys.stdout.write(f"{path}\n")
    return 0


def _replay(options: argparse.Namespace) -> int:
    spec = EvaluationSpec.model_validate({**_fields(options), "episodes": 1})
    checkpoint = naopolicies.resolve(options.checkpoint)

    from naosprint.actuation import CYCLE_S
    from naosprint.evaluation import evaluate
    from naosprint.film import write_mp4

    replay = evaluate(checkpoint, spec).replay
    options.output.mkdir(parents=True, exist_ok=True)
    written = [*replay.save(options.output)]
    if not options.no_film:
        written.append(options.output / "replay.mp4")
        count = len(replay.positions)
        if options.film_seconds is not None:
            count = min(count, max(1, round(options.film_seconds / CYCLE_S)))
        write_mp4(replay, written[-1], frames=range(count))
    for path in written:
        sys.stdout.write(f"{path}\n")
    end = "arrived" if replay.arrived else "fell" if replay.fallen else "stopped"
    sys.stderr.write(f"{replay.distance_m:.2f} m in {replay.duration_s:.2f} s, {end}\n")
    return 0


def _policies(options: argparse.Namespace) -> int:
    del options
    for name in naopolicies.names():
        sys.stdout.write(f"{name:14} {naopolicies.card(name)['summary']}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
