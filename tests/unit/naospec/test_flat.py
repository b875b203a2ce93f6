"""Short names of settings keep their meaning whatever is installed."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import pytest
from naospec import TrainingSpec, plugins
from naospec.flat import OPTIONS, nest, settings

SETTINGS = """
from naospec import LearnerSettings, TaskSettings
from naosprint.rl.kinds import PPOKind
from naosprint.tasks import Task
from pydantic import Field


def whole(words):
    return Field(default=1, ge=0, le=9, title=words, description=words)


class GreedySettings(TaskSettings):
    learning_rate: int = whole("The task's rate.")
    seed: int = whole("The task's seed.")
    simulator_threads: int = whole("The task's threads.")
    robot: int = whole("The task's robot.")
    kp: int = whole("The task's gain.")
    recipe: int = whole("The task's recipe.")
    eval_episodes: int = whole("The task's episodes.")
    task_seed: int = whole("The task's other seed.")
    reward_scale: int = whole("The task's scale.")
    shared: int = whole("The task's own.")
    depth_m: int = whole("The task's depth.")


class greedy(Task[GreedySettings]):
    name = summary = "greedy"
    Parameters = GreedySettings


class MeanSettings(LearnerSettings):
    drift_penalty: int = whole("The algorithm's penalty.")
    shared: int = whole("The algorithm's own.")


class Mean(PPOKind):
    name = summary = "mean"
    Parameters = MeanSettings


mean = Mean()
"""


@pytest.fixture
def greedy(install: Callable[[str, str, Mapping[str, str]], None]) -> None:
    """Install a task and an algorithm whose fields have names that others have already."""
    install("greed", SETTINGS, {"greedy": plugins.TASKS, "mean": plugins.LEARNERS})


@pytest.fixture(scope="module")
def before() -> dict[str, tuple[tuple[str, ...], str | None]]:
    """Return what short names mean without other packages."""
    return {name: (setting.path, setting.info.description) for name, setting in settings().items()}


def test_no_short_name_of_the_project_has_a_prefix(before: Mapping[str, tuple[tuple[str, ...], str | None]]) -> None:
    assert all(name == (path[0] if path[-1] == "name" else path[-1]) for name, (path, _) in before.items())
    assert not before.keys() & OPTIONS


def test_names_keep_their_meaning_and_a_plugins_are_prefixed(
    before: Mapping[str, tuple[tuple[str, ...], str | None]], greedy: None
) -> None:
    known = settings()
    assert {name: (known[name].path, known[name].info.description) for name in before} == before
    assert {name: setting.path for name, setting in known.items() if name not in before} == {
        "task_learning_rate": ("task", "learning_rate"),
        "task_seed": ("task", "seed"),
        "task_simulator_threads": ("task", "simulator_threads"),
        "task_robot": ("task", "robot"),
        "task_kp": ("task", "kp"),
        "task_recipe": ("task", "recipe"),
        "task_eval_episodes": ("task", "eval_episodes"),
        "task_task_seed": ("task", "task_seed"),
        "task_shared": ("task", "shared"),
        "depth_m": ("task", "depth_m"),
        "algorithm_drift_penalty": ("algorithm", "drift_penalty"),
        "shared": ("algorithm", "shared"),
    }
    assert len({setting.path for setting in known.values()}) == len(known)
    # a field that every task has is described as the project describes it
    assert known["reward_scale"].plugins == ()


def test_another_seed_moves_those_of_the_stages_along() -> None:
    recipe = {"seed": 1, "stages": [{"steps": 512, "seed": 121}, {"steps": 512}, {"steps": 512, "seed": 0}]}
    found = [TrainingSpec.model_validate(nest({"seed": seed}, recipe)) for seed in (1, 3, 0)]
    assert [[stage.seed for stage in spec.stage_specs] for spec in found] == [
        [121, 1, 0], [123, 3, 2], [120, 0, 2**31 - 1]
    ]  # fmt: skip
    assert found[0] == TrainingSpec.model_validate(recipe)
    assert TrainingSpec.model_validate(found[0].written().with_settings({"seed": 3})) == found[1]


def test_values_reach_the_settings_that_their_names_mean(greedy: None) -> None:
    spec = TrainingSpec.model_validate(nest({"task": "greedy", "learning_rate": 1e-3, "seed": 7, "task_seed": 4}))
    assert (spec.algorithm.learning_rate, spec.seed) == (1e-3, 7)
    assert (spec.task.learning_rate, spec.task.seed) == (1, 4)
    spec = TrainingSpec.model_validate(nest({"task_learning_rate": 9, "task.robot": 8}, {"task": "greedy"}))
    assert (spec.algorithm.learning_rate, spec.task.learning_rate, spec.task.robot) == (5e-4, 9, 8)
