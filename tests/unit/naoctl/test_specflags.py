from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, get_args

import pytest
import typer
from naoctl.cli import build_app
from naoctl.commands.studies import make_search, tune
from naoctl.commands.submit import make_group, submit
from naoctl.errors import ExitCode, InvalidInput
from naoctl.specflags import (
    build,
    choices_of,
    flag_name,
    parse_flags,
    settings_of,
    spec_parameters,
    training_settings,
    with_parameters,
)
from naospec import EvaluationSpec, TrainingSpec, flat, plugins
from typer.models import OptionInfo
from typer.testing import CliRunner

ALIASES = (["steps"],)
"""Further flags of settings."""


def command_with_flags() -> tuple[typer.Typer, list[dict[str, Any]]]:
    seen: list[dict[str, Any]] = []

    def train(spec: dict[str, Any] = {}) -> None:  # noqa: B006
        """Train."""
        seen.append(spec)

    app = typer.Typer(rich_markup_mode=None)
    parameters = spec_parameters(training_settings(), panel="Training", aliases={"total_steps": ["--steps"]})
    app.command()(with_parameters(train, {"spec": parameters}))
    return app, seen


def spec_of(flags: dict[str, Any]) -> TrainingSpec:
    settings = training_settings()
    return build(
        TrainingSpec, flat.nest(parse_flags(settings, flags)), from_flags={name: settings[name] for name in flags}
    )


def test_every_setting_of_the_specification_has_a_flag() -> None:
    paths = {setting.path for setting in training_settings().values()}
    spec = TrainingSpec().model_dump()
    expected = {
        (section, field)
        for section in ("task", "robot", "simulator", "algorithm", "runtime")
        for field in spec[section]
        if field != "version"
    }
    assert paths >= expected | {("total_steps",), ("seed",)}
    names = {parameter.name for parameter in spec_parameters(training_settings(), panel="x")}
    assert names == set(training_settings())


@pytest.mark.parametrize("command", [submit, tune])
def test_settings_of_plugins_take_no_option_of_the_commands(command: Callable[..., None]) -> None:
    """Neither the flag nor the parameter; flags of evaluations begin with ``eval_``."""
    words = {name for names in ALIASES for name in names}
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        declared = [each for each in get_args(parameter.annotation) if isinstance(each, OptionInfo)]
        flags = [flag for option in declared for flag in option.param_decls or () if flag.startswith("--")]
        names = [name.lstrip("-").replace("-", "_") for flag in flags for name in flag.split("/")]
        words |= {parameter.name, *(name for name in names if not name.startswith("no_"))}
    assert words <= flat.OPTIONS


def test_a_plugins_setting_is_reached_under_its_prefixed_name(
    install: Callable[[str, str, Mapping[str, str]], None],
) -> None:
    """By flags, grids and spaces alike; the name alone means what it meant before."""
    fields = "\n".join(
        f"    {name}: int = Field(default=1, ge=0, le=9, title='A', description='A.')" for name in ("seed", "watch")
    )
    code = (
        "from naosprint.tasks import Task, TaskSettings\nfrom pydantic import Field\n\n\n"
        f"class Own(TaskSettings):\n{fields}\n\n\n"
        "class strays(Task[Own]):\n    name = summary = 'strays'\n    Parameters = Own\n"
    )
    install("straying", code, {"strays": plugins.TASKS})
    build_app()  # every command has its options
    spec = spec_of({"task": "strays", "seed": "5", "task_seed": "3", "task_watch": "4"})
    assert (spec.seed, spec.task.seed, spec.task.watch) == (5, 3, 4)  # type: ignore[attr-defined]
    body = {"spec": {"task": {"name": "strays"}}}
    grid = make_group(body, None, ["task_seed=2,3", "seed=1,2"])
    assert grid is not None and grid["grid"] == {"task_seed": [2, 3], "seed": [1, 2]}
    search = make_search(["task-seed=2..3", "seed=1..5"], [])
    assert set(search["space"]) == {"task_seed", "seed"}


def test_help_shows_each_field_with_its_description_and_bounds() -> None:
    app, _ = command_with_flags()
    text = " ".join(CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200", "TERM": "dumb"}).output.split())
    for field, setting in training_settings().items():
        assert flag_name(field) in text
        assert (setting.info.description or "").split(".")[0][:25] in text
    assert "(task velocity)" in text, "a setting of one task alone names it"
    assert "[above 0 and below 1]" in text


def test_only_given_flags_arrive() -> None:
    app, seen = command_with_flags()
    arguments = ["--steps", "1000", "--no-normalize-rewards", "--target-kl", "none", "--preset", "paper"]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert seen == [{"total_steps": "1000", "normalize_rewards": False, "target_kl": "none", "preset": "paper"}]


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ({"target_kl": "none"}, {"target_kl": None}),
        ({"target_kl": "0.5"}, {"target_kl": "0.5"}),
        ({"hidden_sizes": "64, 32"}, {"hidden_sizes": ["64", "32"]}),
        ({"sensor_digits": "3"}, {"sensor_digits": 3}),
        ({"kp": '{"legs": 60}'}, {"kp": {"legs": 60}}),
        ({"sensor_digits": "null"}, {"sensor_digits": None}),
        ({"task": "none"}, {"task": "none"}),
        ({"normalize_rewards": True}, {"normalize_rewards": True}),
        ({"total_steps": "3M"}, {"total_steps": "3000000"}),
        ({"total_steps": "250k"}, {"total_steps": "250000"}),
        ({"total_steps": "1.5m"}, {"total_steps": "1500000"}),
        ({"total_steps": "10 G"}, {"total_steps": "10000000000"}),
        ({"total_steps": "3MB"}, {"total_steps": "3MB"}),
        ({"total_steps": "M"}, {"total_steps": "M"}),
        ({"task": "3M"}, {"task": "3M"}),
    ],
)
def test_flag_values_become_field_values(flags: dict[str, Any], expected: dict[str, Any]) -> None:
    assert parse_flags(training_settings(), flags) == expected


def test_flags_reach_the_specification_as_numbers() -> None:
    spec = spec_of({"learning_rate": "1e-4", "hidden_sizes": "32,16", "n_envs": "64", "sensor_digits": "none"})
    algorithm = spec.algorithm
    assert (algorithm.learning_rate, algorithm.hidden_sizes, algorithm.n_envs) == (1e-4, (32, 16), 64)
    assert spec.simulator.sensor_digits is None


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"n_envs": "0"}, ["--n-envs", "greater than or equal to 1", "'0'"]),
        ({"total_steps": "3.0001k"}, ["--total-steps", "3000.1"]),
        ({"n_envs": "many"}, ["--n-envs", "valid integer", "'many'"]),
        ({"clip_range": "1.5"}, ["--clip-range", "less than 1"]),
        ({"task": "sprint9"}, ["--task", "sprint9", "sprint1"]),
        ({"batch_size": "77"}, ["--batch-size", "does not divide", "64"]),
        ({"learning_rate": "nan"}, ["--learning-rate"]),
        ({"sensor_digits": "7"}, ["--sensor-digits", "2 or 3"]),
        ({"preset": "swift"}, ["--preset", "fast"]),
        ({"hidden_sizes": "0"}, ["--hidden-sizes", "greater than or equal to 1"]),
        ({"min_height_m": "3"}, ["--min-height-m", "standing height"]),
        ({"robot": "t1", "sensor_digits": "2"}, ["--sensor-digits", "no such setting", "settle_steps"]),
        ({"task": "velocity", "drift_penalty": "1"}, ["--drift-penalty", "no such setting", "turn_weight"]),
        ({"kp": "60"}, ["--kp"]),
    ],
)
def test_errors_name_the_flag_and_what_is_right(flags: dict[str, str], words: list[str]) -> None:
    with pytest.raises(InvalidInput) as caught:
        spec_of(flags)
    assert caught.value.code is ExitCode.USAGE
    for word in words:
        assert word in str(caught.value)


def test_errors_of_a_file_name_the_field_and_the_file() -> None:
    with pytest.raises(
        InvalidInput, match=r"job\.yaml: spec\.algorithm\.n_env: ppo has no such setting: choose one of .*n_envs"
    ):
        build(TrainingSpec, {"algorithm": {"n_env": 3}}, where="job.yaml: spec.")
    with pytest.raises(InvalidInput, match=r"job\.yaml: spec\.n_envs: write algorithm\.n_envs"):
        build(TrainingSpec, {"n_envs": 3}, where="job.yaml: spec.")


def test_prefixed_flags_keep_two_models_apart() -> None:
    settings = settings_of(EvaluationSpec, leave_out=["task"])
    parameters = spec_parameters(settings, panel="x", prefix="eval_")
    assert "eval_seed" in {p.name for p in parameters}
    assert "eval_task" not in {p.name for p in parameters}
    assert parse_flags(settings, {"eval_simulator": "none"}, prefix="eval_") == {"simulator": None}
    with pytest.raises(InvalidInput, match="--eval-episodes"):
        build(EvaluationSpec, {"episodes": 0}, from_flags={"episodes": settings["episodes"]}, prefix="eval_")


def test_choices_come_from_literals_and_schema() -> None:
    settings = training_settings()
    assert "sprint2-erect" in settings["task"].choices
    assert set(choices_of(settings["preset"].info)) == {"fast", "paper", "custom"}
    assert choices_of(settings["sensor_digits"].info) == ("2", "3", "none")
    assert choices_of(settings["n_envs"].info) == ()


def test_a_command_keeps_its_own_parameters() -> None:
    def train(name: str = "x", spec: dict[str, Any] = {}) -> None:  # noqa: B006
        """Train."""

    made = with_parameters(train, {"spec": spec_parameters(settings_of(EvaluationSpec), panel="x")})
    assert list(inspect.signature(made).parameters)[:2] == ["name", "episodes"]
    assert made.__doc__ == "Train."
