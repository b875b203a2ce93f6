"""Job files in YAML, TOML or JSON; their content is the body of ``POST /jobs``."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from naospec.files import open_regular

MAX_BYTES = 256 * 1024
"""Maximum size of a job file in bytes."""
MAX_DEPTH = 16
"""Maximum nesting of a job file."""
_MAX_DOTS = 64
JOB_FIELDS = (
    "name",
    "tags",
    "spec",
    "evaluation",
    "priority",
    "not_before",
    "max_attempts",
    "parent_job_id",
    "parent_checkpoint_id",
    "parent_policy",
)
"""Fields that a job file may have."""


class JobFileError(ValueError):
    """Job file that cannot be read; `fix` is what to do about it."""

    def __init__(self, message: str, *, fix: str) -> None:
        super().__init__(f"{message}. {fix}")
        self.message = message
        self.fix = fix


class _PlainLoader(yaml.SafeLoader):
    """Loader of plain data: no tags that create objects, no aliases (they can expand without bound), no duplicates."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.MarkedYAMLError(problem="aliases (*name) are not allowed in a job file", problem_mark=mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.MarkedYAMLError(problem=f"{key!r} is not a field name", problem_mark=key_node.start_mark)
            if key in seen:
                raise yaml.MarkedYAMLError(problem=f"{key} is given twice", problem_mark=key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


def load_job_file(path: Path) -> dict[str, Any]:
    """Read a job file; its suffix (.yaml, .yml, .toml or .json) decides the format.

    Returns:
        The file's mapping, not validated.

    Raises:
        JobFileError: with file, line if known, and what is wrong.
    """
    try:
        with open_regular(path) as file:
            raw = file.read(MAX_BYTES + 1)
        text = raw.decode("utf-8")
    except UnicodeDecodeError:
        raise JobFileError(f"{path} is not UTF-8 text", fix="Save it as UTF-8.") from None
    except OSError as error:
        raise JobFileError(f"Cannot read {path}: {error.strerror}", fix="Check the path.") from None
    if len(raw) > MAX_BYTES:
        raise JobFileError(f"{path} is longer than {MAX_BYTES // 1024} kB", fix="Use a shorter file.")
    readers: dict[str, Callable[[str], Any]] = {
        ".yaml": _from_yaml,
        ".yml": _from_yaml,
        ".toml": _from_toml,
        ".json": _from_json,
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise JobFileError(f"{path} has no known suffix", fix=f"Use one of {', '.join(sorted(readers))}.")
    try:
        data = reader(text)
    except yaml.MarkedYAMLError as error:
        line = f" line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise JobFileError(f"{path}{line}: {error.problem}", fix="Correct the file.") from None
    except (yaml.YAMLError, tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
        reason = "too deeply nested" if isinstance(error, RecursionError) else str(error).splitlines()[0]
        raise JobFileError(f"{path}: {reason}", fix="Correct the file.") from None
    if not isinstance(data, dict):
        raise JobFileError(f"{path} has no fields", fix="Write `spec:` and the training's fields below it.")
    if _depth(data) > MAX_DEPTH:
        raise JobFileError(f"{path} is nested too deeply", fix="Reduce the nesting.")
    return data


def _from_yaml(text: str) -> Any:
    return yaml.load(text, Loader=_PlainLoader)  # noqa: S506 - a SafeLoader that refuses even more


def _from_toml(text: str) -> Any:
    # The time and memory of tomllib grow with the square of the parts of a dotted key.
    for number, line in enumerate(text.splitlines(), start=1):
        if any(part.count(".") > _MAX_DOTS for part in re.split(r"[][{}=,#]", line)):
            raise ValueError(f"line {number}: a key of more than {_MAX_DOTS} parts")
    return tomllib.loads(text)


def _from_json(text: str) -> Any:
    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        result = dict(pairs)
        if len(result) != len(pairs):
            raise ValueError("a field is given twice")
        return result

    def refuse(word: str) -> Any:
        raise ValueError(f"{word} is not a JSON number")

    return json.loads(text, object_pairs_hook=unique, parse_constant=refuse)


def _depth(value: Any) -> int:
    deepest, level = 0, [(value, 1)]
    while level:
        item, depth = level.pop()
        deepest = max(deepest, depth)
        if depth > MAX_DEPTH:
            return depth
        children = item.values() if isinstance(item, dict) else item if isinstance(item, list) else ()
        level += [(child, depth + 1) for child in children if isinstance(child, dict | list)]
    return deepest
