"""The command line for use without the service: ``python -m naosprint --help``."""

from __future__ import annotations

import argparse
import io
import os
import signal
import sys
import threading
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from naospec import EvaluationSpec, TrainingSpec, recipes
from naospec.arguments import ArgumentParser
from naospec.files import named_errors
from naospec.flags import ALIASES, FlagError, explain, flag_name, help_text, read_switches
from naospec.flat import settings, settings_of
from pydantic import ValidationError
from pydantic_core import PydanticUndefined

from naosprint import commands
from naosprint.commands import EXIT_FAILURE
from naosprint.matches.commands import add_parsers
from naosprint.programs import EXPECTED_ERRORS, above_zero, error_text, integer
from naosprint.threads import quiet_openmp

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from naospec.flat import Setting
    from pydantic import BaseModel


EXIT_USAGE = 2
EXIT_PIPE = 128 + signal.SIGPIPE
"""As of other programs whose reader has ended, such as ``head``."""
MAX_THREADS, MAX_FILM_S = 256, 3600.0
"""Threads of the simulator, and seconds of a film, at most."""

_threads = integer(1, MAX_THREADS)
_CHECKPOINT_HELP = "checkpoint directory, or the name of a bundled policy"
_REPLAY_FIELDS = {"task", "seed", "simulator", "start_noise_deg"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    quiet_openmp()
    if sys.stdout is None:  # closed, as by `>&-`
        sys.stdout = io.StringIO()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # what the terminal's character set has not
    options = argparse.Namespace(model=TrainingSpec, settings={}, given={}, spec=None)
    try:
        _parser().parse_args(arguments, options)
        run: Callable[[argparse.Namespace], int] = options.run
        # of what is written there, an error of a disk may not name the file
        places = (getattr(options, name, None) for name in ("output", "workdir", "folder", "written"))
        written = next((place for place in places if place), Path("standard output"))
        with _interruptible(), named_errors(written):
            options.given = _given(options)
            status = run(options)
        with named_errors(Path("standard output")):
            sys.stdout.flush()
        return status
    except KeyboardInterrupt as error:
        number = error.number if isinstance(error, _Interrupt) else signal.SIGINT
        sys.stderr.write(f"stopped by {number.name}; no unfinished file is left\n")
        return 128 + number
    except ValidationError as error:
        from_flags = {name: options.settings[name] for name in options.given}
        where = f"{options.spec}: spec." if options.spec else ""
        sys.stderr.writelines(f"{line}\n" for line in explain(options.model, error, from_flags, where=where))
        return EXIT_USAGE
    except FlagError as error:
        sys.stderr.write(f"{error}\n")
        return EXIT_USAGE
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the rest of it, when Python ends
        return EXIT_PIPE
    except EXPECTED_ERRORS as error:
        sys.stderr.write(f"error: {error_text(error)}\n")
        return EXIT_FAILURE


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(prog="naosprint", description="Train, evaluate, replay and export policies.")
    added = parser.add_subparsers(required=True, metavar="command", parser_class=_CommandParser)

    def command(
        run: Callable[[argparse.Namespace], int], summary: str, description: str | None = None
    ) -> _CommandParser:
        """Add a command, which is described by the function that runs it."""
        found: _CommandParser = added.add_parser(run.__name__, help=summary, description=description or run.__doc__)
        found.set_defaults(run=run)
        return found

    train = command(commands.train, "train a policy")
    train.add_argument("workdir", type=Path, help="directory for checkpoints and metrics.jsonl")
    begin = train.add_mutually_exclusive_group()
    begin.add_argument(
        "--recipe",
        choices=recipes.names(),
        help="start from this recipe's specification; with --from-policy, of its stages only those after that policy",
    )
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

    evaluate = command(commands.evaluate, "evaluate a policy")
    evaluate.add_argument("checkpoint", help=_CHECKPOINT_HELP)
    evaluate.add_argument("--output", type=Path, help="directory for evaluation.json, trajectories.npz and replay.json")
    evaluate.add_argument(
        "--json", action="store_true", help="print everything as JSON, also what the table leaves out"
    )
    evaluate.add_argument("--threads", type=_threads, default=2, help="threads of the simulator (default: 2)")
    _add_settings(evaluate, EvaluationSpec, settings_of(EvaluationSpec), title="evaluation")

    examine = command(
        commands.examine,
        "find out how robust a policy is",
        "Print peaks of motion, results under disturbances, and for each disturbance the range within "
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

    handover = command(
        commands.handover,
        "find out from which skills others can be entered",
        "Print for every two skills of a robot the percentage of transitions after which it is upright and "
        "does what is commanded.",
    )
    handover.add_argument("--robot", default="t1", help="robot (default: t1)")
    handover.add_argument(
        "--policy", action="append", default=[], metavar="TASK=NAME", help="bundled policy for a task; repeatable"
    )
    handover.add_argument("--only", metavar="SKILLS", help="skills to choose, with commas between")
    handover.add_argument("--transitions", type=int, default=200, help="transitions of each two (default: 200)")
    handover.add_argument("--seed", type=integer(0), default=1, help="seed of states and commands (default: 1)")
    handover.add_argument("--engine", default="mujoco", choices=("fast", "mujoco"), help="engine (default: mujoco)")
    handover.add_argument("--output", type=Path, metavar="FILE", help="JSON file with intervals")
    handover.add_argument("--threads", type=_threads, default=2, help="threads of the simulator (default: 2)")

    verify = command(commands.verify, "train a segment again and compare it bit by bit")
    verify.add_argument(
        "earlier", help="checkpoint; or the folder of a training, or a bundled policy that has two: the last two"
    )
    verify.add_argument("later", type=Path, nargs="?", help="later checkpoint of the same training")

    report = command(commands.report, "write a report on a policy")
    report.add_argument("evaluation", type=Path, help="directory that `evaluate --output` wrote")
    report.add_argument("output", type=Path, help="directory for report.html and the files beside it")
    report.add_argument("--metrics", type=Path, metavar="FILE", help="the training's metrics.jsonl, for its curves")
    report.add_argument("--title", help="title of the page (default: the task's name)")
    report.add_argument("--no-film", action="store_true", help="omit the film, which takes most of the time")

    export = command(commands.export, "export a policy")
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

    replay = command(commands.replay, "record and film an episode")
    replay.add_argument("checkpoint", help=_CHECKPOINT_HELP)
    replay.add_argument("output", type=Path, help="directory for the files")
    replay.add_argument("--no-film", action="store_true", help="omit the film, which takes most of the time")
    replay.add_argument("--film-seconds", type=_seconds, metavar="S", help="film the first S seconds (default: all)")
    recorded = settings_of(EvaluationSpec, leave_out=EvaluationSpec.model_fields.keys() - _REPLAY_FIELDS)
    _add_settings(replay, EvaluationSpec, recorded, title="evaluation")

    add_parsers(added, lambda: commands.stop_on_signals().is_set)

    command(commands.policies, "list the bundled policies")
    return parser


# --- options and specifications -----------------------------------------------------------------------------------


class _CommandParser(ArgumentParser):
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
        text, ways = help_text(setting), setting.declarations()
        default = setting.info.default if len(ways) == 1 else None
        if default is not None and default is not PydanticUndefined:
            text += f" (default: {','.join(map(str, default)) if isinstance(default, tuple) else default})"
        flags, dest = (*ALIASES.get(name, ()), flag_name(name)), f"setting_{name}"
        groups[heading].add_argument(*flags, type=str, dest=dest, metavar="VALUE", help=text.replace("%", "%%"))
    parser.switches = [flag_name(name) for name, setting in known.items() if setting.is_switch]
    parser.set_defaults(model=model, settings=known)


def _given(options: argparse.Namespace) -> dict[str, str]:
    """Return the texts of the settings that were given as options, by short name."""
    texts = {name: getattr(options, f"setting_{name}") for name in options.settings}
    return {name: text for name, text in texts.items() if text is not None}


def _seconds(text: str) -> float:
    """Return a length of time, s. Raises argparse.ArgumentTypeError."""
    return above_zero(text, MAX_FILM_S)


class _Interrupt(KeyboardInterrupt):
    """A signal that ends the command.

    If compiled code runs Python code that raises KeyboardInterrupt itself, Python kills its own process at its end.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = signal.Signals(number)


@contextmanager
def _interruptible() -> Iterator[None]:
    """Raise ``_Interrupt`` at SIGINT and SIGTERM, so that what was begun is cleaned up; restore both handlers."""
    received: list[int] = []

    def interrupt(number: int, frame: object) -> None:
        del frame
        received.append(number)
        raise _Interrupt(number)

    if threading.current_thread() is not threading.main_thread():
        yield  # which alone receives signals
        return
    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    except Exception:
        # an import of compiled code, for example, reports the interrupt as an error of its own
        if received:
            raise _Interrupt(received[0]) from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


if __name__ == "__main__":
    sys.exit(main())
