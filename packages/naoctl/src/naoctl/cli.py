"""The program ``naoctl``: its commands put together, and one place where errors become words and exit codes."""

from __future__ import annotations

import json
import sys
from typing import Annotated

import typer

from naoctl import __version__
from naoctl.commands import artifacts, jobs, policies, service, submit, watch
from naoctl.commands import stack as stack_commands
from naoctl.context import Context
from naoctl.errors import CliError, ExitCode

EPILOG = (
    "Exit codes: 0 done, 1 failed, 2 wrong input, 3 the service does not answer, 4 token refused, 5 not found, "
    "6 not possible in this state, 7 damaged download, 8 stack trouble; "
    "for a followed job 0 succeeded, 10 failed, 11 cancelled, 12 paused; 130 interrupted."
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


def build_app() -> typer.Typer:
    """Put all commands together."""
    app = typer.Typer(
        name="naoctl",
        help="Train NAO robots to sprint: submit jobs, follow them, fetch their policies, run the whole service.",
        epilog=EPILOG,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        context_settings={"help_option_names": ["-h", "--help"]},
    )

    @app.callback()
    def start(
        ctx: typer.Context,
        url: Annotated[
            str | None,
            typer.Option(
                "--url",
                metavar="URL",
                envvar="NAOCTL_URL",
                help="Address of the service.",
                show_default="the current one",
            ),
        ] = None,
        version: Annotated[
            bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
        ] = False,
    ) -> None:
        ctx.obj = Context(url=url)

    for module in (submit, jobs, watch, artifacts, policies, service, stack_commands):
        module.register(app)
    return app


def main(arguments: list[str] | None = None) -> None:
    """Run the program and leave with its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    try:
        build_app()(words, prog_name="naoctl")
    except CliError as error:
        report(error, as_json="--json" in words)
        sys.exit(int(error.code))
    except KeyboardInterrupt:
        sys.stderr.write("\n")
        sys.exit(int(ExitCode.INTERRUPTED))


def report(error: CliError, *, as_json: bool) -> None:
    """Say on standard error what went wrong: one line for people, or one JSON document for programs."""
    if as_json:
        sys.stderr.write(json.dumps({"error": error.message, "fix": error.fix, "code": int(error.code)}) + "\n")
    else:
        sys.stderr.write(f"naoctl: {error}\n")
