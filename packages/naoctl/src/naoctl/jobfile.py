"""Read a job from a YAML, TOML or JSON file. The file holds what ``POST /jobs`` takes."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from naoctl.errors import InvalidInput

#: Largest job file, bytes. A job is a page of text; anything longer is a mistake or an attack.
MAX_BYTES = 256 * 1024
#: Deepest nesting of a job file.
MAX_DEPTH = 16


class _PlainLoader(yaml.SafeLoader):
    """Load plain data only: no tags that build objects, no aliases (which can grow without bound), no double keys."""

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
                raise yaml.MarkedYAMLError(problem=f"{key!r} is no field name", problem_mark=key_node.start_mark)
            if key in seen:
                raise yaml.MarkedYAMLError(problem=f"{key} stands there twice", problem_mark=key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


def load_job_file(path: Path) -> dict[str, Any]:
    """Read a job file; its ending (.yaml, .yml, .toml or .json) names the format.

    Returns:
        The mapping the file holds, nothing of it checked yet.

    Raises:
        InvalidInput: naming file, line where known, and what is wrong.
    """
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
        text = raw.decode("utf-8")
    except UnicodeDecodeError:
        raise InvalidInput(f"{path} is not UTF-8 text", fix="Save it as UTF-8.") from None
    except OSError as error:
        raise InvalidInput(f"Cannot read {path}: {error.strerror}", fix="Check the path.") from None
    if len(raw) > MAX_BYTES:
        raise InvalidInput(f"{path} is longer than {MAX_BYTES // 1024} kB", fix="A job file is a page of text.")
    readers: dict[str, Callable[[str], Any]] = {
        ".yaml": _from_yaml,
        ".yml": _from_yaml,
        ".toml": tomllib.loads,
        ".json": _from_json,
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InvalidInput(
            f"{path} has no ending that names its format", fix=f"Use one of {', '.join(sorted(readers))}."
        )
    try:
        data = reader(text)
    except yaml.MarkedYAMLError as error:
        line = f" line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise InvalidInput(f"{path}{line}: {error.problem}", fix="Correct the file.") from None
    except (yaml.YAMLError, tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
        reason = "too deeply nested" if isinstance(error, RecursionError) else str(error).splitlines()[0]
        raise InvalidInput(f"{path}: {reason}", fix="Correct the file.") from None
    if not isinstance(data, dict):
        raise InvalidInput(f"{path} holds no fields", fix="Write `spec:` and the training's fields below it.")
    if _depth(data) > MAX_DEPTH:
        raise InvalidInput(f"{path} is nested too deeply", fix="A job has two levels: `spec:` and its fields.")
    return data


def _from_yaml(text: str) -> Any:
    return yaml.load(text, Loader=_PlainLoader)  # noqa: S506 - a SafeLoader that refuses even more


def _from_json(text: str) -> Any:
    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        result = dict(pairs)
        if len(result) != len(pairs):
            raise ValueError("a field stands there twice")
        return result

    def refuse(word: str) -> Any:
        raise ValueError(f"{word} is no JSON number")

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
