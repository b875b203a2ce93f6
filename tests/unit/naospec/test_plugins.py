"""Plug-ins are found by name, and broken ones are named with their package."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.metadata import EntryPoint
from importlib.util import spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
from naospec import TrainingSpec, plugins, validation_words
from naospec.flat import GROUPS, settings
from naosprint.tasks import Task
from pydantic import BaseModel, ValidationError


class Wrong(Task):
    """Task whose settings are not a section."""

    name = "wrong"
    summary = "Wrong."

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
    plugins._load.cache_clear()
    plugins.leave_out.cache_clear()
    yield extra
    plugins._entries.cache_clear()
    plugins._load.cache_clear()
    plugins.leave_out.cache_clear()


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
        plugins.UnknownPluginError,
        match=r"unknown task 'swim': choose one of .*sprint1, sprint1-erect.*, or install the package that offers it",
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
    offered += [EntryPoint("crawl", "crawling:Crawl", "toys"), EntryPoint("slow", "crawling.slow:Crawl", "toys")]
    with ThreadPoolExecutor() as pool:
        package = pool.submit(plugins.load, "toys", "crawl")
        assert found.wait(10)
        module = pool.submit(plugins.load, "toys", "slow")
        assert package.result() is module.result()


def test_a_package_that_cannot_be_imported_is_named(offered: list[EntryPoint]) -> None:
    offered.append(entry("swim", "no_such_package:Swim"))
    assert "swim" in plugins.names(plugins.TASKS)
    with pytest.raises(plugins.BrokenPluginError, match=r"swim: package no_such_package:Swim .*No module named"):
        plugins.load(plugins.TASKS, "swim")


def test_a_name_that_is_offered_twice_is_refused_with_both_packages(offered: list[EntryPoint]) -> None:
    """Nothing else of the group is."""
    offered.append(entry("sprint1", "elsewhere:Sprint"))
    assert plugins.names(plugins.TASKS).count("sprint1") == 1
    words = r"sprint1: package naosprint as .* and package elsewhere:Sprint as elsewhere:Sprint offer the same task; un"
    with pytest.raises(plugins.BrokenPluginError, match=words):
        plugins.load(plugins.TASKS, "sprint1")
    assert plugins.load(plugins.TASKS, "sprint2").name == "sprint2"
    assert plugins.find(plugins.TASKS, "sprint1") is None and plugins.find(plugins.TASKS, "swim") is None


def test_broken_plugins_are_left_out_and_named_once(broken: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Specifications, schemas and flags have all others."""
    schemas = [TrainingSpec.model_json_schema()["properties"] for _ in range(2)]
    for section, group in GROUPS.items():
        offered = {option["properties"]["name"]["const"] for option in schemas[1][section]["oneOf"]}
        known = settings()[section].choices
        assert offered == set(known) == set(plugins.names(group)) - {"sinks", "dives", "drifts", "limps"}
    assert settings()["reward_scale"].plugins == ()
    assert TrainingSpec(task="sprint1").task.name == "sprint1"
    told = [message.partition(": which")[0] for message in caplog.messages]
    for words in (
        "left out: sinks: package sinking offers it as sinking:sinks, which cannot be used: no water",
        "left out: limps: package lame offers it as lame:limps, which cannot be used: 3",
        "left out: drifts with robot t1: KeyError: 'depth'",
    ):
        assert told.count(words) == 1
    (doubled,) = (message for message in told if message.startswith("left out: dives: "))
    assert "package first-divers as " in doubled and "package second-divers as " in doubled
    with pytest.raises(plugins.BrokenPluginError, match="sinks: package sinking offers it"):
        TrainingSpec(task="sinks")


def test_refusals_name_what_can_be_used_without_broken_plugins(broken: Path) -> None:
    for content, words in (
        (
            {"robot": "t1", "task": {"name": "sprint1", "push_mps": 1.0}, "simulator": "server"},
            "use simulator embedded",
        ),
        ({"robot": "nao-0", "task": "getup"}, "use another task, or one of the robots k1, t1"),
    ):
        assert words in words_of(content)


def test_the_same_entry_twice_is_one(offered: list[EntryPoint]) -> None:
    """As after an editable installation beside an old one."""
    offered.append(entry("sprint1", "naosprint.tasks.sprint:Sprint1"))
    assert plugins.names(plugins.TASKS).count("sprint1") == 1


def test_a_task_and_an_algorithm_do_not_report_the_same_metric(install: Callable[..., None]) -> None:
    """A training's row has one value for each name, and both would be shown as the other's."""
    code = (
        "from naosprint.tasks import Metric, Task\n\n\nclass learns(Task):\n    name = summary = 'learns'\n"
        "    metrics = (Metric('learning_rate', 'Rate'),)\n"
    )
    install("learning", code, {"learns": plugins.TASKS})
    words = "task learns and algorithm ppo both have a metric learning_rate"
    assert words in words_of({"task": "learns"})


def test_settings_must_be_a_section(offered: list[EntryPoint]) -> None:
    offered.append(entry("wrong", f"{__name__}:Wrong"))
    with pytest.raises(plugins.BrokenPluginError, match=r"wrong: its settings must subclass naospec.Section"):
        TrainingSpec.model_validate({"task": "wrong"})


TOYS = """
from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from naosim import kinds, robots
from naosim.robots import RobotParameters
from naosim.simulator import Simulator, SimulatorKind
from naospec import LearnerSettings, TaskSettings, TrainingSpec, plugins
from naospec.metrics import Metric
from naosprint import tasks
from naosprint.arrays import AnyArray, IntArray
from naosprint.rl.learner import LearnerKind, learner_kind
from naosprint.tasks import Task
from naosprint.tasks.environment import Environment


class Swim(Task):
    name = "toy"
    summary = "Swim."
"""

REWARD, STEP, DEPTH = (f"Metric({name!r}, 'Depth')" for name in ("reward", "step", "depth"))


@pytest.mark.parametrize(
    ("group", "code", "message"),
    [
        (plugins.TASKS, "toy = object()", "a subclass of naosprint.tasks.Task, not object"),
        (plugins.TASKS, "toy = Swim.__new__(Swim)", "a subclass of naosprint.tasks.Task, not Swim"),
        (plugins.TASKS, "class toy(Task):\n name = 'toy'", "toy has no summary"),
        (plugins.TASKS, "class toy(Swim):\n name = 'dive'", "toy.name is 'dive', its entry point's 'toy'"),
        (plugins.TASKS, "class toy(Swim):\n def ended(self): return ()", "toy.ended: expected the parameters"),
        (
            plugins.TASKS,
            "class toy(Swim):\n def supports(self, robot): return True",
            "toy.supports must be a class",
        ),
        (plugins.TASKS, "class toy(Swim):\n measure = 3", "toy.measure must be a function, not int"),
        (plugins.TASKS, f"class toy(Swim):\n metrics = ({REWARD},)", "toy.metrics: every training reports 'reward'"),
        (plugins.TASKS, f"class toy(Swim):\n results = ({REWARD},)", "toy.results: every training reports 'reward'"),
        (plugins.TASKS, f"class toy(Swim):\n metrics = ({STEP},)", "toy.metrics: every training reports 'step'"),
        (plugins.TASKS, f"class toy(Swim):\n metrics = ({DEPTH}, {DEPTH})", "toy.metrics: 'depth' is given twice"),
        (plugins.TASKS, f"class toy(Swim):\n results = ({DEPTH}, {DEPTH})", "toy.results: 'depth' is given twice"),
        (
            plugins.TASKS,
            f"class toy(Swim):\n metrics = ({DEPTH},)\n results = ({DEPTH},)",
            "toy.results: 'depth' is given twice",
        ),
        (
            plugins.LEARNERS,
            f"class Kind(type(learner_kind('ppo'))):\n name = 'toy'\n metrics = ({REWARD},)\ntoy = Kind()",
            "Kind.metrics: every training reports 'reward'",
        ),
        (plugins.ROBOTS, "toy = 'nao-0'", "an instance of naosim.robots.Robot, not str"),
        (plugins.ROBOTS, "toy = robots.get('nao-0')", "Robot.name is 'nao-0'"),
        (
            plugins.SIMULATORS,
            "class Kind(SimulatorKind):\n name = 'toy'\n summary = 'Toy.'\n def supports(self, robot): return True\n"
            " def open(self, robot): ...\ntoy = Kind()",
            "Kind.open: expected the parameters",
        ),
        (
            plugins.SIMULATORS,
            "class Kind(SimulatorKind):\n name = 'toy'\n summary = 'Toy.'\n def supports(self, robot): return True\n"
            " def open(self, *values): ...\n def max_robots(self, most): return most\ntoy = Kind()",
            "Kind.max_robots: expected the parameters",
        ),
        (plugins.LEARNERS, "class Kind(LearnerKind):\n name = 'toy'\ntoy = Kind()", "class Kind .*load_policy"),
        (plugins.LEARNERS, "toy = LearnerKind", "an instance of naosprint.rl.learner.LearnerKind, not LearnerKind"),
    ],
)
def test_a_wrong_plugin_is_refused_with_package_class_and_method(
    group: str,
    code: str,
    message: str,
    offered: list[EntryPoint],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "naotoys.py").write_text(f"{TOYS}\n\n{code}\n", encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "naotoys", raising=False)
    offered.append(EntryPoint("toy", "naotoys:toy", group))
    with pytest.raises(plugins.BrokenPluginError, match=rf"toy: package naotoys:toy .* be used: .*{message}"):
        plugins.load(group, "toy")
    sys.modules.pop("naotoys", None)


def test_a_wrong_return_is_refused(offered: list[EntryPoint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "class toy(Swim):\n @classmethod\n def describe(cls) -> str: return ''"
    (tmp_path / "naotoys.py").write_text(f"{TOYS}\n\n{code}\n", encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    offered.append(EntryPoint("toy", "naotoys:toy", plugins.TASKS))
    with pytest.raises(plugins.BrokenPluginError, match=r"toy\.describe: it returns str, expected is dict"):
        plugins.load(plugins.TASKS, "toy")
    sys.modules.pop("naotoys", None)


def test_a_type_checker_sees_a_wrong_plugin(tmp_path: Path) -> None:
    """Overrides with another signature or return, a learner that lacks a method, settings and plug-ins used wrongly."""
    (tmp_path / "naotoys.py").write_text(
        f"""{TOYS}

class WrongReturn(Swim):
    def measure(self, rows: object) -> str:
        return ""


class WrongSignature(Swim):
    def ended(self) -> tuple[()]:
        return ()


class Missing(LearnerKind):
    name = "toy"


class WrongPolicy(LearnerKind):
    def load_policy(
        self,
        state: Mapping[str, AnyArray],
        settings: LearnerSettings,
        *,
        observations: Sequence[str],
        actions: Sequence[str],
    ) -> str:
        return ""

    def describe(self) -> str:
        return ""


class WrongRobot(RobotParameters):
    def applied(self, robot: robots.Robot) -> robots.Robot:
        return dataclasses.replace(robot, nominal_rad=0.5)


KIND = Missing()
robots.get("nao-0").fall_height_m


class SwimSettings(TaskSettings):
    depth_m: float = 2.0


class Dive(Task[SwimSettings]):
    def begin(self, rows: IntArray) -> None:
        self.arrays["depth"][rows] = self.parameters.depth_cm


def use(spec: TrainingSpec, simulator: Simulator) -> None:
    spec.task.depth_m
    SwimSettings.of(spec.task).depth_m + 1.0
    spec.algorithm.learning_rate
    robots.configured(spec.robot).joint
    tasks.get(spec.task.name).presentations
    kinds.get(spec.simulator.name).open(spec.robot, 1, spec.simulator)
    learner_kind(spec.algorithm.name).load(spec)
    plugins.load(plugins.ROBOTS, "t1").supports
    plugins.load(plugins.LEARNERS, "ppo").load_policy({{}}, spec.algorithm, observations=(), actions=()).acts
    plugins.load(plugins.TASKS, "sprint1").presentation.headlines
    Environment(simulator, Missing, spec.task)
    Environment(simulator, Dive, spec.simulator)
""",
        encoding="utf-8",
    )
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--no-error-summary", str(tmp_path / "naotoys.py")],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    for error in (
        'Return type "str" of "measure" incompatible',
        'Signature of "ended" incompatible with supertype "naosprint.tasks.base.Task"',
        'Cannot instantiate abstract class "Missing" with abstract attributes "load_policy" and "open"',
        '"Robot" has no attribute "fall_height_m"',
        '"SwimSettings" has no attribute "depth_cm"; maybe "depth_m"?',
        '"TaskSettings" has no attribute "depth_m"',
        '"LearnerSettings" has no attribute "learning_rate"',
        '"Robot" has no attribute "joint"; maybe "joints"?',
        '"type[Task[TaskSettings]]" has no attribute "presentations"',
        'Argument 1 to "open" of "SimulatorKind" has incompatible type "Section"; expected "Robot"',
        '"LearnerKind" has no attribute "load"',
        '"RobotContract" has no attribute "supports"',
        'Return type "str" of "load_policy" incompatible with return type "Policy"',
        'Return type "str" of "describe" incompatible with return type "dict[str, object]"',
        'Argument "nominal_rad" to "replace" of "Robot" has incompatible type "float"',
        '"PolicyContract" has no attribute "acts"',
        '"Presentation" has no attribute "headlines"',
        'Argument 2 to "Environment" has incompatible type "type[Missing]"; expected "type[Task[TaskSettings]]"',
        'Argument 3 to "Environment" has incompatible type "SimulatorSettings"; expected "TaskSettings"',
    ):
        assert error in done.stdout, done.stdout + done.stderr


def test_an_error_in_a_plugin_of_another_package_has_its_place(
    offered: list[EntryPoint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last line of the plug-in, also if what it called raised the error."""
    path = tmp_path / "naosprint_hasty.py"
    path.write_text("def step():\n    update()\n\ndef update():\n    int('a')\n    float('b')\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    naosprint_hasty = import_module("naosprint_hasty")

    for known, expected in ((False, ""), (True, f"{path}, line 5")):
        if known:
            offered.append(entry("hasty", "naosprint_hasty:Hasty"))
            plugins._entries.cache_clear()
        with pytest.raises(ValueError, match="invalid literal") as caught:
            naosprint_hasty.step()
        assert plugins.place_of(caught.value) == expected
    with pytest.raises(ValidationError) as refused:
        TrainingSpec.model_validate({"total_steps": "many"})
    assert plugins.place_of(refused.value) == "", "of ours"
