"""Named values for settings that a specification leaves out; one YAML file per preset beside this module.

A preset has a ``summary``, values for the sections ``algorithm`` and ``task``, and under ``robots`` values that replace
them for a robot family. A value applies only where the chosen algorithm or task has a setting of that name, and has it
from a class of this project: what a plug-in's model declares itself keeps its default.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any

import yaml

SECTIONS = ("algorithm", "task")
"""Sections that a preset may set."""


def names() -> tuple[str, ...]:
    """Return the names of all presets, ``fast`` first."""
    found = [file.name.removesuffix(".yaml") for file in files(__name__).iterdir() if file.name.endswith(".yaml")]
    return tuple(sorted(found, key=lambda name: (name != "fast", name)))


@cache
def read(name: str) -> dict[str, Any]:
    """Return the content of a preset's file.

    Raises:
        ValueError: if there is no such preset; the message lists those that exist.
    """
    if name not in names():
        raise ValueError(f"unknown preset {name!r}: choose one of {', '.join(names())}")
    content: dict[str, Any] = yaml.safe_load((files(__name__) / f"{name}.yaml").read_text(encoding="utf-8"))
    if "extends" in content:
        base = read(content["extends"])
        content = {**base, **{key: value for key, value in content.items() if key != "extends"}}
    return content


def summary(name: str) -> str:
    """Return one line for users about a preset."""
    return str(read(name)["summary"])


def values(name: str, section: str, family: str | None) -> dict[str, Any]:
    """Return what a preset sets in a section for robots of a family."""
    content = read(name)
    own = content.get("robots", {}).get(family, {}).get(section, {})
    return {**content.get(section, {}), **own}
