"""Flags of command lines for the settings of a specification: their values, errors and help texts."""

from __future__ import annotations

import json
import re
import types
from collections.abc import Callable, Mapping
from decimal import Decimal
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, TypeAdapter, ValidationError

from naospec.flat import as_chosen, settings

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from pydantic.fields import FieldInfo

    from naospec.flat import Setting

NULL_WORDS = frozenset({"none", "null"})
"""What a user writes to set a nullable field to null."""
MAGNITUDES = {"k": 10**3, "m": 10**6, "g": 10**9}
"""Letters after a number that stand for thousands, millions and billions: ``250k``, ``3M``."""
ALIASES = {"total_steps": ("--steps",)}
"""Further flags of settings, by short name."""
_ABBREVIATED = re.compile(r"(\d{1,12}(?:\.\d{1,12})?) ?([kmg])", re.IGNORECASE)
_TRUTH = TypeAdapter(bool)


class FlagError(ValueError):
    """Command line on which a flag has a value that it cannot have."""


def flag_name(field: str, prefix: str = "") -> str:
    """Return the flag of a field: ``n_envs`` becomes ``--n-envs``, or ``--eval-n-envs`` with the prefix ``eval_``."""
    return "--" + (prefix + field).replace("_", "-")


# --- values ---------------------------------------------------------------------------------------------------------


def parse_flags(
    settings: Mapping[str, Setting],
    flags: Mapping[str, Any],
    *,
    prefix: str = "",
    base: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the values of flags by short name; what is no text is a value already.

    Args:
        settings: settings by short name.
        flags: what was given, by short name with the prefix.
        prefix: prefix of the flags.
        base: specification that the values are inserted into; its plug-ins decide how a value is read if no flag does.
    """
    given = {name.removeprefix(prefix): raw for name, raw in flags.items()}
    known = as_chosen(settings, {**(base or {}), **given})
    return {name: read_value(raw, known[name].info) if isinstance(raw, str) else raw for name, raw in given.items()}


def read_value(text: str, info: FieldInfo) -> Any:
    """Return the value of a field that a text stands for; pydantic checks it.

    ``none`` is null if the field can be null, ``64,64`` and ``64 64`` are lists, ``3M`` is 3,000,000, and mappings,
    lists and sections may be JSON.
    """
    text, kinds = text.strip(), _kinds(info.annotation)
    if type(None) in kinds and text.lower() in NULL_WORDS:
        return None
    items = next((get_args(kind)[0] for kind in kinds if get_origin(kind) in (tuple, list)), None)
    if items is not None and not text.startswith("["):
        return [_read(item, _kinds(items)) for item in text.replace(",", " ").split()]
    return _read(text, kinds)


def expanded(text: str) -> str:
    """Return a number with its magnitude written out: ``3M`` is ``3000000``; any other text is returned as it is."""
    match = _ABBREVIATED.fullmatch(text)
    if match is None:
        return text
    number = Decimal(match[1]) * MAGNITUDES[match[2].lower()]
    return f"{number.normalize():f}"


def read_switches(arguments: Iterable[str], switches: Collection[str], *, paired: bool) -> list[str]:
    """Return a command line in which the switches are written one way.

    ``--name``, ``--name true``, ``--name=true``, ``--no-name`` and ``--name false`` are possible. A word that is no
    truth value does not belong to the switch before it.

    Args:
        arguments: the command line.
        switches: flags of settings that are true or false.
        paired: whether to write ``--name`` and ``--no-name``; otherwise ``--name=true`` and ``--name=false``.

    Raises:
        FlagError: if ``--name=`` is followed by something else.
    """
    negated = {f"--no-{flag[2:]}": flag for flag in switches}
    found, words = [], list(arguments)
    while words:
        word = words.pop(0)
        flag, sign, text = word.partition("=")
        value: bool | None = True
        if flag in switches:
            value = _truth(text if sign else words[0] if words else "")
            if sign and value is None:
                raise FlagError(f"{flag}: expected true or false, got {text!r}")
            if not sign and value is not None:
                del words[0]
        elif word in negated:
            flag, value = negated[word], False
        else:
            found.append(word)
            if word == "--":
                break
            continue
        shown = {False: f"--no-{flag[2:]}", True: flag} if paired else {False: f"{flag}=false", True: f"{flag}=true"}
        found.append(shown[value is not False])
    return found + words


def _truth(text: str) -> bool | None:
    """Return the truth value that a text stands for, as pydantic reads it; None if it is no truth value."""
    try:
        return _TRUTH.validate_python(text)
    except ValidationError:
        return None


def _read(text: str, kinds: tuple[Any, ...]) -> Any:
    """Return the value of one of some types that a text stands for, or the text if it is none."""
    if any(map(_is_word, kinds)) and not (text.startswith("{") and any(map(_is_mapping, kinds))):
        return text
    readers: Sequence[Callable[[str], Any]] = (json.loads,)
    if any(map(_is_number, kinds)) and not text.startswith(("{", "[")):
        text, readers = expanded(text), (int, float)
    for read in readers:
        try:
            return read(text)
        except ValueError:
            continue
    return text


def _kinds(annotation: Any) -> tuple[Any, ...]:
    """Return the alternatives of a type without their constraints."""
    origin = get_origin(annotation)
    if origin is Annotated:
        return _kinds(get_args(annotation)[0])
    if origin in (Union, types.UnionType):
        return tuple(kind for part in get_args(annotation) for kind in _kinds(part))
    return (annotation,)


def _is_number(kind: Any) -> bool:
    return kind in (int, float) or (get_origin(kind) is Literal and any(type(word) is int for word in get_args(kind)))


def _is_word(kind: Any) -> bool:
    """Return whether a type's values are texts; a section may be its plug-in's name."""
    literal = get_origin(kind) is Literal and all(isinstance(word, str) for word in get_args(kind))
    return kind is str or literal or (isinstance(kind, type) and issubclass(kind, BaseModel))


def _is_mapping(kind: Any) -> bool:
    origin = get_origin(kind) or kind
    return isinstance(origin, type) and issubclass(origin, Mapping | BaseModel)


# --- errors ---------------------------------------------------------------------------------------------------------


def explain(
    model: type[BaseModel],
    error: ValidationError,
    from_flags: Mapping[str, Setting],
    *,
    prefix: str = "",
    where: str = "",
) -> list[str]:
    """Return a line for each problem of a specification: the field by the name that the user gave it, what is wrong.

    Args:
        model: the specification.
        error: pydantic's error.
        from_flags: settings that came from flags, by short name.
        prefix: prefix of those flags.
        where: put before the paths of all other fields.
    """
    flags = {
        setting.path: "/".join((*ALIASES.get(prefix + name, ()), flag_name(name, prefix)))
        for name, setting in from_flags.items()
    }
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
        # a section's own error belongs to the flag that chose its plug-in; what is inside a value, to the value's flag
        places = (path, (*path, "name"), path[:2], path[:1])
        place = next((place for place in places if place in flags), None)
        name = where + ".".join(path)
        if place is not None:
            inside = [part for part in path[len(place) :] if part.isidentifier()]
            name = ": ".join((flags[place], *inside))
        if item["type"] == "extra_forbidden":
            known = ", ".join(_fields_at(model, path[:-1]))
            lines.append(f"{name}: no such field" + (f"; there are {known}" if known else ""))
        else:
            if place is not None and item["type"] in ("dict_type", "mapping_type"):
                message = "expected a JSON object"
            given = item.get("input")
            shown = f" (got {given!r})" if isinstance(given, str | int | float | bool) else ""
            lines.append(f"{name}: {message[:1].lower()}{message[1:]}{shown}")
    return lines


def _fields_at(model: type[BaseModel], path: tuple[str, ...]) -> list[str]:
    """Return the names of the fields beside an unknown one; sections name their own."""
    if not path:
        return list(model.model_fields)
    return [setting.path[1] for setting in settings().values() if setting.path[:-1] == path]


# --- help texts -----------------------------------------------------------------------------------------------------


def choices_of(info: FieldInfo) -> tuple[str, ...]:
    """Return the words a field allows, or nothing if it is not a choice."""
    extra = info.json_schema_extra
    if isinstance(extra, dict) and isinstance(extra.get("enum"), list):
        return tuple(str(word) for word in extra["enum"])  # type: ignore[union-attr]
    words: list[str] = []
    for kind in _kinds(info.annotation):
        if get_origin(kind) is Literal:
            words += [str(word) for word in get_args(kind)]
        elif kind is type(None):
            words.append("none")
        else:
            return ()
    return tuple(words)


def metavar(setting: Setting) -> str:
    """Return the placeholder of a setting's value: ``NAME``, ``INTEGER``, ``2|3|none``; empty for a switch."""
    if setting.choices:
        return "NAME"
    if setting.is_switch:
        return ""
    words = (word for each in setting.declarations() for word in _placeholder(each.info).split("|"))
    return "|".join(dict.fromkeys(words))


def _placeholder(info: FieldInfo) -> str:
    choices = choices_of(info)
    if info.annotation is bool:
        return "true|false"
    if choices:
        return "|".join(choices)
    kinds = _kinds(info.annotation)
    for kind in kinds:
        if get_origin(kind) in (tuple, list):
            return "INT,INT,..."
        if _is_mapping(kind):
            return "JSON"
    word = "INTEGER" if int in kinds else "NUMBER" if float in kinds else "TEXT"
    return f"{word}|none" if type(None) in kinds else word


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


def help_text(setting: Setting) -> str:
    """Return what a setting is, its choices, its bounds and the plug-ins that have it."""
    texts = []
    for each in setting.declarations():
        text = each.info.description or each.info.title or ""
        if each.choices:
            text += f" One of {', '.join(each.choices)}."
        if limits := limits_text(each.info):
            text += f" [{limits}]"
        if each.plugins:
            text += f" ({each.path[0]} {', '.join(each.plugins)})"
        texts.append(text.strip())
    return " ".join(texts)
