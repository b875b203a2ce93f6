"""The pages for those who add a simulator or a robot: their code runs, and the tests use the same code."""

from __future__ import annotations

import importlib.util
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
from naosim.robots import Robot
from naosim.simulator import SimulatorKind
from naosprint.tasks.observations import BLOCKS

from . import documents

HOW_TO = documents.ROOT / "docs" / "how-to"
TOY = documents.ROOT / "tests" / "unit" / "naosim" / "toy_simulator.py"


def run(page: str, folder: Path) -> ModuleType:
    """Import all Python of a page as one module."""
    path = folder / f"{page.replace('-', '_')}.py"
    path.write_text("\n\n".join(documents.blocks(HOW_TO / f"{page}.md", "python")))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = sys.modules[path.stem] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(("page", "offered"), [("own-simulator", 2), ("own-robot", 4)])
def test_the_pages_code_runs_and_offers_what_its_entry_points_name(page: str, offered: int, tmp_path: Path) -> None:
    module = run(page, tmp_path)
    metadata = [tomllib.loads(text) for text in documents.blocks(HOW_TO / f"{page}.md", "toml")]
    groups = [item for each in metadata for item in each["project"]["entry-points"].items()]
    kinds = {"naosim.simulators": SimulatorKind, "naosim.robots": Robot}
    entries = [(group, name, value) for group, values in groups for name, value in values.items()]
    assert len(entries) == offered
    for group, name, value in entries:
        plugin = getattr(module, value.partition(":")[2])
        if group == "naosprint.robots":
            assert set(plugin(module.WALKER).observations) <= set(BLOCKS)
            continue
        assert isinstance(plugin, kinds[group])
        assert plugin.name == name


def test_the_page_quotes_the_robots_that_the_tests_install() -> None:
    package = documents.ROOT / "tests" / "packages" / "naosim-crouched"
    code = (package / "naosim_crouched.py").read_text().partition("from __future__ import annotations\n\n")[2]
    assert documents.blocks(HOW_TO / "own-robot.md", "python")[0].rstrip() == code.rstrip()
    assert documents.blocks(HOW_TO / "own-robot.md", "toml")[0] == (package / "pyproject.toml").read_text()


def test_the_page_quotes_the_simulator_that_the_tests_use() -> None:
    quoted = "\n\n\n".join(text.rstrip() for text in documents.blocks(HOW_TO / "own-simulator.md", "python")[:3])
    code = TOY.read_text().partition("from __future__ import annotations\n\n")[2]
    assert quoted == code.rstrip()


def test_the_page_quotes_the_task_that_the_integration_test_installs() -> None:
    package = documents.ROOT / "tests" / "packages" / "naosprint-backwards"
    page = HOW_TO / "own-task.md"
    quoted = "\n\n\n".join(text.rstrip() for text in documents.blocks(page, "python")[:3])
    code = (package / "naosprint_backwards.py").read_text().partition("from __future__ import annotations\n\n")[2]
    assert quoted == code.rstrip()
    (metadata,) = documents.blocks(page, "toml")
    assert metadata == (package / "pyproject.toml").read_text()
    lines = sum(len(path.read_text().splitlines()) for path in package.rglob("*") if path.suffix in (".py", ".toml"))
    assert lines <= 120


def test_the_section_about_the_ball_quotes_its_example() -> None:
    package = documents.ROOT / "tests" / "packages" / "naosprint-push"
    code = (package / "naosprint_push.py").read_text()
    section = (HOW_TO / "own-task.md").read_text().partition("## Add a ball\n")[2].partition("\n## ")[0]
    quoted = section.split("```python\n")[1:]
    assert len(quoted) == 4
    for block in quoted:
        assert block.partition("```")[0] in code
    lines = sum(len(path.read_text().splitlines()) for path in package.rglob("*") if path.suffix in (".py", ".toml"))
    assert lines <= 120
