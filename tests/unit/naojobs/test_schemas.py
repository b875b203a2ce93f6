"""What users send."""

from __future__ import annotations

from typing import Any

import pytest
from naojobs.errors import InvalidError
from naojobs.lifecycle import expand_group
from naojobs.schemas import MAX_GROUP_SIZE, GroupCreate, JobCreate
from naospec import EvaluationSpec, TrainingSpec
from pydantic import ValidationError


@pytest.mark.parametrize(
    ("body", "task"),
    [
        ({}, "sprint1"),
        ({"spec": {"task": "sprint2"}}, "sprint2"),
        ({"spec": TrainingSpec(task="sprint2")}, "sprint2"),
        ({"spec": {"task": "sprint2"}, "evaluation": {"episodes": 5}}, "sprint2"),
        ({"spec": {"task": "sprint2"}, "evaluation": {"task": "sprint1"}}, "sprint1"),
        ({"spec": {"task": "sprint2"}, "evaluation": EvaluationSpec()}, "sprint1"),
    ],
)
def test_a_job_is_judged_by_what_it_trains_unless_told_otherwise(body: dict[str, Any], task: str) -> None:
    job = JobCreate.model_validate(body)
    assert job.evaluation is not None
    assert job.evaluation.task == task


def test_every_field_is_described() -> None:
    for model in (JobCreate, GroupCreate):
        assert all(field.description for field in model.model_fields.values())


def test_a_job_survives_json() -> None:
    job = JobCreate(name="x", tags=["a"], spec=TrainingSpec(task="sprint2", seed=3), priority=1)
    assert JobCreate.model_validate_json(job.model_dump_json()) == job


def test_a_job_without_a_name_gets_one() -> None:
    assert JobCreate(spec=TrainingSpec(preset="paper", seed=4)).display_name() == "sprint1-paper-4"


@pytest.mark.parametrize("tag", ["", " ", "a b", "-a", "a\n", "x" * 51, "\N{SNOWMAN}"])
def test_strange_tags_are_refused(tag: str) -> None:
    with pytest.raises(ValidationError, match=r"tags\.0"):
        JobCreate(tags=[tag])


def test_a_group_varies_only_what_it_names() -> None:
    base = JobCreate(spec=TrainingSpec.model_validate({"preset": "paper", "clip_range": 0.2}), tags=["t"])
    jobs = expand_group(GroupCreate(job=base, seeds=[5, 6], grid={"learning_rate": [1e-3]}))
    assert [job.spec.seed for job in jobs] == [5, 6]
    for job in jobs:
        assert job.spec == base.spec.model_copy(update={"seed": job.spec.seed, "learning_rate": 1e-3})
        assert job.tags == ["t"]
        assert (job.name or "").endswith(f"-seed-{job.spec.seed}")


def test_a_preset_in_a_grid_brings_its_own_values() -> None:
    jobs = expand_group(GroupCreate(job=JobCreate(), grid={"preset": ["fast", "paper"]}))
    assert [job.spec for job in jobs] == [TrainingSpec.from_preset("fast"), TrainingSpec.from_preset("paper")]


def test_a_task_in_a_grid_brings_its_own_height() -> None:
    jobs = expand_group(GroupCreate(job=JobCreate(), grid={"task": ["sprint1", "sprint1-erect"]}))
    assert [job.spec for job in jobs] == [TrainingSpec(), TrainingSpec(task="sprint1-erect")]


def test_groups_have_a_largest_size() -> None:
    GroupCreate(job=JobCreate(), seeds=list(range(MAX_GROUP_SIZE)))
    with pytest.raises(ValidationError, match="seeds"):
        GroupCreate(job=JobCreate(), seeds=list(range(MAX_GROUP_SIZE + 1)))
    with pytest.raises(InvalidError, match="more than"):
        expand_group(GroupCreate(job=JobCreate(), seeds=list(range(100)), grid={"n_epochs": [1, 2, 3]}))
