"""Imports run one way: from services and commands down to the specification."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]

SOURCES = {
    "naospec": ROOT / "packages/naospec/src/naospec",
    "naosim": ROOT / "packages/naosim/src/naosim",
    "naopolicies": ROOT / "packages/naopolicies/src/naopolicies",
    "naosprint": ROOT / "packages/naosprint/src/naosprint",
    "naojobs": ROOT / "packages/naojobs/src/naojobs",
    "naoctl": ROOT / "packages/naoctl/src/naoctl",
    "naosprint_api": ROOT / "services/api/src/naosprint_api",
    "naosprint_worker": ROOT / "services/worker/src/naosprint_worker",
}

ALLOWED = {
    "naospec": set(),
    "naosim": {"naospec"},
    "naopolicies": set(),
    "naosprint": {"naospec", "naosim", "naopolicies"},
    "naojobs": {"naospec", "naopolicies"},
    "naoctl": {"naospec", "naopolicies", "naojobs", "naosim", "naosprint"},
    "naosprint_api": {"naospec", "naopolicies", "naojobs", "naosim", "naosprint"},
    "naosprint_worker": {"naospec", "naopolicies", "naosim", "naosprint", "naojobs"},
}
"""Project packages that each package may import."""

LAYERS = {
    "naosim": ("robots", "simulator", "launchers", ("simspark", "mujoco"), "kinds"),
    "naosprint": ("terms", "tasks", "rl", "analysis", "export", "matches"),
}
"""Parts of a package from bottom to top; a part may import those below it and itself."""

ON_DEMAND = {("naosim.robots.booster", "naosim.mujoco.shapes")}
"""Imports at the time of use: the shapes of a robot come from its simulator's model."""

HEAVY = {"torch", "stable_baselines3", "matplotlib", "gymnasium", "mujoco", "rcsssmj"}


@cache
def modules(package: str) -> tuple[tuple[str, ast.Module], ...]:
    """Return every module of a package by its dotted name."""
    folder, found = SOURCES[package], []
    for path in sorted(folder.rglob("*.py")):
        parts = [package, *path.relative_to(folder).with_suffix("").parts]
        found.append((".".join(part for part in parts if part != "__init__"), ast.parse(path.read_text())))
    return tuple(found)


def imported(tree: ast.AST) -> Iterator[str]:
    """Yield the dotted names that a module imports anywhere."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def at_import(tree: ast.Module) -> Iterator[str]:
    """Yield the dotted names that a module imports when it is imported itself."""

    def statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
        for node in body:
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
                continue
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                continue
            yield node

    for node in statements(tree.body):
        yield from imported(node)


@pytest.mark.parametrize("package", sorted(SOURCES))
def test_packages_import_only_those_below_them(package: str) -> None:
    wrong = {
        f"{module} imports {name}"
        for module, tree in modules(package)
        for name in imported(tree)
        if (top := name.split(".")[0]) in SOURCES and top != package and top not in ALLOWED[package]
    }
    assert not wrong


@pytest.mark.parametrize("package", sorted(LAYERS))
def test_parts_of_a_package_import_only_those_below_them(package: str) -> None:
    level = {
        name: height
        for height, names in enumerate(LAYERS[package])
        for name in ((names,) if isinstance(names, str) else names)
    }

    def part(name: str) -> str | None:
        words = name.split(".")
        return words[1] if len(words) > 1 and words[0] == package and words[1] in level else None

    wrong = set()
    for module, tree in modules(package):
        mine = part(module)
        for name in imported(tree):
            theirs = part(name)
            on_demand = any((module, name.rsplit(".", cut)[0]) in ON_DEMAND for cut in (0, 1))
            if mine and theirs and mine != theirs and level[theirs] >= level[mine] and not on_demand:
                wrong.add(f"{module} imports {name}")
    assert not wrong


def test_describing_tasks_and_robots_loads_nothing_heavy() -> None:
    """The API imports these to describe trainings; it has neither PyTorch nor MuJoCo."""
    light = [
        *((module, tree) for module, tree in modules("naospec")),
        *((module, tree) for module, tree in modules("naosprint") if module.split(".")[1:2] == ["tasks"]),
        *((module, tree) for module, tree in modules("naosim") if module.split(".")[1:2] == ["robots"]),
    ]
    wrong = {
        f"{module} imports {name}" for module, tree in light for name in at_import(tree) if name.split(".")[0] in HEAVY
    }
    assert not wrong


@pytest.mark.parametrize("package", sorted(SOURCES))
def test_no_module_imports_a_module_that_imports_it(package: str) -> None:
    """There are no circular imports when a module is loaded."""
    trees = dict(modules(package))
    # a module may take its siblings from the package that they share
    graph = {
        module: {name for name in at_import(tree) if name in trees and not f"{module}.".startswith(f"{name}.")}
        for module, tree in trees.items()
    }
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, " -> ".join((*path[path.index(module) :], module))
        if module in done:
            return
        for name in sorted(graph[module]):
            visit(name, (*path, module))
        done.add(module)

    for module in graph:
        visit(module, ())


def test_no_module_imports_another_in_a_circle() -> None:
    """Also not inside functions; what only type checkers import does not count."""
    edges: dict[str, set[str]] = {}
    for package in SOURCES:
        trees = dict(modules(package))
        for name, tree in trees.items():
            checked = {id(each) for node in ast.walk(tree) if _is_for_types(node) for each in ast.walk(node)}
            found = (node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and id(node) not in checked)
            targets = {
                target
                for node in found
                for alias in node.names
                for target in (f"{node.module}.{alias.name}", node.module)
                if target in trees and not alias.name.startswith("_")
            }
            edges[name] = {target for target in targets if not any(more.startswith(f"{target}.") for more in targets)}
            edges[name].discard(name)
    while leaves := {name for name, targets in edges.items() if not targets & edges.keys()}:
        edges = {name: targets for name, targets in edges.items() if name not in leaves}
    while roots := edges.keys() - set().union(*edges.values()):
        edges = {name: targets for name, targets in edges.items() if name not in roots}
    assert not edges


def _is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
