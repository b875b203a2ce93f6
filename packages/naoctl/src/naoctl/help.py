"""Help texts: options under headings, all settings on request, a pager for what is longer than the terminal."""

from __future__ import annotations

import pydoc
import shutil
import sys
from typing import Annotated, Any

import typer
from naospec.flags import FlagError, read_switches
from typer.core import TyperCommand, TyperGroup, TyperOption

from naoctl.errors import InvalidInput

OPTIONS = "Options"
"""Heading above the options that have none of their own."""
NAMES_WIDTH = 30
"""Widest column of names; a longer name has a line of its own."""
MAY_BE_EMPTY = ("TAG", "TEXT")
"""Kinds of values of which an empty one deletes what was there."""
GROUPS = {
    "Train": ("submit", "tune", "study", "spec"),
    "Jobs": (
        *("list", "status", "watch", "logs", "open", "compare"),
        *("cancel", "pause", "resume", "retry", "edit", "delete"),
    ),
    "Results and policies": (
        *("download", "checkpoints", "eval", "report", "export", "policies", "tensorboard", "mirror"),
    ),
    "Play": ("match", "team", "league"),
    "Run the service on this machine": ("demo", "up", "down", "doctor"),
    "Use and administer a service": ("login", "logout", "workers", "usage", "token", "webhook", "version"),
}
"""Commands by what they are for, in the order of ``naoctl --help``."""


class WholeSummaries(TyperGroup):
    """Group of commands whose help cuts no summary."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, _summary(self.commands[name])) for name in self.list_commands(ctx)])


class CommandGroups(TyperGroup):
    """Group of commands whose help lists them by purpose, with whole summaries."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the options before the command. Raises InvalidInput."""
        _refuse_empty(self, ctx, args)
        return super().parse_args(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands under their headings; a command without a heading is an error."""
        width = max(map(len, self.commands))
        missing = self.commands.keys() - {name for names in GROUPS.values() for name in names}
        assert not missing, missing
        for heading, names in GROUPS.items():
            records = [(name.ljust(width), _summary(self.commands[name])) for name in names if name in self.commands]
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)


def _summary(command: Any) -> str:
    """Return the first sentence of a command's help, on one line."""
    first = " ".join((command.help or "").partition("\n\n")[0].split())
    return first.partition(". ")[0].rstrip(".") + "."


class Command(TyperCommand):
    """Command that refuses an empty argument, which a variable that is not set leaves; a text or a tag may be empty."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line. Raises InvalidInput."""
        _refuse_empty(self, ctx, args)
        return super().parse_args(ctx, args)


class SettingsCommand(Command):
    """Command with one option per setting; ``--help`` shows the most used, ``--help-all`` all under headings."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line; switches may be followed by true or false. Raises InvalidInput."""
        switches = [each.opts[0] for each in self.params if _heading(each) and each.secondary_opts]
        try:
            return super().parse_args(ctx, read_switches(args, switches, paired=True))
        except FlagError as error:
            raise InvalidInput(str(error)) from None

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options to the formatter, grouped by their headings."""
        settings = [parameter for parameter in self.params if _heading(parameter)]
        shortened = any(parameter.hidden for parameter in settings if isinstance(parameter, TyperOption))
        sections: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is None:
                continue
            heading = "Arguments" if parameter.param_type_name == "argument" else _heading(parameter) or OPTIONS
            if shortened and _heading(parameter):
                heading = f"Most used of {len(settings)} settings (--help-all lists all)"
                record = (record[0], record[1].partition(" [")[0])  # without bounds
            sections.setdefault(heading, []).append(record)
        for heading, records in sections.items():
            with formatter.section(heading):
                formatter.write_dl(records, col_max=NAMES_WIDTH)

    def get_help_option(self, ctx: Any) -> Any:
        """Return the option ``--help``, which uses a pager."""
        option = super().get_help_option(ctx)
        if option is not None:
            option.callback = _show_help
        return option


def _refuse_empty(command: Any, ctx: Any, args: list[str]) -> None:
    given = command.make_parser(ctx).parse_args(list(args))[0]
    for parameter in command.params:
        value = given.get(parameter.name)
        is_free = parameter.metavar in MAY_BE_EMPTY or _heading(parameter)
        if not is_free and "" in (value if isinstance(value, list | tuple) else [value]):
            name = parameter.metavar if parameter.param_type_name == "argument" else parameter.opts[0]
            raise InvalidInput(f"{name} is empty", fix="Give a value, or leave it out.")


def _heading(parameter: Any) -> str | None:
    """Return the heading of a setting; None for options that are no settings."""
    heading = getattr(parameter, "rich_help_panel", None)
    return heading if isinstance(heading, str) else None


def reveal(command: Any) -> None:
    """Make a command's help show the settings that ``--help`` leaves out."""
    for parameter in command.params:
        if _heading(parameter):
            parameter.hidden = False


def _show_help(ctx: Any, _option: Any, wanted: bool) -> None:
    if wanted and not ctx.resilient_parsing:
        page(ctx.get_help())
        ctx.exit()


def _show_all(ctx: typer.Context, wanted: bool) -> None:
    if wanted:
        reveal(ctx.command)
        page(ctx.get_help())
        raise typer.Exit


HelpAllFlag = Annotated[
    bool,
    typer.Option("--help-all", callback=_show_all, is_eager=True, help="Show this message with all settings and exit."),
]


def page(text: str) -> None:
    """Print a text, through the user's pager if it is longer than the terminal."""
    if sys.stdout.isatty() and text.count("\n") + 2 > shutil.get_terminal_size().lines:
        pydoc.pager(text)
    else:
        typer.echo(text)
