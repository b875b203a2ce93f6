"""Comparison of results with a record."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from naospec.json_text import json_text

RECORDS = Path(__file__).parent / "records"

ADVICE = (
    "If the change is intended, record again: `python tests/regression/record.py`, and review the diff of "
    "tests/regression/records."
)

_SHOWN = 20


def read_record(name: str) -> Any:
    """Return the content of one record."""
    return json.loads((RECORDS / f"{name}.json").read_text())


def write_record(name: str, content: Any) -> None:
    """Write one record."""
    RECORDS.mkdir(exist_ok=True)
    (RECORDS / f"{name}.json").write_text(json_text(content, sort_keys=True), encoding="utf-8")


def differences(recorded: Any, found: Any, name: str = "") -> list[str]:
    """Return one line for each value that differs to the last digit, by its dotted name."""
    if isinstance(recorded, dict) and isinstance(found, dict):
        lines = []
        for key in sorted(recorded.keys() | found.keys()):
            inner = f"{name}.{key}" if name else key
            if key not in found:
                lines.append(f"{inner}: missing")
            elif key not in recorded:
                lines.append(f"{inner}: not in the record")
            else:
                lines += differences(recorded[key], found[key], inner)
        return lines
    if isinstance(recorded, list) and isinstance(found, list) and len(recorded) == len(found):
        pairs = enumerate(zip(recorded, found, strict=True))
        return [line for i, (old, new) in pairs for line in differences(old, new, f"{name}[{i}]")]
    # 1 and 1.0 and True are equal in Python, but not in JSON
    if type(recorded) is type(found) and recorded == found:
        return []
    return [f"{name}: recorded {_short(recorded)}, found {_short(found)}"]


def outside(recorded: float, found: float, name: str, *, relative: float = 0.0, absolute: float = 0.0) -> list[str]:
    """Return a line if a value is further from the recorded one than the larger tolerance allows."""
    tolerance = max(relative * abs(recorded), absolute)
    if abs(found - recorded) <= tolerance:
        return []
    return [f"{name}: recorded {recorded:g}, found {found:g}, tolerance {tolerance:g}"]


def message(lines: list[str]) -> str:
    """Return what an assertion prints about differences."""
    shown = lines[:_SHOWN]
    if len(lines) > _SHOWN:
        shown.append(f"and {len(lines) - _SHOWN} more")
    return "\n".join(["not as recorded:", *shown, ADVICE])


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 120 else f"{text[:117]}..."
