from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

import pytest
import typer
from naoctl.cli import build_app
from naoctl.cli import main as naoctl
from naoctl.commands.artifacts import condition_values
from naoctl.commands.studies import make_search, tune
from naoctl.commands.submit import make_body, make_group, submit
from naoctl.errors import ExitCode, InvalidInput
from naoctl.specflags import build, spec_parameters, training_settings, with_parameters
from naospec import EvaluationSpec, TrainingSpec, flat, plugins
from naospec.flags import choices_of, flag_name, help_text, metavar, parse_flags
from naospec.flat import Setting, settings_of
from naosprint.__main__ import _given, _parser, main
from pydantic import ValidationError
from typer.main import get_command
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
    parameters = spec_parameters(training_settings(), panel="Training")
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


TWO_DECLARATIONS = """
from naosprint.tasks import Task, TaskSettings
from pydantic import Field


class LowSettings(TaskSettings):
    limit_m: float = Field(default=1.0, le=2.0, description="Lowest height.")
    sizes: float = Field(default=0.5, description="Size of the box.")
    marked: int = Field(default=1, description="Marks.")


class alow(Task[LowSettings]):
    name = summary = "alow"
    Parameters = LowSettings


class HighSettings(TaskSettings):
    limit_m: float | None = Field(default=None, description="Greatest height.")
    sizes: list[int] = Field(default=[1], description="Sizes of the steps.")
    marked: bool = Field(default=False, description="Whether it is marked.")


class high(Task[HighSettings]):
    name = summary = "high"
    Parameters = HighSettings
"""


def test_a_setting_of_two_plugins_is_read_as_the_chosen_one_declares_it(
    install: Callable[[str, str, Mapping[str, str]], None],
) -> None:
    install("heights", TWO_DECLARATIONS, {"alow": plugins.TASKS, "high": plugins.TASKS})
    flags = {"limit_m": "none", "sizes": "64,32", "marked": "true"}
    expected = {"limit_m": None, "sizes": [64, 32], "marked": True}
    for file, given in (({}, {"task": "high", **flags}), ({"spec": {"task": {"name": "high"}}}, flags)):
        body = make_body(file, given, {})
        assert {name: body["spec"]["task"][name] for name in flags} == expected
    assert condition_values(["limit_m=none", "sizes=64"], "high") == {"limit_m": None, "sizes": [64]}
    grid = make_group(body, None, ["limit_m=none,2"])
    assert grid is not None and grid["grid"] == {"limit_m": [None, 2.0]}
    assert make_search(["marked=true|false"], [], base=body["spec"])["space"]["marked"]["choices"] == [True, False]
    known = training_settings()
    assert help_text(known["limit_m"]) == "Lowest height. [at most 2] (task alow) Greatest height. (task high)"
    assert metavar(known["limit_m"]) == "NUMBER|none" and metavar(known["marked"]) == "INTEGER|true|false"
    output = CliRunner().invoke(build_app(), ["spec", "limit_m", "--json"]).output
    assert [(each["only_for"], each["bounds"]) for each in json.loads(output)] == [
        (["task alow"], "at most 2"), (["task high"], "")
    ]  # fmt: skip


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


def test_flags_reach_the_specification_as_numbers() -> None:
    spec = spec_of({"learning_rate": "1e-4", "hidden_sizes": "32,16", "n_envs": "64", "sensor_digits": "none"})
    algorithm = spec.algorithm
    assert (algorithm.learning_rate, algorithm.hidden_sizes, algorithm.n_envs) == (1e-4, (32, 16), 64)
    assert spec.simulator.sensor_digits is None


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"n_envs": "0"}, ["--n-envs", "greater than or equal to 1", "got 0"]),
        ({"total_steps": "3.0001k"}, ["--steps/--total-steps: ", "3000.1"]),
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


def test_a_command_keeps_its_own_parameters() -> None:
    def train(name: str = "x", spec: dict[str, Any] = {}) -> None:  # noqa: B006
        """Train."""

    made = with_parameters(train, {"spec": spec_parameters(settings_of(EvaluationSpec), panel="x")})
    assert list(inspect.signature(made).parameters)[:2] == ["name", "episodes"]
    assert made.__doc__ == "Train."


def spec_with(values: Mapping[str, Any]) -> TrainingSpec | None:
    """Return the specification with some settings, or None if it is not valid."""
    try:
        return TrainingSpec.model_validate(flat.nest(values))
    except ValidationError:
        return None


def starts_of(setting: Setting, known: dict[str, Any]) -> list[tuple[dict[str, str], Any]]:
    """Return the trainings, by section, that have a setting, with its default; ``known`` remembers their contents."""
    found = []
    for robot in ({}, {"robot": "t1"}):
        start = {**robot, **({setting.path[0]: setting.plugins[0]} if setting.plugins else {})}
        if str(start) not in known:
            spec = spec_with(start)
            known[str(start)] = {} if spec is None else spec.model_dump(mode="json")
        content = known[str(start)] if len(setting.path) == 1 else known[str(start)].get(setting.path[0], {})
        found += [(start, content[setting.path[-1]])] if setting.path[-1] in content else []
    return found


def values_of(setting: Setting, default: Any) -> list[Any]:
    """Return values of a setting to try, its default last."""
    words = [*setting.choices, *choices_of(setting.info)]
    near = [not default] if isinstance(default, bool) else [default + 1] if isinstance(default, int | float) else []
    others = [0.3, 0.05, 2, 0, [32, 16], {"legs": 60.0}, "t1-run-wide", ["t1-run"]]
    return [*(value for value in (*words, *near, *others) if value not in (default, "none")), default]


def spellings_of(flag: str, value: Any) -> list[list[str]]:
    """Return the ways to write a flag with a value."""
    if isinstance(value, bool):
        words = ("true", "Yes", "1") if value else ("false", "OFF", "0")
        return [[flag] if value else [f"--no-{flag[2:]}"], [f"{flag}={words[0]}"], *([flag, word] for word in words)]
    texts = [json.dumps(value) if isinstance(value, list | dict) else str(value)]
    if isinstance(value, int):
        texts += [f"{value / 1000:.9g}k", f"{value:.12e}", f" {value} "]
    elif isinstance(value, list):
        texts += [sign.join(map(str, value)) for sign in (",", " ", ", ")]
    elif value is None:
        texts += ["none", "NULL"]
    return [[flag, texts[0]], *([f"{flag}={text}"] for text in texts)]


def test_both_programs_read_every_setting_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """In every spelling; the lines have a spelling of each setting."""
    known = training_settings()
    monkeypatch.setattr(flat, "settings", lambda: known)  # plug-ins are read once
    contents: dict[str, Any] = {}
    cases: dict[str, list[tuple[dict[str, str], list[str], TrainingSpec]]] = {}
    for name, setting in known.items():
        starts = starts_of(setting, contents)
        tried = ((start, value) for value in values_of(setting, starts[0][1]) for start, _ in starts)
        start, value, spec = next((*pair, spec) for pair in tried if (spec := spec_with({**pair[0], name: pair[1]})))
        cases[name] = [(start, words, spec) for words in spellings_of(flag_name(name), value)]
        if "none" not in choices_of(setting.info)[:-1] and (spec := spec_with({**start, name: None})):
            cases[name] += [(start, words, spec) for words in spellings_of(flag_name(name), None)]
    submit_command, parser = get_command(build_app("submit")).commands["submit"], _parser()  # type: ignore[attr-defined]
    specs: dict[tuple[str, str], TrainingSpec | None] = {}
    for number in range(max(map(len, cases.values()))):
        chosen = {name: spellings[number % len(spellings)] for name, spellings in cases.items()}
        line = [word for _, words, _ in chosen.values() for word in words]
        params = submit_command.make_context("submit", [*line]).params
        read = parse_flags(known, {name: params[name] for name in known})
        assert read == parse_flags(known, _given(parser.parse_args(["train", "work", *line])))
        for name, (start, words, spec) in chosen.items():
            written = (name, repr(read[name]))
            if written not in specs:
                specs[written] = spec_with({**start, name: read[name]})
            assert specs[written] == spec, words


def test_both_programs_explain_wrong_values_alike(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Naming the flags that were typed."""
    contents: dict[str, Any] = {}
    lines: dict[tuple[str, ...], list[str]] = {}
    for name, setting in training_settings().items():
        if setting.info.annotation is bool or setting.choices:  # one switch is enough
            lines[name if setting.choices else "switch",] = [f"{flag_name(name)}=wrong!"]
        else:
            first, _ = starts_of(setting, contents)[0]
            start = tuple(f"{flag_name(section)}={plugin}" for section, plugin in first.items())
            lines.setdefault(start, [*start]).append(f"{flag_name(name)}=wrong!")
    for line in lines.values():
        wrong = {word.partition("=")[0] for word in line if word.endswith("!")}
        assert main(["train", str(tmp_path), *line]) == 2
        explained = capsys.readouterr().err.splitlines()
        assert {each.partition(":")[0].rpartition("/")[2] for each in explained} == wrong
        with pytest.raises(SystemExit) as ended:
            naoctl(["submit", "--dry-run", *line])
        assert ended.value.code == 2
        assert capsys.readouterr().err == f"naoctl: {'; '.join(explained)}\n"


def test_a_word_after_a_switch_may_be_an_argument(tmp_path: Path) -> None:
    """The same in both programs."""
    file = tmp_path / "job.yaml"
    file.write_text("spec: {}\n", encoding="utf-8")
    for words, value in (([], True), (["false"], False)):
        line = ["--symmetric-policy", *words, str(file)]
        done = CliRunner().invoke(build_app("submit"), ["submit", "--dry-run", *line])
        assert json.loads(done.stdout)["spec"]["algorithm"]["symmetric_policy"] is value
        options = _parser().parse_args(["train", *line])
        assert (options.workdir, parse_flags(options.settings, _given(options))) == (file, {"symmetric_policy": value})
    options = _parser().parse_args(["evaluate", "--no-deterministic", "sprint", "--episodes", "1k"])
    assert (options.checkpoint, parse_flags(options.settings, _given(options))) == (
        "sprint",
        {"deterministic": False, "episodes": 1000},
    )
    flags = get_command(build_app("eval")).commands["eval"].make_context("eval", ["--deterministic", "no", "last"])  # type: ignore[attr-defined]
    assert (flags.params["job"], flags.params["eval_deterministic"]) == ("last", False)


def test_another_seed_moves_those_of_the_stages_along() -> None:
    recipe = {"seed": 1, "stages": [{"steps": 512, "seed": 121}, {"steps": 512}]}
    body = make_body({"spec": recipe}, {"seed": "3"}, {})
    assert [stage.seed for stage in TrainingSpec.model_validate(body["spec"]).stage_specs] == [123, 3]


def test_gains_of_several_joints_are_submitted() -> None:
    body = make_body({}, {"robot": "t1", "kp": '{"legs": 60}'}, {})
    assert TrainingSpec.model_validate(body["spec"]) == spec_of({"robot": "t1", "kp": '{"legs": 60}'})


def test_conditions_are_read_as_the_flags_of_their_settings() -> None:
    conditions = ["push_steps=1k", "extra_delay_max=NONE", "entry_policies=a,b", "course=true", "unknown=0.5"]
    assert condition_values(conditions) == {
        "push_steps": 1000,
        "extra_delay_max": None,
        "entry_policies": ["a", "b"],
        "course": True,
        "unknown": 0.5,
    }
