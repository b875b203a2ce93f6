"""Request schemas."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator
from typing import Any

import pytest
from naojobs.submission import MAX_GROUP_SIZE, GroupRequest, JobRequest
from naospec import TrainingSpec
from naosprint_api.schemas.jobs import GroupCreate, JobCreate
from naosprint_api.schemas.studies import StudyCreate
from pydantic import BaseModel, ValidationError


@pytest.mark.parametrize(
    ("body", "task"),
    [
        ({}, "sprint1"),
        ({"spec": {"task": "sprint2"}}, "sprint2"),
        ({"spec": {"task": "sprint2"}, "evaluation": {"episodes": 5}}, "sprint2"),
        ({"spec": {"task": "sprint2"}, "evaluation": {"task": "sprint1"}}, "sprint1"),
    ],
)
def test_a_job_is_evaluated_on_the_task_that_it_trains_by_default(body: dict[str, Any], task: str) -> None:
    job = JobCreate.model_validate(body)
    assert job.evaluation is not None
    assert job.evaluation.applied_to(job.spec).task.name == task


def test_every_field_is_described() -> None:
    for model in (JobCreate, GroupCreate):
        assert all(field.description for field in model.model_fields.values())


def test_a_job_survives_json() -> None:
    job = JobCreate(name="x", tags=["a"], spec=TrainingSpec(task="sprint2", seed=3), priority=1)
    assert JobCreate.model_validate_json(job.model_dump_json()) == job


@pytest.mark.parametrize("tag", ["", " ", "a b", "-a", "a\n", "x" * 51, "\N{SNOWMAN}"])
def test_strange_tags_are_refused(tag: str) -> None:
    with pytest.raises(ValidationError, match=r"tags\.0"):
        JobCreate(tags=[tag])


def test_groups_have_a_largest_size() -> None:
    GroupCreate(job=JobCreate(), seeds=list(range(MAX_GROUP_SIZE)))
    with pytest.raises(ValidationError, match="seeds"):
        GroupCreate(job=JobCreate(), seeds=list(range(MAX_GROUP_SIZE + 1)))


def test_a_request_has_every_field_of_its_schema() -> None:
    spec = TrainingSpec(task="sprint2", seed=3)
    job = JobCreate(name="x", tags=["a"], spec=spec, priority=1, max_attempts=2, evaluation=None)
    assert job.request() == JobRequest(spec=spec, name="x", tags=["a"], priority=1, max_attempts=2)
    group = GroupCreate(job=job, seeds=[1], grid={"n_epochs": [1, 2]})
    assert group.request() == GroupRequest(job.request(), [1], {"n_epochs": [1, 2]})


VALID: dict[type[BaseModel], dict[str, Any]] = {
    JobCreate: {
        "spec": {
            "task": {"name": "sprint1"},
            "robot": {"name": "t1", "kp": {"legs": 100}},
            "stages": [{"steps": 1000, "task": {"name": "sprint1"}, "algorithm": {"gamma": 0.9}, "robot": "t1"}],
        },
        "evaluation": {"task": {"name": "sprint1"}},
    },
    GroupCreate: {"job": {"spec": {"stages": [{"steps": 5}]}}, "seeds": [1], "grid": {"gamma": [0.9]}},
    StudyCreate: {
        "job": {"spec": {"stages": [{"steps": 5}]}},
        "search": {
            "space": {"gamma": {"low": 0.9, "high": 0.99}},
            "trials": 5,
            "objectives": [{"metric": "speed_mps"}],
        },
    },
}
ODD: tuple[Any, ...] = (
    None,
    True,
    1,
    1e400,
    "x",
    "",
    [],
    [None],
    [[1]],
    [1],
    {},
    {"name": [1]},
    {"name": {}},
    {"a": 1},
)


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield path
    for key, part in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        yield from places(part, (*path, key))


@pytest.mark.parametrize("model", VALID, ids=lambda model: model.__name__)
def test_a_value_of_the_wrong_type_anywhere_is_an_error_of_the_request(model: type[BaseModel]) -> None:
    """Validators that run before types are known leave wrong ones to the fields' own validation."""
    for path in places(VALID[model]):
        for odd in ODD:
            body = {"": copy.deepcopy(VALID[model])}
            *parents, last = ("", *path)
            place: Any = body
            for key in parents:
                place = place[key]
            place[last] = odd
            with contextlib.suppress(ValidationError):
                model.model_validate(body[""])
