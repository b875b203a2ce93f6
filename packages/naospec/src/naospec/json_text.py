"""JSON for files that people read and compare: arrays of plain values and short objects on one line each."""

from __future__ import annotations

import json
from typing import Any

WIDTH = 1200
"""Longest object that stays on one line, characters."""


def json_text(value: Any, *, sort_keys: bool = False) -> str:
    """Return ``value`` as JSON with a line break at the end.

    Args:
        value: what ``json.dumps`` accepts.
        sort_keys: whether the keys of objects are sorted.

    Raises:
        ValueError: if a number is not finite.
    """
    return _render(json.loads(json.dumps(value, sort_keys=sort_keys, allow_nan=False)), 0) + "\n"


def _render(value: Any, depth: int) -> str:
    line = json.dumps(value, ensure_ascii=False)
    if not isinstance(value, dict | list) or len(line) + depth <= WIDTH:
        return line
    if isinstance(value, list) and not any(isinstance(item, dict | list) for item in value):
        return line
    indent = " " * depth
    if isinstance(value, dict):
        opening, closing = "{", "}"
        lines = [f"{json.dumps(key, ensure_ascii=False)}: {_render(item, depth + 1)}" for key, item in value.items()]
    else:
        opening, closing = "[", "]"
        lines = [_render(item, depth + 1) for item in value]
    return opening + "\n" + ",\n".join(f"{indent} {item}" for item in lines) + f"\n{indent}{closing}"
