"""Test that specifications accept what is possible and name what is not."""

from __future__ import annotations

import json
from typing import Any

import pytest
from naospec import PRESETS, TASKS, EvaluationSpec, TrainingSpec
from pydantic import ValidationError


def test_defaults_are_those_of_preset_fast() -> None:
    """The class defaults and the preset are one truth."""
    spec = TrainingSpec()
    assert spec.preset == "fast"
    assert spec == TrainingSpec.from_preset("fast")
    assert {name: getattr(spec, name) for name in PRESETS["fast"]} == dict(PRESETS["fast"])
    assert spec.departures() == {}


def test_preset_paper_is_table_two() -> None:
    """Preset paper carries the hyperparameters of the paper's table II."""
    spec = TrainingSpec(preset="paper")
    assert (spec.n_envs, spec.n_steps, spec.batch_size, spec.n_epochs) == (19, 4096, 19 * 64, 10)
    assert (spec.clip_range, spec.learning_rate, spec.gamma, spec.gae_lambda) == (0.1, 1e-4, 0.99, 0.95)
    assert (spec.entropy_coefficient, spec.observation_clip, spec.initial_log_std) == (0.0, 5.0, 0.0)
    assert spec.learning_rate_schedule == "constant"
    assert spec.hidden_sizes == (64, 64)
    assert spec.reward_scale == 100.0
    assert not spec.normalise_rewards
    assert not spec.symmetric_policy
    assert not spec.bootstrap_at_end


def test_departures_name_what_was_overridden() -> None:
    """A preset with an override says so."""
    spec = TrainingSpec.from_preset("paper", clip_range=0.2, seed=5)
    assert spec.departures() == {"clip_range": 0.2}
    assert spec.seed == 5


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_every_preset_knows_the_same_fields(preset: str) -> None:
    """No preset forgets a learning setting, and every name is a field."""
    assert set(PRESETS[preset]) == set(PRESETS["fast"])
    assert set(PRESETS[preset]) <= set(TrainingSpec.model_fields)


@pytest.mark.parametrize("name", sorted(TASKS))
def test_min_height_comes_from_the_task(name: str) -> None:
    """Left out or null, the minimum height is the task's; given, it is kept."""
    assert TrainingSpec(task=name).fall_height_m == TASKS[name].min_height_m
    assert TrainingSpec(task=name, min_height=None).fall_height_m == TASKS[name].min_height_m
    assert TrainingSpec(task=name, min_height=0.3).fall_height_m == 0.3


def test_json_round_trip_keeps_the_specification_and_its_digest() -> None:
    """What is stored comes back equal."""
    spec = TrainingSpec(preset="paper", task="sprint2-erect", hidden_sizes=(32, 15), target_kl=None)
    again = TrainingSpec.model_validate_json(spec.model_dump_json())
    assert again == spec
    assert again.digest() == spec.digest()
    assert json.loads(spec.canonical_json()) == spec.model_dump(mode="json")


def test_digest_tells_specifications_apart() -> None:
    """Any field changes the digest."""
    assert TrainingSpec(seed=1).digest() != TrainingSpec(seed=2).digest()
    assert len(TrainingSpec().digest()) == 64


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"task": "sprint9"}, ["task", "sprint1", "sprint2-erect"]),
        ({"preset": "slow"}, ["preset", "fast"]),
        ({"robot_type": 5}, ["robot_type", "4"]),
        ({"simulator": "gazebo"}, ["simulator", "embedded"]),
        ({"n_envs": 0}, ["n_envs", "1"]),
        ({"batch_size": 5000}, ["batch_size", "8192", "4096"]),
        ({"hidden_sizes": [64, 33]}, ["hidden_sizes", "even", "symmetric_policy"]),
        ({"target_kl": None}, ["target_kl", "adaptive"]),
        ({"n_steps": 1_000_000, "batch_size": 1_000_000}, ["n_steps", "128000000"]),
        ({"min_height": 0.385}, ["min_height", "0.385", "standing height"]),
        ({"min_height": 0.4, "robot_type": 2}, ["min_height", "robot type 2"]),
        ({"learning_rate": float("nan")}, ["learning_rate"]),
        ({"gamma": float("inf")}, ["gamma"]),
        ({"total_steps": 0}, ["total_steps"]),
        ({"max_server_failures": -1}, ["max_server_failures", "0"]),
        ({"hidden_sizes": [64, 0]}, ["hidden_sizes"]),
        ({"colour": "red"}, ["colour"]),
        ({"task": 3}, ["task"]),
        ({"preset": ["fast"]}, ["preset"]),
    ],
)
def test_impossible_specifications_are_refused_by_field(fields: dict[str, Any], words: list[str]) -> None:
    """The message names the field and shows a way out."""
    with pytest.raises(ValidationError) as caught:
        TrainingSpec.model_validate(fields)
    message = str(caught.value)
    for word in words:
        assert word in message


def test_longer_legs_allow_a_higher_limit() -> None:
    """The standing height is that of the robot type."""
    assert TrainingSpec(min_height=0.4, robot_type=1).fall_height_m == 0.4


def test_specification_is_frozen() -> None:
    """A specification cannot change under a running job."""
    with pytest.raises(ValidationError):
        setattr(TrainingSpec(), "seed", 4)  # noqa: B010 - the type checker refuses plain assignment


def test_planned_steps_are_whole_rollouts() -> None:
    """Total steps are rounded up to whole rollouts."""
    spec = TrainingSpec(total_steps=200_000)
    assert spec.rollout_steps == 8_192
    assert spec.planned_steps == 25 * 8_192


def test_schema_documents_every_field() -> None:
    """The job form and the reference page get a title and a description for each field."""
    for model in (TrainingSpec, EvaluationSpec):
        for name, field in model.model_json_schema()["properties"].items():
            assert field.get("description"), name
            assert field.get("title"), name
            assert "default" in field, name


def test_evaluation_refuses_an_unknown_task() -> None:
    """An evaluation checks its task too."""
    with pytest.raises(ValidationError, match="sprint1"):
        EvaluationSpec(task="marathon")
    assert EvaluationSpec().episodes == 1000
