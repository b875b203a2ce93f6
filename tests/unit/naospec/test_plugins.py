"""Plug-ins are found by name, and broken ones are named with their package."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.metadata import EntryPoint
from importlib.util import spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
from naospec import TrainingSpec, plugins, validation_words
from pydantic import BaseModel, ValidationError


class Wrong:
    """Task whose settings are not a section."""

    version = 1

    class Parameters(BaseModel):
        pass


@pytest.fixture
def offered(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[EntryPoint]]:
    """Return a list of tasks that are installed besides the real ones."""
    extra: list[EntryPoint] = []
    real = plugins.entry_points
    monkeypatch.setattr(
        plugins, "entry_points", lambda group: [*real(group=group), *(e for e in extra if e.group == group)]
    )
    plugins._entries.cache_clear()
    plugins.load.cache_clear()
    yield extra
    plugins._entries.cache_clear()
    plugins.load.cache_clear()


def entry(name: str, value: str) -> EntryPoint:
    return EntryPoint(name, value, plugins.TASKS)


def words_of(content: dict[str, Any]) -> str:
    with pytest.raises(ValidationError) as caught:
        TrainingSpec.model_validate(content)
    return validation_words(caught.value.errors())


def test_groups_have_what_this_project_offers() -> None:
    assert {"sprint1", "sprint1-erect", "sprint2", "sprint2-erect"} <= set(plugins.names(plugins.TASKS))
    assert {"nao-0", "nao-4"} <= set(plugins.names(plugins.ROBOTS))
    assert {"embedded", "server"} <= set(plugins.names(plugins.SIMULATORS))
    assert "ppo" in plugins.names(plugins.LEARNERS)
    for name in plugins.names(plugins.TASKS):
        assert plugins.load(plugins.TASKS, name).name == name


def test_unknown_names_list_the_known() -> None:
    with pytest.raises(
        plugins.UnknownPluginError, match=r"unknown task 'swim': choose one of .*sprint1, sprint1-erect"
    ):
        plugins.load(plugins.TASKS, "swim")


def test_plugins_of_one_package_load_in_several_threads(
    offered: list[EntryPoint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when a page of the dashboard requests tasks and algorithms at once."""
    found, never = threading.Event(), threading.Event()
    init = tmp_path / "crawling" / "__init__.py"
    init.parent.mkdir()
    init.write_text("from crawling.slow import Crawl\n")
    (tmp_path / "crawling" / "slow.py").write_text("class Crawl: pass\n")

    class SlowDisk(MetaPathFinder, SourceFileLoader):
        def find_spec(self, name: str, *_: Any) -> ModuleSpec | None:
            return spec_from_file_location(name, init, loader=self) if name == "crawling" else None

        def create_module(self, _: ModuleSpec) -> None:
            found.set()
            never.wait(0.3)  # meanwhile the other thread needs this package

    monkeypatch.setattr(sys, "meta_path", [SlowDisk("crawling", str(init)), *sys.meta_path])
    offered += [entry("crawl", "crawling:Crawl"), entry("crawl-slowly", "crawling.slow:Crawl")]
    with ThreadPoolExecutor() as pool:
        package = pool.submit(plugins.load, plugins.TASKS, "crawl")
        assert found.wait(10)
        module = pool.submit(plugins.load, plugins.TASKS, "crawl-slowly")
        assert package.result() is module.result()


def test_a_package_that_cannot_be_imported_is_named(offered: list[EntryPoint]) -> None:
    offered.append(entry("swim", "no_such_package:Swim"))
    assert "swim" in plugins.names(plugins.TASKS)
    with pytest.raises(plugins.BrokenPluginError, match=r"swim: package no_such_package:Swim .*No module named"):
        plugins.load(plugins.TASKS, "swim")


def test_a_name_that_is_offered_twice_is_refused(offered: list[EntryPoint]) -> None:
    offered.append(entry("sprint1", "elsewhere:Sprint"))
    with pytest.raises(plugins.BrokenPluginError, match=r"'sprint1' is offered twice, as .* and elsewhere:Sprint"):
        plugins.names(plugins.TASKS)


def test_the_same_entry_twice_is_one(offered: list[EntryPoint]) -> None:
    """As after an editable installation beside an old one."""
    offered.append(entry("sprint1", "naosprint.tasks.sprint:Sprint1"))
    assert plugins.names(plugins.TASKS).count("sprint1") == 1


def test_settings_must_be_a_section(offered: list[EntryPoint]) -> None:
    offered.append(entry("wrong", f"{__name__}:Wrong"))
    with pytest.raises(plugins.BrokenPluginError, match=r"wrong: its settings must subclass naospec.Section"):
        TrainingSpec.model_validate({"task": "wrong"})
