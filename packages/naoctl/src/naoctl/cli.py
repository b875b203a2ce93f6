"""The program ``naoctl``: its commands, and the conversion of errors to messages and exit codes."""

from __future__ import annotations

import io
import logging
import os
import sys
from typing import Annotated

import typer
from naospec import plugins
from naospec.proxies import exempt_loopback

from naoctl import __version__
from naoctl.commands import (
    artifacts,
    browse,
    jobs,
    matches,
    mirror,
    policies,
    service,
    spec,
    studies,
    submit,
    tensorboard,
    watch,
    webhooks,
)
from naoctl.commands import stack as stack_commands
from naoctl.context import Context
from naoctl.errors import CliError, ExitCode, plain
from naoctl.help import Command, CommandGroups, WholeSummaries
from naoctl.render import terminal_json

EPILOG = (
    "Exit codes: 0 done, 1 failed, 2 wrong input, 3 the service does not answer, 4 token refused, 5 not found, "
    "6 not possible in this state, 7 damaged download, 8 service on this machine failed; "
    "for a followed job 0 succeeded, 10 failed, 11 cancelled, 12 paused; 130 interrupted."
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


_MODULES = (
    submit,
    studies,
    spec,
    jobs,
    watch,
    browse,
    matches,
    artifacts,
    tensorboard,
    mirror,
    policies,
    service,
    webhooks,
    stack_commands,
)
"""Modules of commands, in the order of the help."""


def build_app(word: str | None = None) -> typer.Typer:
    """Return the application with all commands, or with the one command or group ``word`` if it is one.

    Most of the time that a command takes to start is spent on the options of all others.
    """
    app = typer.Typer(
        name="naoctl",
        cls=CommandGroups,
        help="Train simulated humanoid robots: submit jobs, watch them, download policies, run the service.",
        epilog=EPILOG,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
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

    for module in _MODULES:
        module.register(app)
    _set_classes(app)
    commands = [command for command in app.registered_commands if command.name == word]
    groups = [group for group in app.registered_groups if group.name == word]
    if commands or groups:
        app.registered_commands, app.registered_groups = commands, groups
    return app


def _set_classes(app: typer.Typer) -> None:
    """Give commands and groups without a class of their own that of this program."""
    for command in app.registered_commands:
        if not issubclass(command.cls or Command, Command):
            command.cls = Command
    for group in app.registered_groups:
        if group.typer_instance is None:
            continue
        if not isinstance(group.typer_instance.info.cls, type):  # it has no class of its own
            group.cls = WholeSummaries
        _set_classes(group.typer_instance)


def main(arguments: list[str] | None = None) -> None:
    """Run the program and exit with its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    as_json = "--json" in words
    exempt_loopback()
    if any(name.endswith("_COMPLETE") for name in os.environ):  # a shell asks how a line could end
        logging.disable()  # a warning would appear in this line
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # what the terminal's character set has not
    try:
        code = build_app(words[0] if words else None)(words, prog_name="naoctl", standalone_mode=False)
    except CliError as error:
        report(error, as_json=as_json)
        code = error.code
    except plugins.BrokenPluginError as error:
        report(CliError(str(error)), as_json=as_json)
        code = ExitCode.FAILURE
    except OSError as error:  # a disk that is full, a folder that may not be written, a name that is too long
        report(
            CliError(f"{error.strerror or error}: {error.filename}" if error.filename else str(error)), as_json=as_json
        )
        code = ExitCode.FAILURE
    except typer.TyperException as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # its text is the help
            sys.stderr.write(f"{error.format_message()}\n")
        else:
            report(usage_error(error), as_json=as_json)
        code = ExitCode.USAGE
    except typer.Abort:
        report(CliError("Nothing was changed"), as_json=as_json)
        code = ExitCode.FAILURE
    except KeyboardInterrupt:
        sys.stderr.write("\n")
        code = ExitCode.INTERRUPTED
    sys.exit(int(code or 0))


def usage_error(error: typer.TyperException) -> CliError:
    """Return an error of the command line's syntax in the form of all others."""
    context = getattr(error, "ctx", None)
    name = context.command_path if context is not None else "naoctl"
    return CliError(error.format_message().rstrip("."), fix=f"`{name} --help` shows the usage.", code=ExitCode.USAGE)


def report(error: CliError, *, as_json: bool) -> None:
    """Write an error to standard error: one line of text, or one JSON document."""
    if as_json:
        document = {"error": error.message, "fix": error.fix, "code": int(error.code)}
        sys.stderr.write(terminal_json(document) + "\n")
    else:
        sys.stderr.write(plain(f"naoctl: {error}", keep="\t\n") + "\n")
