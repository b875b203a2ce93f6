"""Requests for jobs and groups of jobs."""

from __future__ import annotations

import pytest
from naojobs.errors import InvalidError
from naojobs.models import Study
from naojobs.studies import StudyRequest
from naojobs.submission import MAX_GROUP_SIZE, GroupRequest, JobRequest, expand_group
from naospec import TrainingSpec
from naospec.search import SearchSpec


def test_a_job_without_a_name_gets_one() -> None:
    assert JobRequest(TrainingSpec(algorithm={"preset": "paper"}, seed=4)).display_name == "sprint1-paper-4"


def test_a_study_of_a_job_with_a_long_name_gets_one_that_fits() -> None:
    search = SearchSpec.model_validate({"space": {"n_epochs": {"type": "int", "low": 1, "high": 3}}})
    longest = Study.__table__.c.name.type.length
    assert StudyRequest(JobRequest(name="n" * longest), search).display_name == f"tune-{'n' * (longest - 5)}"


def test_the_digest_distinguishes_requests() -> None:
    requests = [JobRequest(), JobRequest(TrainingSpec(seed=1)), JobRequest(name="a"), JobRequest(tags=["a"])]
    assert len({request.digest() for request in requests}) == len(requests)
    assert JobRequest(TrainingSpec(seed=1)).digest() == requests[1].digest()


def test_a_group_varies_only_what_it_names() -> None:
    base = JobRequest(spec=TrainingSpec(algorithm={"preset": "paper", "clip_range": 0.2}), tags=["t"])
    jobs = expand_group(GroupRequest(job=base, seeds=[5, 6], grid={"learning_rate": [1e-3]}))
    assert [job.spec.seed for job in jobs] == [5, 6]
    for job in jobs:
        algorithm = {"preset": "paper", "clip_range": 0.2, "learning_rate": 1e-3}
        assert job.spec == TrainingSpec(algorithm=algorithm, seed=job.spec.seed)
        assert job.tags == ["t"]
        assert (job.name or "").endswith(f"-seed-{job.spec.seed}")


def test_a_preset_in_a_grid_brings_its_own_values() -> None:
    jobs = expand_group(GroupRequest(job=JobRequest(), grid={"preset": ["fast", "paper"]}))
    assert [job.spec for job in jobs] == [TrainingSpec(), TrainingSpec(algorithm={"preset": "paper"})]


def test_a_task_in_a_grid_brings_its_own_height() -> None:
    jobs = expand_group(GroupRequest(job=JobRequest(), grid={"task": ["sprint1", "sprint1-erect"]}))
    assert [job.spec for job in jobs] == [TrainingSpec(), TrainingSpec(task="sprint1-erect")]


def test_tasks_and_robots_in_a_grid_bring_their_own_settings() -> None:
    base = JobRequest(TrainingSpec(task={"name": "sprint1", "reward_scale": 50}, algorithm={"n_envs": 64}))
    grid = {"task.name": ["sprint1-erect", "sprint2"], "robot": ["t1", "nao-4"]}
    jobs = expand_group(GroupRequest(job=base, grid=grid))
    assert [job.spec for job in jobs] == [
        TrainingSpec(task={"name": task, "reward_scale": 50}, robot=robot, algorithm={"n_envs": 64})
        for task in grid["task.name"]
        for robot in grid["robot"]
    ]
    assert jobs[0].name == "sprint1-fast-0-name-sprint1-erect-robot-t1"


@pytest.mark.parametrize(("name", "values", "words"), [("speed", [1], "'speed'"), ("task", ["x"], "choose one")])
def test_what_cannot_be_varied_is_refused(name: str, values: list[object], words: str) -> None:
    with pytest.raises(InvalidError, match=words) as caught:
        expand_group(GroupRequest(job=JobRequest(), grid={name: values}))
    assert caught.value.field == f"grid.{name}"


def test_groups_have_a_largest_size() -> None:
    with pytest.raises(InvalidError, match="more than"):
        expand_group(GroupRequest(job=JobRequest(), seeds=range(100), grid={"n_epochs": [1, 2, 3]}))
    assert len(expand_group(GroupRequest(job=JobRequest(), seeds=range(MAX_GROUP_SIZE)))) == MAX_GROUP_SIZE
