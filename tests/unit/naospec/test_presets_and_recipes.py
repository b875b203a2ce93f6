"""The data files: every preset and every recipe is a valid specification."""

from __future__ import annotations

import naopolicies
import pytest
from naosim import robots
from naospec import EvaluationSpec, TrainingSpec, plugins, presets, recipes
from naosprint.tasks.robot_defaults import robot_defaults


@pytest.mark.parametrize("preset", presets.names())
def test_presets_set_settings_that_exist(preset: str) -> None:
    """All presets set the same settings, and every name is a setting of some plug-in."""
    content = presets.read(preset)
    assert presets.summary(preset)
    assert set(content) <= {"summary", "robots", *presets.SECTIONS}
    algorithms = {name for each in plugins.names(plugins.LEARNERS) for name in _fields(plugins.LEARNERS, each)}
    tasks = {name for each in plugins.names(plugins.TASKS) for name in _fields(plugins.TASKS, each)}
    for section, known in (("algorithm", algorithms), ("task", tasks)):
        assert set(presets.values(preset, section, None)) == set(presets.values("fast", section, None))
        for family in (None, *content.get("robots", {})):
            assert set(presets.values(preset, section, family)) <= known


def _fields(group: str, name: str) -> set[str]:
    return set(plugins.load(group, name).Parameters.model_fields)


@pytest.mark.parametrize("preset", presets.names())
@pytest.mark.parametrize("robot", robots.names())
def test_presets_are_possible_with_every_robot(preset: str, robot: str) -> None:
    """And every task that the robot can do."""
    for task in plugins.names(plugins.TASKS):
        if plugins.load(plugins.TASKS, task).supports(robots.get(robot)):
            spec = TrainingSpec.model_validate({"task": task, "robot": robot, "algorithm": {"preset": preset}})
            assert spec.overrides() == {}


def test_unknown_preset_lists_the_known() -> None:
    with pytest.raises(ValueError, match="unknown preset 'slow': choose one of fast, "):
        presets.read("slow")


@pytest.mark.parametrize("name", recipes.names())
def test_recipes_are_possible_jobs(name: str) -> None:
    """Specification and evaluation are valid."""
    job = recipes.job(name)
    spec = TrainingSpec.model_validate(job["spec"])
    EvaluationSpec.model_validate(job["evaluation"])
    assert job["name"] == name
    assert recipes.summary(name).endswith(".")
    assert set(job) <= {"name", "tags", "parent_policy", "spec", "evaluation"}
    assert len(spec.stage_specs) == len(spec.stages or (spec,))


@pytest.mark.parametrize("name", recipes.names())
def test_a_recipe_can_start_from_any_policy(name: str) -> None:
    """Of its own stages alone it is a possible job, too: the last ones of all."""
    stages, own = (recipes.job(name, start)["spec"].get("stages", []) for start in (None, "runs/first"))
    assert own == stages[len(stages) - len(own) :]
    assert (recipes.shortened(name, "runs/first") is None) == (own == stages)
    assert "parent_policy" not in recipes.job(name, "runs/first")
    TrainingSpec.model_validate(recipes.job(name, "runs/first")["spec"])


def test_a_policy_replaces_the_stages_of_its_recipe() -> None:
    def stages(name: str, start: str | None = None) -> int:
        return len(recipes.job(name, start)["spec"]["stages"])

    assert stages("t1-sprint-robust", "t1-sprint") == stages("t1-sprint-robust") - stages("t1-sprint") == 7
    assert stages("t1-run-wide", "t1-run") == stages("t1-run-wide") - stages("t1-run")
    assert stages("t1-run-wide", "t1-run-robust") == stages("t1-run-wide", "own") < stages("t1-run-wide", "t1-run")
    assert stages("t1-sprint", "t1-run") == stages("t1-sprint")
    sentence = "--recipe t1-sprint-robust: the last 7 of its 14 stages, after t1-sprint"
    assert recipes.shortened("t1-sprint-robust", "t1-sprint") == sentence


@pytest.mark.parametrize("name", [name for name in recipes.names() if name in naopolicies.names()])
def test_recipes_of_bundled_policies_are_their_lineage(name: str) -> None:
    """Stage by stage: task, robot, preset, seed and overrides, except for shortened stages."""
    job = recipes.job(name)
    spec = TrainingSpec.model_validate(job["spec"])
    lineage = naopolicies.card(name)["lineage"][-len(spec.stage_specs) :]
    for stage, past in zip(spec.stage_specs, lineage, strict=True):
        height = robot_defaults(robots.configured(stage.robot)).erect_height_m
        assert (getattr(stage.task, "min_height_m", None) == height) == past["task"].endswith("-erect")
        assert (stage.robot.name, stage.algorithm.preset, stage.seed) == (past["robot"], past["preset"], past["seed"])
        # the last jobs of two lineages were not trained to their end
        assert stage.planned_steps == past["steps"] or name == "sprint-type4"
        ours = {path: list(value) if isinstance(value, tuple) else value for path, value in stage.overrides().items()}
        # without effect where the spread does not change
        unchanged = {"algorithm.log_std_steps"}
        # what jobs that were stopped early had reached
        if stage.algorithm.target_kl_final in (0.0091, 0.0112, 0.0132, 0.015):
            unchanged |= {"algorithm.target_kl_final", "algorithm.final_log_std"}
        assert {path: value for path, value in ours.items() if path not in unchanged} == {
            path: value for path, value in past["overrides"].items() if path not in unchanged
        }


def test_unknown_recipe_lists_the_known() -> None:
    with pytest.raises(ValueError, match="unknown recipe 'jump': choose one of k1-getup, k1-kick, k1-run, "):
        recipes.job("jump")
