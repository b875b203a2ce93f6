"""Texts of flags become values of settings, and errors name the flag."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import pytest
from naospec import EvaluationSpec, TrainingSpec
from naospec.flags import FlagError, choices_of, explain, parse_flags, read_switches, read_value
from naospec.flat import nest, settings, settings_of
from pydantic import Field, ValidationError
from pydantic.fields import FieldInfo


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ({"target_kl": "none"}, {"target_kl": None}),
        ({"target_kl": "0.5"}, {"target_kl": 0.5}),
        ({"hidden_sizes": "64, 32"}, {"hidden_sizes": [64, 32]}),
        ({"hidden_sizes": "64 32"}, {"hidden_sizes": [64, 32]}),
        ({"hidden_sizes": "[64, 32]"}, {"hidden_sizes": [64, 32]}),
        ({"entry_policies": "t1-run, 7"}, {"entry_policies": ["t1-run", "7"]}),
        ({"sensor_digits": "3"}, {"sensor_digits": 3}),
        ({"kp": '{"legs": 60}'}, {"kp": {"legs": 60}}),
        ({"kp": "{legs"}, {"kp": "{legs"}),
        ({"sensor_digits": "null"}, {"sensor_digits": None}),
        ({"sensor_digits": "None"}, {"sensor_digits": None}),
        ({"task": "none"}, {"task": "none"}),
        ({"advantage_normalization": "none"}, {"advantage_normalization": "none"}),
        ({"normalize_rewards": True}, {"normalize_rewards": True}),
        ({"normalize_rewards": "false"}, {"normalize_rewards": False}),
        ({"total_steps": "3M"}, {"total_steps": 3_000_000}),
        ({"total_steps": "250k"}, {"total_steps": 250_000}),
        ({"total_steps": "1.5m"}, {"total_steps": 1_500_000}),
        ({"total_steps": "10 G"}, {"total_steps": 10_000_000_000}),
        ({"total_steps": "1e6"}, {"total_steps": 1e6}),
        ({"total_steps": "3MB"}, {"total_steps": "3MB"}),
        ({"total_steps": "M"}, {"total_steps": "M"}),
        ({"seed": "true"}, {"seed": "true"}),
        ({"task": "3M"}, {"task": "3M"}),
        ({"walker": "123"}, {"walker": "123"}),
    ],
)
def test_texts_become_values(flags: dict[str, Any], expected: dict[str, Any]) -> None:
    assert parse_flags(settings(), flags) == expected


@pytest.mark.parametrize(
    ("annotation", "text", "value"),
    [
        (Annotated[int, Field(ge=1)] | None, "3k", 3000),
        (Literal[2, "auto"], "auto", "auto"),
        (Literal[2, "auto"], "2", 2),
        (float | dict[str, float], '{"legs": 1}', {"legs": 1}),
        (float | dict[str, float], "0.5", 0.5),
        (Any, "[1, 2]", [1, 2]),
        (Any, "word", "word"),
        (str, '{"a": 1}', '{"a": 1}'),
    ],
)
def test_types_that_plugins_may_use_are_read(annotation: Any, text: str, value: Any) -> None:
    assert read_value(text, FieldInfo(annotation=annotation)) == value


def test_the_task_of_an_evaluation_is_a_name_or_json() -> None:
    known = settings_of(EvaluationSpec)
    for text, speed in (("velocity", 2.0), ('{"name": "velocity", "forward_max_mps": 1}', 1.0)):
        spec = EvaluationSpec.model_validate(parse_flags(known, {"task": text}))
        assert spec.task is not None and spec.task.forward_max_mps == speed  # type: ignore[attr-defined]
    with pytest.raises(ValidationError) as caught:
        EvaluationSpec.model_validate(parse_flags(known, {"task": '{"name": "velocity", "wings": 2}'}))
    (line,) = explain(EvaluationSpec, caught.value, known)
    assert line.startswith("--task: wings: velocity has no such setting")


@pytest.mark.parametrize(
    ("words", "alone", "with_values"),
    [
        (["--a", "x"], ["--a", "x"], ["--a=true", "x"]),
        (["--no-a", "x"], ["--no-a", "x"], ["--a=false", "x"]),
        (["--a", "False", "x"], ["--no-a", "x"], ["--a=false", "x"]),
        (["--a=on"], ["--a"], ["--a=true"]),
        (["--a", "--b", "no"], ["--a", "--no-b"], ["--a=true", "--b=false"]),
        (["--c", "false", "--", "--a"], ["--c", "false", "--", "--a"], ["--c", "false", "--", "--a"]),
    ],
)
def test_switches_are_written_one_way(words: list[str], alone: list[str], with_values: list[str]) -> None:
    assert read_switches(words, ["--a", "--b"], paired=True) == alone
    assert read_switches(words, ["--a", "--b"], paired=False) == with_values


def test_a_switch_takes_no_other_value() -> None:
    with pytest.raises(FlagError, match=r"^--a: expected true or false, got 'maybe'$"):
        read_switches(["--a=maybe"], ["--a"], paired=True)


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        ({"kp": "{legs", "robot": "t1"}, "--kp: expected a JSON object (got '{legs')"),
        ({"kp": '{"legs": "a"}', "robot": "t1"}, "--kp: legs: input should be a valid number, unable to parse string"),
        ({"hidden_sizes": "8 x"}, "--hidden-sizes: input should be a valid integer, unable to parse string"),
        ({"n_envs": "7"}, "job.yaml: algorithm.batch_size: 2048 does not divide"),
        ({"batch_size": "7"}, "--batch-size: 7 does not divide"),
    ],
)
def test_errors_name_the_flag_or_the_place_in_the_file(flags: dict[str, str], line: str) -> None:
    known = settings()
    with pytest.raises(ValidationError) as caught:
        TrainingSpec.model_validate(nest(parse_flags(known, flags)))
    found = explain(TrainingSpec, caught.value, {name: known[name] for name in flags}, where="job.yaml: ")
    assert len(found) == 1 and found[0].startswith(line)


def test_choices_come_from_literals_and_schema() -> None:
    known = settings()
    assert "sprint2-erect" in known["task"].choices
    assert set(choices_of(known["preset"].info)) == {"fast", "paper", "custom"}
    assert choices_of(known["sensor_digits"].info) == ("2", "3", "none")
    assert choices_of(known["n_envs"].info) == ()
