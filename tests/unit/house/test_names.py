"""Names: only the tasks name metrics of the sprint, and a public class has a name of its own."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[3]

METRICS = re.compile(r"distance_m|fallen|arrived|sprint1")

AT_HOME = (
    "packages/naosprint/src/naosprint/tasks/",
    "packages/naosprint/src/naosprint/export/skills/",
    "packages/naopolicies/",
)
"""Folders that may name them."""

DEFAULT_TASK = {
    "packages/naospec/src/naospec/fields.py": 1,
    "packages/naoctl/src/naoctl/demo.py": 1,
}
"""Files that name the default task, and on how many lines."""


def test_only_tasks_name_metrics_of_the_sprint() -> None:
    found: dict[str, list[str]] = {}
    for folder in ("packages", "services"):
        for path in (ROOT / folder).rglob("*"):
            name = path.relative_to(ROOT).as_posix()
            if path.suffix not in (".py", ".js") or "/build/" in name or "/vendor/" in name or name.startswith(AT_HOME):
                continue
            lines = [line.strip() for line in path.read_text().splitlines() if METRICS.search(line)]
            if len(lines) > DEFAULT_TASK.get(name, 0):
                found[name] = lines
    assert not found


def test_a_public_class_name_stands_once() -> None:
    """In all packages and services together."""
    found: dict[str, list[str]] = {}
    for path in [*ROOT.glob("packages/*/src/**/*.py"), *ROOT.glob("services/*/src/**/*.py")]:
        if "skills" in path.parts:
            continue  # copied into the code of teams
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    twice = {name: paths for name, paths in found.items() if len(paths) > 1}
    assert not twice, twice


def test_every_package_has_the_version_of_the_release() -> None:
    (release,) = re.findall(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    found = {}
    for path in (*ROOT.glob("packages/*/pyproject.toml"), *ROOT.glob("services/*/pyproject.toml")):
        (found[path],) = re.findall(r'^version = "(.*)"$', path.read_text(encoding="utf-8"), re.MULTILINE)
    for path in (*ROOT.glob("packages/*/src/*/__init__.py"), *ROOT.glob("services/*/src/*/__init__.py")):
        for number in re.findall(r'^__version__ = "(.*)"$', path.read_text(encoding="utf-8"), re.MULTILINE):
            found[path] = number
    for path in (*ROOT.glob("*.yml"), *ROOT.glob("deploy/**/*.yml"), ROOT / "Makefile", ROOT / ".env.example"):
        for number in re.findall(r"naosprint/[\w${}]+:(\d[\w.]*)", path.read_text(encoding="utf-8")):
            found[path, number] = number
    assert {where: number for where, number in found.items() if number != release} == {}
    assert len(found) > 15
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert newest is not None and newest[1] == release
