"""The reference pages are complete, and their tables match the code."""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
from naoctl.cli import build_app
from naojobs.events import EVENT_KINDS
from naojobs.models import Event
from naojobs.settings import ServiceSettings
from naojobs.states import WorkState
from naospec import EvaluationSpec, TrainingSpec, flat, plugins, presets, recipes
from naosprint.rl.columns import columns
from naosprint_api.app import openapi_document
from naosprint_api.settings import ApiSettings
from naosprint_api.telemetry import Telemetry
from naosprint_worker.settings import WorkerSettings
from typer.main import get_command

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    path = ROOT / "docs" / "generate_reference.py"
    spec = importlib.util.spec_from_file_location("generate_reference", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["generate_reference"] = module
    spec.loader.exec_module(module)
    return dict(module.pages())


def first_column(page: str) -> set[str]:
    """Return the code in the first cells of a page's tables."""
    return set(re.findall(r"^\| `([^`]+)`", page, re.MULTILINE))


def leaves(command: click.Command, path: str) -> Iterator[tuple[str, click.Command]]:
    children = getattr(command, "commands", {})
    for name, child in children.items():
        yield from leaves(child, f"{path} {name}")
    if not children and not command.hidden:
        yield path, command


def test_every_command_and_option_of_naoctl_is_there(pages: dict[str, str]) -> None:
    page = pages["naoctl.md"]
    found = dict(leaves(get_command(build_app()), "naoctl"))
    assert len(found) > 20
    for path, command in found.items():
        (section,) = re.findall(rf"^#+ {path}$(.*?)(?=^#|\Z)", page, re.MULTILINE | re.DOTALL)
        for parameter in command.params:
            for option in parameter.opts if isinstance(parameter, click.Option) and not parameter.hidden else ():
                assert option in section or option == "--help", f"{path} {option}"


def test_every_command_of_the_other_programs_is_there(pages: dict[str, str]) -> None:
    for page, names in {
        "naosprint.md": ("train", "evaluate", "report", "export"),
        "naosim.md": ("check", "bench", "robot", "serve"),
    }.items():
        for name in names:
            assert re.search(rf"^## .* {name}$", pages[page], re.MULTILINE), name
    assert "--agent-port" in pages["naosim.md"] and "--script-path" not in pages["naosim.md"]
    assert "### python -m naojobs token create" in pages["administration.md"]


def test_every_setting_of_a_specification_is_there(pages: dict[str, str]) -> None:
    page = pages["specification.md"]
    training, rest = page.split("\n## Evaluation\n")
    evaluation, rest = rest.split("\n## Presets\n")
    preset_part, recipe_part = rest.split("\n## Recipes\n")
    assert set(TrainingSpec.model_fields) <= first_column(training)
    for section, group in flat.GROUPS.items():
        (part,) = re.findall(rf"^### {section}$(.*?)(?=^##|\Z)", page, re.MULTILINE | re.DOTALL)
        settings = {setting.path[1] for setting in flat.settings().values() if setting.path[0] == section}
        assert first_column(part) == set(plugins.names(group)) | (settings - {"name"})
    assert first_column(evaluation) == set(EvaluationSpec.model_fields)
    assert {f"algorithm.{name}" for name in presets.read("fast")["algorithm"]} <= first_column(preset_part)
    assert re.search(r"^\| `algorithm.clip_range` \| `0.2` \|.* `0.1` \|", preset_part, re.MULTILINE)
    assert first_column(recipe_part) == set(recipes.names())


def test_every_operation_and_schema_of_the_api_is_there(pages: dict[str, str]) -> None:
    page = pages["api.md"]
    document = openapi_document()
    for path, item in document["paths"].items():
        for method in item:
            assert f"\n### {method.upper()} {path}\n" in page
    for name, schema in document["components"]["schemas"].items():
        (section,) = re.findall(rf"^### {name}$(.*?)(?=^###|\Z)", page, re.MULTILINE | re.DOTALL)
        assert set(schema.get("properties", ())) <= first_column(section), name


def test_every_setting_is_there(pages: dict[str, str]) -> None:
    settings = first_column(pages["settings.md"])
    for model in (ServiceSettings, ApiSettings, WorkerSettings):
        for name, field in model.model_fields.items():
            assert field.description, name
            assert f"NAOSPRINT_{name.upper()}" in settings
    # Environment variables that `naoctl` reads anywhere.
    sources = (ROOT / "packages" / "naoctl" / "src").rglob("*.py")
    read = {name for path in sources for name in re.findall(r"NAOCTL_[A-Z_]+", path.read_text(encoding="utf-8"))}
    assert read <= settings


def test_every_metric_is_there(pages: dict[str, str]) -> None:
    page = pages["metrics.md"]
    registered = {name for name in Telemetry(None)._registry._names_to_collectors if name.startswith("naosprint_")}  # type: ignore[arg-type]
    assert first_column(page) >= {metric.name for metric in columns(TrainingSpec())}
    assert first_column(page) >= {name for name, *_ in Telemetry.catalogue()}
    named = {name for name, *_ in Telemetry.catalogue()}
    parts = re.compile(r"_(?:bucket|count|sum|created|total)$")
    assert {parts.sub("", name) for name in registered} == {parts.sub("", name) for name in named}


def test_every_state_is_there_with_its_meaning(pages: dict[str, str]) -> None:
    for state in WorkState:
        assert re.search(rf"^\| `{state}` \| \w+", pages["events.md"], re.MULTILINE), state


def test_every_kind_of_event_that_the_code_records_is_documented(pages: dict[str, str]) -> None:
    recorded: dict[str, set[str]] = {}
    for folder in ("packages/naojobs/src", "services/worker/src", "services/api/src"):
        for path in (ROOT / folder).rglob("*.py"):
            for kind, data in kinds_in(ast.parse(path.read_text(encoding="utf-8"))):
                recorded.setdefault(kind, set()).update(data)
    # Those of a change of state have its name.
    entered = {str(state) for state in WorkState} - {"starting", "pausing"}
    assert recorded.keys() | entered == EVENT_KINDS.keys()
    for kind, data in recorded.items():
        assert data <= set(EVENT_KINDS[kind].data), kind
    assert set(EVENT_KINDS) <= first_column(pages["events.md"])
    assert all(len(kind) <= Event.__table__.c.kind.type.length for kind in EVENT_KINDS)


def kinds_in(tree: ast.AST) -> Iterator[tuple[str, set[str]]]:
    """Find the literal kinds in calls that record an event, with the literal names in their data."""
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
        at: dict[str, int] = {"add_event": 2, "event": 0}
        values: list[ast.expr] = []
        if name in at and len(call.args) > at[name]:
            values = _literals(call.args[at[name]])
        elif name == "Event":
            values = [word.value for word in call.keywords if word.arg == "kind"]
        dictionaries = [*call.args, *(word.value for word in call.keywords)]
        data = {
            str(key.value)
            for one in dictionaries
            if isinstance(one, ast.Dict)
            for key in one.keys
            if isinstance(key, ast.Constant)
        }
        for value in values:
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield value.value, data


def _literals(value: ast.expr) -> list[ast.expr]:
    return [value.body, value.orelse] if isinstance(value, ast.IfExp) else [value]


def test_a_table_says_all_that_a_schema_allows(pages: dict[str, Any]) -> None:
    page = pages["specification.md"]
    assert "| `batch_size` | whole number ≥ 2, ≤ 4,194,304 | `2048` |" in page
    assert "| `target_kl` | number > 0, ≤ 10 or null |" in page
    assert "one of `minibatch`" not in page and "`minibatch`, `rollout`, `none`" in page
