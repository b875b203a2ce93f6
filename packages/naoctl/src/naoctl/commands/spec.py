"""``naoctl spec``: every setting of a training and of its evaluation, explained."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any

import typer
from naospec import EvaluationSpec, TrainingSpec, plugins, presets
from naospec.abilities import need_of, switches_of
from naospec.flags import choices_of, flag_name, limits_text, metavar
from naospec.flat import GROUPS, Setting
from pydantic import ValidationError
from rich.console import Console
from rich.table import Table

from naoctl.commands.submit import EVAL_PREFIX, EVALUATION_SETTINGS
from naoctl.context import JsonFlag, completions, context_of
from naoctl.errors import InvalidInput
from naoctl.help import page
from naoctl.render import MISSING, pairs
from naoctl.specflags import training_settings

SECTIONS = (*GROUPS, "training", "runtime", "evaluation")
"""Groups of settings, in the order of the list."""


def settings_by_section() -> dict[str, dict[str, Setting]]:
    """Return all settings by group and name; an evaluation's name has the prefix ``eval_``."""
    found: dict[str, dict[str, Setting]] = {section: {} for section in SECTIONS}
    for name, setting in training_settings().items():
        found[setting.path[0] if len(setting.path) > 1 else "training"][name] = setting
    found["evaluation"] = {EVAL_PREFIX + name: setting for name, setting in EVALUATION_SETTINGS.items()}
    return found


def complete_field(incomplete: str) -> list[str]:
    """Return groups and settings for shell completion."""
    sections = settings_by_section()
    names = [*sections, *(name for settings in sections.values() for name in settings)]
    return completions(names, incomplete)


def spec(
    ctx: typer.Context,
    field: Annotated[
        str | None,
        typer.Argument(
            metavar="FIELD",
            help=f"A setting, or one of the groups {', '.join(SECTIONS)}.",
            autocompletion=complete_field,
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Explain the settings of a training: all of them, one group, or one."""
    context = context_of(ctx)
    sections = settings_by_section()
    known = {name: setting for settings in sections.values() for name, setting in settings.items()}
    wanted = None if field is None else field.strip().lstrip("-").replace("-", "_")
    # A training and its evaluation may have settings of the same name; both are explained.
    # So are plug-ins that declare one of the same name in different ways.
    named = {name: setting for name, setting in known.items() if wanted in (name, ".".join(setting.path))}
    meant = [(name, each) for name, setting in named.items() for each in setting.declarations()]
    listed = list(known.items())
    if wanted is None:
        chosen = sections
    elif wanted in sections:
        chosen = {wanted: sections[wanted]}
    elif meant:
        chosen, listed = {}, meant
    else:
        raise InvalidInput(f"There is no setting {field!r}", fix="`naoctl spec` lists the settings.")
    if as_json:
        shown = listed if not chosen else [each for settings in chosen.values() for each in settings.items()]
        context.json([describe(name, setting) for name, setting in shown])
    elif chosen:
        page(_text(context.out, [_section(section, settings) for section, settings in chosen.items()]))
    else:
        for number, (name, setting) in enumerate(listed):
            if number:
                context.out.print()
            context.out.print(_details(describe(name, setting)))


def describe(name: str, setting: Setting) -> dict[str, Any]:
    """Return a setting's flag, place in a job file, meaning, values and default by preset."""
    evaluation = name.startswith(EVAL_PREFIX)
    return {
        "name": name,
        "path": ".".join(("evaluation" if evaluation else "spec", *setting.path)),
        "flag": flag_name(name),
        "value": metavar(setting),
        "description": setting.info.description or "",
        "choices": list(setting.choices or choices_of(setting.info)),
        "bounds": limits_text(setting.info),
        "only_for": [f"{setting.path[0]} {plugin}" for plugin in setting.plugins],
        "needs": need_of(setting.info) or "",
        "with": list(switches_of(setting.info) or ()),
        "defaults": {"": EvaluationSpec().model_dump(mode="json")[setting.name]} if evaluation else _defaults(setting),
    }


def _defaults(setting: Setting) -> dict[str, Any]:
    """Return a setting's value by preset, for the first plug-in that has it."""
    found = {}
    for preset in presets.names():
        content: dict[str, Any] = {"algorithm": {"preset": preset}}
        if setting.plugins:
            content[setting.path[0]] = {**content.get(setting.path[0], {}), "name": setting.plugins[0]}
        value = _value(content, setting)
        if value is MISSING:  # of a simulator that runs other robots than the default one
            for robot, _ in plugins.usable(plugins.ROBOTS):
                value = _value({**content, "robot": robot}, setting)
                if value is not MISSING:
                    break
        found[preset] = value
    return found


def _value(content: Mapping[str, Any], setting: Setting) -> Any:
    try:
        value: Any = TrainingSpec.model_validate(content).model_dump(mode="json")
    except ValidationError:
        return MISSING
    for part in setting.path:
        value = value.get(part, MISSING)
        if value is MISSING:
            break
    return value


def _section(section: str, settings: Mapping[str, Setting]) -> Table:
    table = Table(
        title=section.capitalize(),
        title_justify="left",
        title_style="bold",
        box=None,
        pad_edge=False,
        show_header=False,
    )
    table.add_column(no_wrap=True, min_width=27)
    table.add_column(overflow="fold")
    for name, setting in settings.items():
        table.add_row(name, (setting.info.description or "").replace("[", "\\["))
    return table


def _text(console: Console, tables: list[Table]) -> str:
    with console.capture() as captured:
        for table in tables:
            console.print(table)
            console.print()
    return captured.get().rstrip("\n")


def _details(described: Mapping[str, Any]) -> Table:
    defaults = described["defaults"]
    if len({str(value) for value in defaults.values()}) == 1:
        default = _shown(next(iter(defaults.values())))
    else:
        default = ", ".join(f"{_shown(value)} (preset {preset})" for preset, value in defaults.items())
    rows = [
        ("Setting", described["name"]),
        ("Meaning", described["description"]),
        ("Flag", f"{described['flag']} {described['value']}".rstrip()),
        ("In a file", described["path"]),
        ("Values", ", ".join(described["choices"]) or described["bounds"]),
        ("Default", default),
        ("Only for", ", ".join(described["only_for"])),
        ("Needs", described["needs"]),
        ("Only with", " or ".join(described["with"])),
    ]
    return pairs([(title, text.replace("[", "\\[")) for title, text in rows if text])


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, dict):
        return json.dumps(value)
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("spec")(spec)
