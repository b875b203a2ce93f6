"""What a preset decides of plug-ins: inherited settings, but not those that a plug-in's model declares itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import pytest
from naospec import TrainingSpec, plugins, presets

OWN = """
from naospec import LearnerSettings
from naosprint.rl.kinds import PPOKind
from naosprint.rl.settings import PPOSettings
from naosprint.tasks import Task, TaskSettings
from pydantic import Field


class StrollSettings(TaskSettings):
    drift_penalty: float = Field(default=0.05, ge=0.0, le=1.0, title="Drift", description="Penalty.")
    reward_scale: float = Field(default=10.0, gt=0.0, le=50.0, title="Scale", description="Factor.")


class strolls(Task[StrollSettings]):
    name = summary = "strolls"
    Parameters = StrollSettings


class FarSettings(StrollSettings):
    far_m: float = Field(default=1.0, ge=0.0, le=9.0, title="Far", description="Distance.")


class far(strolls):
    name = summary = "far"
    Parameters = FarSettings


class OwnSettings(LearnerSettings):
    n_envs: int = Field(default=8, ge=1, le=64, title="Environments", description="Environments.")
    learning_rate: float = Field(default=0.3, gt=0.0, le=1.0, title="Learning rate", description="Step size.")


class Own(PPOKind):
    name = summary = "own"
    Parameters = OwnSettings

    def require(self, settings, robot, task): ...


class FewSettings(PPOSettings):
    n_envs: int = Field(default=4, ge=1, le=64, title="Environments", description="Environments.")


class Few(PPOKind):
    name = summary = "few"
    Parameters = FewSettings


own, few = Own(), Few()
"""


@pytest.fixture
def own(install: Callable[[str, str, Mapping[str, str]], None]) -> None:
    """Install two tasks and two algorithms with fields that presets have, too."""
    offers = {"strolls": plugins.TASKS, "far": plugins.TASKS, "own": plugins.LEARNERS, "few": plugins.LEARNERS}
    install("strolling", OWN, offers)


@pytest.mark.parametrize("preset", presets.names())
def test_a_field_that_a_plugin_declares_keeps_its_default(own: None, preset: str) -> None:
    """Also where another plug-in inherits it; what the project declares has the preset's value."""
    for name in ("strolls", "far"):
        spec = TrainingSpec(task=name, algorithm={"name": "own", "preset": preset})
        assert (spec.task.drift_penalty, spec.task.reward_scale) == (0.05, 10.0)
        assert spec.task.start_episode_fraction == presets.values(preset, "task", None)["start_episode_fraction"]
        assert (spec.algorithm.n_envs, spec.algorithm.learning_rate) == (8, 0.3)
        assert spec.algorithm.n_steps == presets.values(preset, "algorithm", None)["n_steps"]
    few = TrainingSpec(algorithm={"name": "few", "preset": preset, "batch_size": 64}).algorithm
    assert (few.n_envs, few.clip_range) == (4, presets.values(preset, "algorithm", None)["clip_range"])


def test_overrides_and_what_was_written_agree_with_the_defaults(own: None) -> None:
    spec = TrainingSpec(task="strolls", algorithm="own")
    assert spec.overrides() == {}
    assert spec.written().content["task"] == {"name": "strolls"}
    assert spec.written().content["algorithm"] == {"name": "own", "preset": "fast"}
    # what the preset has is a choice here
    chosen = TrainingSpec(
        task={"name": "strolls", "drift_penalty": 1.0, "start_episode_fraction": 0.5},
        algorithm={"name": "own", "learning_rate": 0.0005},
    )
    assert chosen.overrides() == {"algorithm.learning_rate": 0.0005, "task.start_episode_fraction": 0.5}
    content = chosen.written().content
    assert content["task"] == {"name": "strolls", "drift_penalty": 1.0, "start_episode_fraction": 0.5}
    assert content["algorithm"] == {"name": "own", "preset": "fast", "learning_rate": 0.0005}
    assert TrainingSpec.model_validate(chosen.written()) == chosen
    assert TrainingSpec.model_validate_json(chosen.model_dump_json()) == chosen


def test_a_stage_of_another_task_keeps_its_defaults_too(own: None) -> None:
    spec = TrainingSpec(stages=[{"steps": 10}, {"steps": 10, "task": {"name": "strolls"}}])
    first, second = spec.stage_specs
    assert (first.task.drift_penalty, second.task.drift_penalty) == (1.0, 0.05)


def test_the_schema_marks_what_presets_do_not_change(own: None) -> None:
    """Forms show the preset's value of all others."""
    options = TrainingSpec.model_json_schema()["properties"]["task"]["oneOf"]
    marked = {
        option["title"]: {name for name, field in option["properties"].items() if field.get("own")}
        for option in options
    }
    assert marked.pop("strolls") == {"drift_penalty", "reward_scale"}
    assert marked.pop("far") == {"drift_penalty", "reward_scale", "far_m"}
    assert not any(marked.values())
