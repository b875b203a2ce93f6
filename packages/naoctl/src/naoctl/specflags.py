"""One command-line flag per setting of a specification, derived from its models."""

from __future__ import annotations

import inspect
import json
import re
import types
from collections.abc import Callable, Container, Iterable, Mapping
from decimal import Decimal
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import typer
from naospec import flat
from naospec.flat import Setting
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from typer.models import OptionInfo

from naoctl.context import completions
from naoctl.errors import InvalidInput

NULL_WORDS = frozenset({"none", "null"})
"""What a user writes to set a nullable field to null."""
MAGNITUDES = {"k": 10**3, "m": 10**6, "g": 10**9}
"""Letters after a number that stand for thousands, millions and billions: ``250k``, ``3M``."""
_ABBREVIATED = re.compile(r"(\d{1,12}(?:\.\d{1,12})?) ?([kmg])", re.IGNORECASE)
PANELS = {
    "task": "Task",
    "robot": "Robot",
    "simulator": "Simulator",
    "algorithm": "Algorithm (left out: the preset's value)",
    "runtime": "Runtime",
}
"""Headings above the flags of each section in ``--help``."""

ModelT = TypeVar("ModelT", bound=BaseModel)


def flag_name(field: str, prefix: str = "") -> str:
    """Return the flag of a field: ``n_envs`` becomes ``--n-envs``, or ``--eval-n-envs`` with the prefix ``eval_``."""
    return "--" + (prefix + field).replace("_", "-")


def choices_of(info: FieldInfo) -> tuple[str, ...]:
    """Return the words a field allows, or nothing if it is not a choice."""
    extra = info.json_schema_extra
    if isinstance(extra, dict) and isinstance(extra.get("enum"), list):
        return tuple(str(word) for word in extra["enum"])  # type: ignore[union-attr]
    words: list[str] = []
    for part in _alternatives(info.annotation):
        if get_origin(part) is Literal:
            words += [str(word) for word in get_args(part)]
        elif part is type(None):
            words.append("none")
        else:
            return ()
    return tuple(words)


@cache
def training_settings() -> dict[str, Setting]:
    """Return every setting of a training that has a flag, by short name; plug-ins contribute theirs."""
    return flat.settings()


def settings_of(model: type[BaseModel], *, leave_out: Iterable[str] = ()) -> dict[str, Setting]:
    """Return the fields of a specification without sections as settings, by name."""
    skipped = set(leave_out)
    return {name: Setting(name, (name,), info) for name, info in model.model_fields.items() if name not in skipped}


def spec_parameters(
    settings: Mapping[str, Setting],
    *,
    panel: str,
    prefix: str = "",
    aliases: Mapping[str, Iterable[str]] | None = None,
    flag_prefix: str | None = None,
    shown: Container[str] | None = None,
) -> list[inspect.Parameter]:
    """Return one keyword parameter per setting for a Typer command; a parameter is None unless the user gave its flag.

    Args:
        settings: settings by short name.
        panel: heading above the flags in ``--help``; settings in sections have their section's.
        prefix: put before names, to keep two specifications apart in one command.
        flag_prefix: the prefix that users see in flags, when it is another.
        aliases: further flags by name, for example ``{"total_steps": ["--steps"]}``.
        shown: settings that ``--help`` shows; the others are hidden, but work. None: all.
    """
    aliases = aliases or {}
    parameters = []
    for field, setting in settings.items():
        info = setting.info
        name = flag_name(field, prefix if flag_prefix is None else flag_prefix)
        choices = setting.choices or choices_of(info)
        annotation: Any = str | None
        declarations = [*aliases.get(field, ()), name]
        if info.annotation is bool:
            annotation = bool | None
            declarations = [f"{name}/--no-{name[2:]}"]
        option: OptionInfo = typer.Option(
            *declarations,
            help=_help(setting),
            metavar=metavar(setting) or None,
            show_default=False,
            rich_help_panel=PANELS.get(setting.path[0], panel) if len(setting.path) > 1 else panel,
            hidden=shown is not None and field not in shown,
            autocompletion=_completion(choices) if choices else None,
        )
        parameters.append(
            inspect.Parameter(
                prefix + field,
                inspect.Parameter.KEYWORD_ONLY,
                default=None,
                annotation=Annotated[annotation, option],
            )
        )
    return parameters


def with_parameters(function: Callable[..., None], named: Mapping[str, list[inspect.Parameter]]) -> Callable[..., None]:
    """Give a command more parameters; they reach ``function`` as one dictionary per name in ``named``.

    Args:
        function: a command that has a keyword parameter for every key of ``named``.
        named: the parameters that each of these dictionaries collects; those the user did not give are left out of it.
    """
    own = [p for p in inspect.signature(function, eval_str=True).parameters.values() if p.name not in named]
    added = [parameter for group in named.values() for parameter in group]

    def command(**values: Any) -> None:
        groups = {key: {p.name: values.pop(p.name) for p in group} for key, group in named.items()}
        given = {
            key: {name: value for name, value in group.items() if value is not None} for key, group in groups.items()
        }
        function(**values, **given)

    command.__name__ = function.__name__
    command.__doc__ = function.__doc__
    keyword = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in own]
    command.__signature__ = inspect.Signature([*keyword, *added])  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in [*keyword, *added]}
    return command


def parse_flags(settings: Mapping[str, Setting], flags: Mapping[str, Any], *, prefix: str = "") -> dict[str, Any]:
    """Convert flags to values: ``none`` to null, ``64,64`` to a list, ``3M`` to 3,000,000."""
    values: dict[str, Any] = {}
    for name, raw in flags.items():
        field = name.removeprefix(prefix)
        parts = _alternatives(settings[field].info.annotation)
        value: Any = raw
        if isinstance(raw, str):
            text = raw.strip()
            if type(None) in parts and text.lower() in NULL_WORDS:
                value = None
            elif any(_is_mapping(part) for part in parts):
                value = _json(field, text)
            elif any(get_origin(part) in (tuple, list) for part in parts):
                value = [item.strip() for item in text.split(",") if item.strip()]
            elif _literal_numbers(parts):
                value = _number(text)
            else:
                value = expanded(text) if {int, float}.intersection(parts) else text
        values[field] = value
    return values


def expanded(text: str) -> str:
    """Return a number with its magnitude written out: ``3M`` is ``3000000``; any other text is returned as it is."""
    match = _ABBREVIATED.fullmatch(text)
    if match is None:
        return text
    number = Decimal(match[1]) * MAGNITUDES[match[2].lower()]
    return f"{number.normalize():f}"


def build(
    model: type[ModelT],
    values: Mapping[str, Any],
    *,
    from_flags: Mapping[str, Setting] | None = None,
    prefix: str = "",
    where: str = "",
) -> ModelT:
    """Validate ``values`` and build the model.

    Args:
        model: the specification.
        values: its content.
        from_flags: settings that came from flags, by short name.
        prefix: prefix of those flags.
        where: put before the paths of all other fields.

    Raises:
        InvalidInput: naming every wrong field, as its flag if it came from one, and what would be right.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        raise InvalidInput(_explain(model, error, from_flags or {}, prefix, where)) from None


def _explain(
    model: type[BaseModel],
    error: ValidationError,
    from_flags: Mapping[str, Setting],
    prefix: str,
    where: str,
) -> str:
    """Return a validation error as one line: every wrong field by the name the user gave it."""
    flags = {setting.path: flag_name(name, prefix) for name, setting in from_flags.items()}
    lines = []
    for item in error.errors(include_url=False, include_context=False):
        path = tuple(str(part) for part in item["loc"])
        message = item["msg"].removeprefix("Value error, ")
        head, colon, rest = message.partition(": ")
        if colon and all(part.isidentifier() for part in head.split(".")):
            # a check over several fields names the one to change
            named = tuple(head.split("."))
            path, message = named if named[: len(path)] == path else (*path, *named), rest
        if not path:
            lines.append(message)
            continue
        # a section's own error belongs to the flag that chose its plug-in; an item's, to its list's
        places = (path, (*path, "name"), path[:2], path[:1])
        name = next((flags[place] for place in places if place in flags), where + ".".join(path))
        if item["type"] == "extra_forbidden":
            known = ", ".join(_fields_at(model, path[:-1]))
            lines.append(f"{name}: no such field" + (f"; there are {known}" if known else ""))
        else:
            given = item.get("input")
            shown = f" (got {given!r})" if isinstance(given, str | int | float | bool) else ""
            lines.append(f"{name}: {message[:1].lower()}{message[1:]}{shown}")
    return "; ".join(lines)


def _fields_at(model: type[BaseModel], path: tuple[str, ...]) -> list[str]:
    """Return the names of the fields beside an unknown one; sections name their own."""
    if not path:
        return list(model.model_fields)
    return [setting.path[1] for setting in training_settings().values() if setting.path[:-1] == path]


def _is_mapping(annotation: Any) -> bool:
    origin = get_origin(annotation) or annotation
    return isinstance(origin, type) and issubclass(origin, Mapping)


def _json(field: str, text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        raise InvalidInput(f"{flag_name(field)}: expected a JSON object, got {text!r}") from None


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    if get_origin(annotation) in (Union, types.UnionType):
        return get_args(annotation)
    return (annotation,)


def _literal_numbers(parts: Iterable[Any]) -> bool:
    return any(get_origin(p) is Literal and any(isinstance(a, int) for a in get_args(p)) for p in parts)


def _number(text: str) -> int | str:
    try:
        return int(text)
    except ValueError:
        return text


def metavar(setting: Setting) -> str:
    """Return the placeholder of a setting's value: ``NAME``, ``INTEGER``, ``2|3|none``; empty for a switch."""
    info, choices = setting.info, choices_of(setting.info)
    if setting.choices:
        return "NAME"
    if info.annotation is bool:
        return ""
    if choices:
        return "|".join(choices)
    parts = _alternatives(info.annotation)
    for part in parts:
        if get_origin(part) in (tuple, list):
            return "INT,INT,..."
        if _is_mapping(part):
            return "JSON"
    word = "INTEGER" if int in parts else "NUMBER" if float in parts else "TEXT"
    return f"{word}|none" if type(None) in parts else word


def limits_text(info: FieldInfo) -> str:
    """Return the bounds of a numeric field in words: ``0 to 20``, ``above 0``; empty if it has none."""
    bounds = {
        name: getattr(item, name) for item in info.metadata for name in ("ge", "gt", "le", "lt") if hasattr(item, name)
    }
    signs = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    ends = {
        name: f"{value:,}" if isinstance(value, int) else f"{value:g}"
        for name, value in bounds.items()
        if value is not None
    }
    if ends.keys() == {"ge", "le"}:
        return f"{ends['ge']} to {ends['le']}"
    return " and ".join(f"{signs[name]} {end}" for name, end in ends.items())


def _help(setting: Setting) -> str:
    info = setting.info
    text = info.description or info.title or ""
    if setting.choices:
        text += f" One of {', '.join(setting.choices)}."
    if limits := limits_text(info):
        text += f" [{limits}]"
    if setting.plugins:
        text += f" ({setting.path[0]} {', '.join(setting.plugins)})"
    return text


def _completion(choices: tuple[str, ...]) -> Callable[[str], list[str]]:
    def complete(incomplete: str) -> list[str]:
        return completions(choices, incomplete)

    return complete
