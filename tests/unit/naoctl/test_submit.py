from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone
from typing import Any

import pytest
from naoctl.commands.submit import (
    expanded_job,
    make_body,
    make_group,
    make_job,
    parse_moment,
    parse_seeds,
    read_recipe,
)
from naoctl.errors import InvalidInput
from naospec import EvaluationSpec, TrainingSpec, recipes
from naospec.flat import nest


def test_only_what_the_user_chose_is_sent() -> None:
    body = make_body({}, {"preset": "paper", "total_steps": "5000", "target_kl": "none"}, {"eval_episodes": "10"})
    assert body == {
        "spec": {"algorithm": {"preset": "paper", "target_kl": None}, "total_steps": 5000},
        "evaluation": {"episodes": 10},
    }
    assert make_body({}, {}, {}) == {"spec": {}}


def test_flags_override_the_file() -> None:
    spec = {"algorithm": {"preset": "paper"}, "robot": "nao-4", "seed": 1}
    file = {"name": "night", "spec": spec, "evaluation": {"episodes": 5, "seed": 2}}
    body = make_body(file, {"seed": "7"}, {"eval_episodes": "50"})
    assert body["name"] == "night"
    assert body["spec"] == {"algorithm": {"preset": "paper"}, "robot": {"name": "nao-4"}, "seed": 7}
    assert body["evaluation"] == {"episodes": 50, "seed": 2}


def test_the_body_means_the_same_to_the_service() -> None:
    flags = {"preset": "paper", "n_envs": "8", "batch_size": "64", "hidden_sizes": "32,32", "sensor_digits": "none"}
    body = make_body({}, flags, {})
    spec = TrainingSpec.model_validate(body["spec"])
    algorithm = spec.algorithm
    assert (algorithm.n_envs, algorithm.batch_size, algorithm.hidden_sizes) == (8, 64, (32, 32))
    assert spec.simulator.sensor_digits is None
    assert algorithm.clip_range == TrainingSpec(algorithm={"preset": "paper"}).algorithm.clip_range


@pytest.mark.parametrize("name", recipes.names())
def test_flags_override_a_recipe(name: str) -> None:
    body = make_body(read_recipe(name), {"seed": "9"}, {"eval_episodes": "50"})
    assert body["name"] == name
    spec = nest({"seed": 9}, read_recipe(name)["spec"])
    assert body["spec"] == make_body({**read_recipe(name), "spec": spec}, {}, {})["spec"]
    assert body["evaluation"]["episodes"] == 50


def test_what_is_given_to_start_from_replaces_what_the_recipe_starts_from() -> None:
    policy = make_job(None, "t1-sprint-robust", {}, {}, start="t1-sprint", parent_policy="t1-sprint")
    assert (policy["parent_policy"], len(policy["spec"]["stages"])) == ("t1-sprint", 7)
    assert make_job(None, "t1-kick", {}, {})["parent_policy"] == "t1-run"
    # the service refuses a parent job and a parent policy together
    assert "parent_policy" not in make_job(None, "t1-kick", {}, {}, start="job walker")


def test_an_unknown_recipe_is_refused() -> None:
    with pytest.raises(InvalidInput, match="--recipe: unknown recipe 'soup'"):
        read_recipe("soup")


def test_evaluation_can_be_left_out_or_asked_back() -> None:
    assert make_body({}, {}, {}, evaluate=False)["evaluation"] is None
    assert make_body({"evaluation": None}, {}, {})["evaluation"] is None
    assert "evaluation" not in make_body({"evaluation": None}, {}, {}, evaluate=True)
    with pytest.raises(InvalidInput, match="contradicts"):
        make_body({}, {}, {"eval_episodes": "5"}, evaluate=False)


def test_evaluation_is_checked_with_its_own_flags() -> None:
    with pytest.raises(InvalidInput, match="--eval-episodes"):
        make_body({}, {"seed": "1"}, {"eval_episodes": "0"})
    assert EvaluationSpec.model_validate(make_body({}, {}, {"eval_seed": "3"})["evaluation"]).seed == 3


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ({"task": "sprint1"}, "task: no such field of a job. Put it below `spec > task:`."),
        ({"seed": 1}, "seed: no such field of a job. Put it below `spec:`."),
        ({"n_envs": 1}, "n_envs: no such field of a job. Put it below `spec > algorithm:`."),
        ({"spec": {"n_envs": 1}}, "job.yaml: spec.n_envs: write algorithm.n_envs"),
        ({"nme": "x"}, "nme: no such field of a job. Fields: name"),
        ({"spec": {"total_step": 3}}, "job.yaml: spec.total_step: no such field"),
        ({"spec": {"seed": "x"}}, "job.yaml: spec.seed"),
        ({"spec": [1]}, "job.yaml: spec is not a mapping"),
        ({"evaluation": {"episodes": -1}}, "job.yaml: evaluation.episodes"),
    ],
)
def test_errors_of_the_file_name_its_field(file: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        make_body(file, {}, {}, where="job.yaml: ")
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("text", "seeds"), [("0-4", [0, 1, 2, 3, 4]), ("1,2,3", [1, 2, 3]), ("0-2, 7", [0, 1, 2, 7]), ("5", [5])]
)
def test_seeds(text: str, seeds: list[int]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "3-1", "0-999999", "1,1", "0-2,1", "-1"])
def test_seeds_that_make_no_sense(text: str) -> None:
    with pytest.raises(InvalidInput, match="--seeds"):
        parse_seeds(text)


def test_a_sweep_is_one_request() -> None:
    body = make_body({}, {"total_steps": "1000"}, {})
    group = make_group(body, "0-1", ["learning-rate=1e-4,3e-4", "algorithm.hidden_sizes=32"])
    assert group == {
        "job": body,
        "seeds": [0, 1],
        "grid": {"learning_rate": [1e-4, 3e-4], "algorithm.hidden_sizes": [[32]]},
    }
    assert make_group(body, None, []) is None


@pytest.mark.parametrize(
    ("grid", "words"),
    [
        (["learning_rate"], "FIELD=A,B"),
        (["learning_rate="], "FIELD=A,B"),
        (["speed=1"], "no setting speed"),
        (["seed=1", "seed=2"], "twice"),
        (["n_envs=64,63"], "does not divide"),
        (["clip_range=2"], "clip_range"),
    ],
)
def test_every_combination_of_a_sweep_is_checked_first(grid: list[str], words: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        make_group(make_body({}, {}, {}), None, grid)
    assert words in str(caught.value)


def test_the_expanded_job_trains_the_same_and_has_whole_rollouts() -> None:
    body = make_body({}, {"preset": "paper", "total_steps": "3M", "seed": "4"}, {"eval_episodes": "10"})
    job, notes = expanded_job(body)
    spec = TrainingSpec.model_validate(body["spec"])
    assert job["spec"]["algorithm"] == spec.algorithm.model_dump(mode="json"), "every setting of the preset is shown"
    assert job["spec"]["total_steps"] == spec.planned_steps != 3_000_000
    assert f"3,000,000 steps are rounded up to {spec.planned_steps:,}" in notes[0]
    assert job["evaluation"] == EvaluationSpec(episodes=10).model_dump(mode="json")
    again, none = expanded_job(make_body(job, {}, {}))
    assert (again["spec"], none) == (job["spec"], [])


@pytest.mark.parametrize("name", recipes.names())
def test_an_expanded_recipe_is_a_job_file(name: str) -> None:
    job, _ = expanded_job(make_body(read_recipe(name), {}, {}))
    assert TrainingSpec.model_validate(job["spec"]).planned_steps == job["spec"]["total_steps"]
    assert expanded_job(make_body(job, {}, {}))[0]["spec"] == job["spec"]


@pytest.mark.parametrize(
    ("flags", "seeds", "grid", "words"),
    [
        ({"seed": "3"}, "0-1", [], "--seeds and --seed contradict"),
        ({"learning_rate": "1e-4"}, None, ["learning_rate=1e-4,3e-4"], "--grid learning_rate and --learning-rate"),
        ({"seed": "3"}, None, ["seed=1,2"], "--grid seed and --seed"),
        ({}, "0-1", ["seed=1,2"], "--grid seed and --seeds"),
    ],
)
def test_a_sweep_does_not_vary_what_a_flag_sets(
    flags: dict[str, str], seeds: str | None, grid: list[str], words: str
) -> None:
    with pytest.raises(InvalidInput, match=words):
        make_group(make_body({}, flags, {}), seeds, grid, flags=flags)


def test_numbers_of_a_grid_may_be_abbreviated() -> None:
    group = make_group(make_body({}, {}, {}), None, ["total_steps=1M,250k"])
    assert group is not None
    assert group["grid"] == {"total_steps": [1_000_000, 250_000]}


@pytest.mark.parametrize(
    ("text", "moment"),
    [
        ("22:00", "2026-03-01T22:00:00+01:00"),
        ("9:30", "2026-03-02T09:30:00+01:00"),
        ("8h", "2026-03-01T20:00:00+01:00"),
        ("30min", "2026-03-01T12:30:00+01:00"),
        ("2026-12-01T06:00", "2026-12-01T06:00:00+01:00"),
        ("2026-12-01 06:00:00+00:00", "2026-12-01T06:00:00+00:00"),
    ],
)
def test_a_start_is_a_time_of_day_a_wait_or_a_date(text: str, moment: str) -> None:
    assert parse_moment(text, datetime(2026, 3, 1, 12, 0, 0, 500, timezone(timedelta(hours=1)))) == moment


FAR = ("9999-12-31T23:59:59-12:00", "9000-01-01T00:00:00Z", "3000000d", "0001-01-01T00:00:00+14:00", "1999-12-31")
"""Times that the service refuses."""


@pytest.mark.parametrize("text", ["25:00", "tonight", "99999999999999d", "8 weeks", *FAR])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(InvalidInput, match="--not-before"):
        parse_moment(text, datetime(2026, 3, 1, tzinfo=UTC))
