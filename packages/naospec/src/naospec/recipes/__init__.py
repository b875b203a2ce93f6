"""Tested jobs, as YAML files beside this module.

A file has a ``summary`` and the fields of ``POST /jobs``. With ``after`` the stages of another recipe come first, with
``task`` settings that differ in them.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any

import yaml


def names() -> tuple[str, ...]:
    """Return the names of all recipes."""
    found = (file.name for file in files(__name__).iterdir())
    return tuple(sorted(name.removesuffix(".yaml") for name in found if name.endswith(".yaml")))


@cache
def _read(name: str) -> str:
    if name not in names():
        raise ValueError(f"unknown recipe {name!r}: choose one of {', '.join(names()) or 'none'}")
    return (files(__name__) / f"{name}.yaml").read_text(encoding="utf-8")


def summary(name: str) -> str:
    """Return one line for users about a recipe.

    Raises:
        ValueError: if there is no such recipe; the message lists those that exist.
    """
    return str(yaml.safe_load(_read(name))["summary"])


def job(name: str, start: str | None = None) -> dict[str, Any]:
    """Return the job of a recipe, not validated yet: name, tags, spec and evaluation.

    Args:
        name: the recipe.
        start: policy to start from instead. It replaces the stages up to those of the recipe of its name; if there are
            none of that name, all but the recipe's own. The recipe's own `parent_policy` is left out, too.

    Raises:
        ValueError: if there is no such recipe; the message lists those that exist.
    """
    content: dict[str, Any] = yaml.safe_load(_read(name))
    after = content.pop("after", None)
    if after is not None and (start is None or start in _before(after["recipe"])):
        content["spec"] = _after(job(after["recipe"], start)["spec"], after.get("task", {}), content["spec"])
    left_out = ("summary",) if start is None else ("summary", "parent_policy")
    return {"name": name, **{key: value for key, value in content.items() if key not in left_out}}


def shortened(name: str, start: str) -> str | None:
    """Return a sentence on the stages of a recipe that a policy to start from replaces; None if it replaces none."""
    kept, all_stages = (len(job(name, each)["spec"].get("stages", ())) for each in (start, None))
    last = f"the last {kept}" if kept > 1 else "only the last"
    return f"--recipe {name}: {last} of its {all_stages} stages, after {start}" if kept < all_stages else None


def _before(name: str) -> list[str]:
    """Return the recipes whose stages come before those of a recipe."""
    after = yaml.safe_load(_read(name)).get("after")
    return [] if after is None else [after["recipe"], *_before(after["recipe"])]


def _after(first: dict[str, Any], task: dict[str, Any], then: dict[str, Any]) -> dict[str, Any]:
    """Return a specification with the stages of ``first``, with these task settings, and then its own."""
    robot = first["robot"]
    if not isinstance(robot, str) and robot != then["robot"]:
        raise ValueError(f"after: its robot {robot} has settings, so both must have the same, not {then['robot']}")
    shared = {key: value for key, value in first["algorithm"].items() if key not in ("name", "preset")}
    stages = [
        {
            **({"robot": robot} if isinstance(robot, str) else {}),
            **stage,
            "algorithm": {**shared, **stage.get("algorithm", {})},
            "task": {**task, **stage.get("task", {})},
        }
        for stage in first["stages"]
    ]
    return {**then, "stages": [*stages, *then["stages"]]}
