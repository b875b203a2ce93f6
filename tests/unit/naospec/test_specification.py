"""Specifications accept valid values and name invalid ones."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from naosim import robots
from naospec import EvaluationSpec, TrainingSpec, plugins, presets, recipes, validation_words
from naospec.flat import nest, settings
from naospec.sections import variants
from naosprint.tasks.robot_defaults import robot_defaults
from pydantic import ValidationError


def spec_of(**values: Any) -> TrainingSpec:
    """Return a specification with settings by their short names."""
    return TrainingSpec.model_validate(nest(values))


def words_of(content: dict[str, Any]) -> str:
    """Return the error of an invalid specification."""
    with pytest.raises(ValidationError) as caught:
        TrainingSpec.model_validate(content)
    return validation_words(caught.value.errors())


def test_defaults_are_those_of_preset_fast() -> None:
    """Omitted settings have the preset's values, regardless of the sections' defaults."""
    spec = TrainingSpec()
    assert (spec.task.name, spec.robot.name, spec.simulator.name) == ("sprint1", "nao-0", "embedded")
    assert (spec.algorithm.name, spec.algorithm.preset) == ("ppo", "fast")
    for section in presets.SECTIONS:
        for name, value in presets.values("fast", section, "nao").items():
            found = getattr(getattr(spec, section), name, value)
            assert found == (tuple(value) if isinstance(value, list) else value), name
    assert spec.overrides() == {}


def test_preset_paper_is_table_two() -> None:
    """Preset paper has the hyperparameters of the paper's table II."""
    algorithm = TrainingSpec.model_validate({"algorithm": {"preset": "paper"}}).algorithm
    assert (algorithm.n_envs, algorithm.n_steps, algorithm.batch_size, algorithm.n_epochs) == (19, 4096, 19 * 64, 10)
    assert (algorithm.clip_range, algorithm.learning_rate, algorithm.gamma, algorithm.gae_lambda) == (
        *(0.1, 1e-4, 0.99, 0.95),
    )
    assert (algorithm.entropy_coefficient, algorithm.observation_clip, algorithm.initial_log_std) == (0.0, 5.0, 0.0)
    assert algorithm.learning_rate_schedule == "constant"
    assert algorithm.hidden_sizes == (64, 64)
    assert not algorithm.normalize_rewards
    assert not algorithm.symmetric_policy
    assert not algorithm.bootstrap_at_end
    assert spec_of(preset="paper").task.reward_scale == 100.0


def test_overrides_name_what_differs_from_the_preset() -> None:
    spec = spec_of(preset="paper", clip_range=0.2, drift_penalty=0.5, seed=5)
    assert spec.overrides() == {"algorithm.clip_range": 0.2, "task.drift_penalty": 0.5}
    assert spec.seed == 5


@pytest.mark.parametrize("robot", robots.names())
def test_what_was_written_leaves_out_what_others_decide(robot: str) -> None:
    """Only chosen settings are left, so that another preset or robot can decide the rest."""
    spec = spec_of(robot=robot, preset="fast", learning_rate=1e-4, total_steps=1000)
    written = spec.written()
    content = written.content
    assert content["algorithm"] == {"name": "ppo", "preset": "fast", "learning_rate": 1e-4}
    assert "min_height_m" not in content["task"]
    assert TrainingSpec.model_validate(written) == spec
    other = TrainingSpec.model_validate(written.with_settings({"preset": "paper"}))
    assert (other.algorithm.learning_rate, other.algorithm.clip_range) == (1e-4, 0.1)


def test_sections_have_a_short_form() -> None:
    """A name alone stands for a section without settings."""
    short = TrainingSpec.model_validate({"task": "sprint2", "robot": "nao-1", "simulator": "server"})
    long = TrainingSpec.model_validate(
        {"task": {"name": "sprint2"}, "robot": {"name": "nao-1"}, "simulator": {"name": "server"}}
    )
    assert short == long


def test_json_round_trip_keeps_the_specification_and_its_digest() -> None:
    """A stored specification is read back unchanged, stages included."""
    stages = [
        {"steps": 1000, "seed": 3, "algorithm": {"clip_range": 0.1}},
        {"steps": 1000, "task": {"reward_scale": 1}},
    ]
    for spec in (
        spec_of(preset="paper", task="sprint2-erect", hidden_sizes=(32, 15), target_kl=None),
        TrainingSpec.model_validate({"stages": stages}),
    ):
        again = TrainingSpec.model_validate_json(spec.model_dump_json())
        assert again == spec
        assert again.digest() == spec.digest()
        assert TrainingSpec.model_validate(spec.model_dump()) == spec


def test_digest_tells_specifications_apart_but_not_runtimes() -> None:
    """Everything but the runtime settings changes what is learned."""
    digest = TrainingSpec().digest()
    assert len(digest) == 64
    assert spec_of(simulator_threads=7, checkpoint_interval_steps=5).digest() == digest
    for change in ({"seed": 1}, {"robot": "nao-1"}, {"sensor_digits": 3}, {"drift_penalty": 0.0}, {"total_steps": 5}):
        assert spec_of(**change).digest() != digest


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"task": "sprint9"}, ["task: unknown task 'sprint9': choose one of", "sprint1", "sprint2-erect"]),
        ({"robot": "asimo"}, ["robot: unknown robot 'asimo'", "nao-4"]),
        ({"simulator": "gazebo"}, ["simulator: unknown simulator 'gazebo'", "embedded"]),
        ({"algorithm": "sac"}, ["algorithm: unknown algorithm 'sac'", "ppo"]),
        ({"algorithm": {"preset": "slow"}}, ["algorithm.preset", "fast"]),
        ({"algorithm": {"n_envs": 0}}, ["algorithm.n_envs", "1"]),
        ({"algorithm": {"batch_size": 5000}}, ["algorithm: batch_size: 5000 does not divide", "8192", "4096"]),
        ({"algorithm": {"hidden_sizes": [64, 33]}}, ["hidden_sizes", "even", "symmetric_policy=false"]),
        ({"algorithm": {"target_kl": None}}, ["target_kl", "adaptive"]),
        ({"algorithm": {"n_steps": 1_000_000, "batch_size": 1_000_000}}, ["n_steps", "128000000"]),
        ({"algorithm": {"learning_rate": float("nan")}}, ["algorithm.learning_rate"]),
        ({"algorithm": {"gamma": float("inf")}}, ["algorithm.gamma"]),
        ({"algorithm": {"hidden_sizes": [64, 0]}}, ["algorithm.hidden_sizes"]),
        ({"task": {"name": "sprint1", "min_height_m": 0.385}}, ["task.min_height_m: 0.385", "standing height"]),
        (
            {"task": {"name": "sprint1", "min_height_m": 0.4}, "robot": "nao-2"},
            ["task.min_height_m: 0.4", "robot nao-2"],
        ),
        (
            {"task": {"name": "sprint1", "version": 99}},
            [
                "task.version: the specification is for version 99 of task 'sprint1', installed is version 1",
                "install the version of its package that has version 99, or train with the installed one",
            ],
        ),
        ({"task": {"name": "sprint1", "finish": 3}}, ["task.finish"]),
        ({"total_steps": 0}, ["total_steps"]),
        ({"runtime": {"max_server_failures": -1}}, ["runtime.max_server_failures", "0"]),
        ({"colour": "red"}, ["colour"]),
        ({"task": 3}, ["task: expected a name, or a mapping"]),
        ({"task": {"name": 3}}, ["task: `name` is missing"]),
        ({"algorithm": {"preset": ["fast"]}}, ["algorithm.preset"]),
        ({"simulator": {"name": "embedded", "sensor_digits": 7}}, ["simulator.sensor_digits"]),
    ],
)
def test_impossible_specifications_are_refused_by_field(content: dict[str, Any], words: list[str]) -> None:
    """The message names the field and a remedy."""
    message = words_of(content)
    for word in words:
        assert word in message


@pytest.mark.parametrize("name", [name for name, setting in settings().items() if len(setting.path) == 2])
def test_a_setting_outside_its_section_is_refused_with_its_place(name: str) -> None:
    if name not in TrainingSpec.model_fields:
        assert words_of({name: 1}) == f"{name}: write {'.'.join(settings()[name].path)}"


def test_all_misplaced_settings_are_named_at_once() -> None:
    message = words_of({"preset": "fast", "learner_threads": 2})
    assert message == "preset: write algorithm.preset; learner_threads: write runtime.learner_threads"


def test_specification_is_frozen() -> None:
    """A specification cannot change under a running job."""
    spec = TrainingSpec()
    for target, name in ((spec, "seed"), (spec.task, "reward_scale"), (spec.algorithm, "n_envs")):
        with pytest.raises(ValidationError):
            setattr(target, name, 4)


def test_planned_steps_are_whole_rollouts() -> None:
    """Total steps are rounded up to whole rollouts, those of each stage by themselves."""
    spec = spec_of(total_steps=200_000)
    assert (spec.rollout_steps, spec.planned_steps) == (8_192, 25 * 8_192)
    staged = TrainingSpec.model_validate(
        {"stages": [{"steps": 10_000}, {"steps": 10_000, "algorithm": {"n_steps": 128}}]}
    )
    assert staged.total_steps == 20_000
    assert staged.planned_steps == 2 * 8_192 + 16_384


def test_stages_override_algorithm_and_task() -> None:
    spec = TrainingSpec.model_validate(
        {
            "seed": 4,
            "algorithm": {"learning_rate": 1e-3},
            "stages": [
                {"steps": 1000},
                {"steps": 500, "seed": 7, "algorithm": {"clip_range": 0.1}, "task": {"drift_penalty": 0.0}},
            ],
        }
    )
    first, second = spec.stage_specs
    assert (first.seed, second.seed) == (4, 7)
    assert (first.algorithm.clip_range, second.algorithm.clip_range) == (0.2, 0.1)
    assert (first.task.drift_penalty, second.task.drift_penalty) == (1.0, 0.0)
    assert first.algorithm.learning_rate == second.algorithm.learning_rate == 1e-3
    assert (first.total_steps, second.total_steps, first.stages) == (1000, 500, ())
    assert TrainingSpec().stage_specs == (TrainingSpec(),)


def test_a_stage_with_another_robot_has_that_robots_own_settings() -> None:
    """Chosen settings are kept; those that depend on the training's robot are not."""
    stages = [{"steps": 10, "robot": "k1"}, {"steps": 10}]
    spec = TrainingSpec.model_validate(
        {"robot": "t1", "task": {"name": "sprint1", "drift_penalty": 0.25}, "stages": stages}
    )
    first, second = spec.stage_specs
    assert (first.robot.name, second.robot.name) == ("k1", "t1")
    assert first.task.min_height_m == robot_defaults(robots.get("k1")).fall_height_m
    assert second.task.min_height_m == robot_defaults(robots.get("t1")).fall_height_m
    assert first.task.drift_penalty == second.task.drift_penalty == 0.25
    chosen = TrainingSpec.model_validate(
        {"robot": "t1", "task": {"name": "sprint1", "min_height_m": 0.3}, "stages": stages}
    )
    assert [stage.task.min_height_m for stage in chosen.stage_specs] == [0.3, 0.3]


def test_a_stage_with_another_task_has_that_tasks_own_settings() -> None:
    """The preset's values for that task hold; settings of the training's task do not."""
    spec = TrainingSpec.model_validate(
        {
            "robot": "t1",
            "task": {"name": "velocity", "torque_penalty": 0.5, "forward_max_mps": 2.2},
            "algorithm": {"preset": "fast"},
            "stages": [{"steps": 10, "task": {"name": "sprint1", "drift_penalty": 0.5}}, {"steps": 10}],
        }
    )
    alone = TrainingSpec.model_validate(
        {"robot": "t1", "task": {"name": "sprint1", "drift_penalty": 0.5}, "algorithm": {"preset": "fast"}}
    )
    first, second = spec.stage_specs
    assert first.task == alone.task and first.algorithm == alone.algorithm
    assert second.task == spec.task
    assert TrainingSpec.model_validate_json(spec.model_dump_json()) == spec


@pytest.mark.parametrize(
    ("stages", "words"),
    [
        ([{"steps": 0}], "stages.0.steps"),
        ([{"steps": 10}, {"steps": 10, "algorithm": {"clip_range": 7}}], "stages.1.algorithm.clip_range"),
        ([{"steps": 10, "algorithm": {"preset": "paper"}}], "stages.0.algorithm.preset: cannot differ between stages"),
        ([{"steps": 10, "task": {"name": "sprint9"}}], "stages.0.task: unknown task"),
        ([{"steps": 10, "task": {"version": 2}}], "stages.0.task.version: cannot differ between stages"),
        ([{"steps": 10, "algorithm": {"name": "ppo"}}], "stages.0.algorithm.name: cannot differ between stages"),
        ([{"steps": 10}, {"steps": 10, "algorithm": {"hidden_sizes": [8]}}], "stages.1.algorithm: all stages train"),
        (
            [{"steps": 10, "algorithm": {"symmetric_policy": False}}, {"steps": 10}],
            "stages.1.algorithm: all stages train the same policy, so symmetric_policy cannot be True after False",
        ),
        ([{"steps": 10}, {"steps": 10, "algorithm": {"normalize_observations": False}}], "normalize_observations"),
        ([{"steps": 10, "robot": "nao-9"}], "stages.0.robot: unknown robot"),
        ([{"steps": 10, "task": {"min_height_m": 0.385}}], "stages.0: task.min_height_m: 0.385"),
        ([{"steps": 10, "algorithm": {"batch_size": 5000}}], "stages.0.algorithm: batch_size: 5000 does not divide"),
    ],
)
def test_impossible_stages_are_refused_by_place(stages: list[dict[str, Any]], words: str) -> None:
    assert words in words_of({"stages": stages})


def test_a_later_stage_need_not_treat_left_and_right_alike() -> None:
    stages = [{"steps": 10}, {"steps": 10, "algorithm": {"symmetric_policy": False}}]
    spec = TrainingSpec.model_validate({"algorithm": {"preset": "fast"}, "stages": stages})
    assert [stage.algorithm.symmetric_policy for stage in spec.stage_specs] == [True, False]


@pytest.mark.parametrize(
    ("content", "sentences"),
    [
        ({"robot": "t1", "task": {"name": "velocity", "push_steps": 100, "friction_min": 1.0}}, []),
        ({"robot": "t1", "task": {"name": "velocity", "push_steps": 50, "push_mps": 1.0}}, []),
        ({"robot": "t1", "task": {"name": "velocity", "undisturbed_fraction": 0.5, "friction_min": 0.5}}, []),
        (
            {"robot": "t1", "task": {"name": "velocity", "push_steps": 50}},
            ["task.push_steps: 50 has no effect without push_mps"],
        ),
        (
            {"robot": "t1", "task": {"name": "velocity", "episode_worlds": True, "sensor_noise": 1.0}},
            [
                "task.episode_worlds: True has no effect without mass_variation or gain_variation or centre_of_mass_m "
                "or friction_min or friction_max or stiffness_min or stiffness_max or gravity_min"
            ],
        ),
        (
            {"robot": "t1", "task": {"name": "getup", "start_noise_deg": 5.0}},
            ["task.start_noise_deg: 5.0 has no effect in task getup"],
        ),
        (
            {"algorithm": {"target_kl": None, "target_kl_final": 0.01, "learning_rate_schedule": "constant"}},
            ["algorithm.target_kl_final: 0.01 has no effect without target_kl"],
        ),
    ],
)
def test_settings_that_change_nothing_are_named(content: dict[str, Any], sentences: list[str]) -> None:
    assert TrainingSpec.model_validate(content).without_effect() == sentences


def test_a_setting_has_an_effect_if_it_has_one_in_a_stage() -> None:
    task = {"name": "velocity", "push_steps": 50}
    stages: list[dict[str, Any]] = [{"steps": 1000}, {"steps": 1000, "task": {"push_mps": 1.0}}]
    content = {"robot": "t1", "task": task, "stages": stages}
    assert TrainingSpec.model_validate(content).without_effect() == []
    assert TrainingSpec.model_validate(content | {"stages": stages[:1]}).without_effect()


@pytest.mark.parametrize("name", recipes.names())
def test_every_setting_of_a_recipe_has_an_effect(name: str) -> None:
    assert TrainingSpec.model_validate(recipes.job(name)["spec"]).without_effect() == []


def test_stages_with_tuples_equal_themselves_after_a_file() -> None:
    spec = TrainingSpec.model_validate({"stages": [{"steps": 1000, "algorithm": {"hidden_sizes": (64, 32)}}]})
    assert TrainingSpec.model_validate_json(spec.model_dump_json()) == spec


def test_total_steps_are_the_stages_sum() -> None:
    assert "total_steps: 7 is not the sum of the stages' steps, 30" in words_of(
        {"total_steps": 7, "stages": [{"steps": 10}, {"steps": 20}]}
    )


def test_schema_documents_every_field() -> None:
    """The job form and the reference page get a title and a description for each field of each plug-in."""
    for model in (TrainingSpec, EvaluationSpec):
        for name, field in model.model_json_schema()["properties"].items():
            assert field.get("description"), name
            assert field.get("title"), name
    properties = TrainingSpec.model_json_schema()["properties"]
    for section in ("task", "robot", "simulator", "algorithm"):
        options = properties[section]["oneOf"]
        group = properties[section]["x-plugin-group"]
        assert {option["properties"]["name"]["const"] for option in options} == set(plugins.names(group))
        for option in options:
            for name, field in option["properties"].items():
                assert field.get("title"), (section, name)
                assert field.get("description"), (section, name)


def test_every_setting_has_one_short_name() -> None:
    """Flags and tables use it; the path leads back to the setting."""
    known = settings()
    assert len({setting.path for setting in known.values()}) == len(known)
    for name in ("task", "robot", "simulator", "algorithm", "learning_rate", "min_height_m", "sensor_digits", "seed"):
        assert name in known
    assert known["robot"].choices == plugins.names(plugins.ROBOTS)
    assert "sprint1" in known["min_height_m"].plugins
    assert known["reward_scale"].plugins == ()


def test_nest_puts_values_in_their_sections() -> None:
    base = {"task": "sprint2", "algorithm": {"name": "ppo", "n_envs": 4}}
    found = nest({"learning_rate": 1e-4, "algorithm.n_envs": 8, "seed": 3, "robot": "nao-1"}, base)
    assert found == {
        "task": {"name": "sprint2"},
        "algorithm": {"name": "ppo", "n_envs": 8, "learning_rate": 1e-4},
        "seed": 3,
        "robot": {"name": "nao-1"},
    }
    assert base["algorithm"] == {"name": "ppo", "n_envs": 4}
    for name in ("colour", "weather.rain", "task.a.b"):
        with pytest.raises(KeyError, match=name):
            nest({name: 1})


def test_evaluations_run_the_trainings_task_or_another() -> None:
    trained = spec_of(robot="nao-1", drift_penalty=0.25, min_height_m=0.3)
    same = EvaluationSpec().applied_to(trained)
    assert (same.task, same.robot, same.simulator) == (trained.task, trained.robot, trained.simulator)
    other = EvaluationSpec.model_validate({"task": "sprint2", "start_noise_deg": 0.0, "simulator": "server"})
    applied = other.applied_to(trained)
    assert (applied.task.name, applied.task.start_noise_deg, applied.simulator.name) == ("sprint2", 0.0, "server")
    assert applied.robot == trained.robot
    staged = TrainingSpec.model_validate({"stages": [{"steps": 10}, {"steps": 10, "task": {"drift_penalty": 0.0}}]})
    assert EvaluationSpec().applied_to(staged).task.drift_penalty == 0.0


def test_settings_of_an_evaluations_task_replace_those_of_the_training_and_no_others() -> None:
    """Also when it has been stored and read: what was not given is the training's, undisturbed, not a default."""
    trained = TrainingSpec.model_validate(
        {"robot": "t1", "task": {"name": "kick", "least_share": 0.6, "friction_min": 0.5, "history_steps": 2}}
    )
    evaluation = EvaluationSpec.model_validate({"task": {"name": "kick", "friction_max": 0.6, "friction_min": 0.6}})
    assert evaluation.model_dump()["task"] == {"name": "kick", "friction_max": 0.6, "friction_min": 0.6}
    for each in (evaluation, EvaluationSpec.model_validate_json(evaluation.model_dump_json())):
        task = each.applied_to(trained).task
        assert task == trained.task.for_evaluation().model_copy(update={"friction_max": 0.6, "friction_min": 0.6})
    other = EvaluationSpec(task={"name": "velocity"}).applied_to(trained).task
    assert other == TrainingSpec(robot="t1", task={"name": "velocity", "history_steps": 2}).task


@pytest.mark.parametrize("setting", ["disturbance_growth", "command_growth"])
def test_evaluations_refuse_what_only_changes_a_trainings_beginning(setting: str) -> None:
    with pytest.raises(ValidationError, match=f"{setting} has a meaning for trainings only; leave it out"):
        EvaluationSpec(task={"name": "velocity", setting: 0.1})
    EvaluationSpec(task={"name": "velocity", setting: 0.0})


def test_evaluations_take_the_exact_engine_or_another() -> None:
    for robot in ("t1", "k1"):
        trained = spec_of(robot=robot)
        for engine in (None, "fast", "mujoco"):
            assert EvaluationSpec(engine=engine).applied_to(trained).simulator.engine == (engine or "mujoco")
            # also where it was trained on a server
            moved = EvaluationSpec(simulator="embedded", engine=engine)
            setting = moved.applied_to(spec_of(robot=robot, simulator="server"))
            assert (setting.simulator.name, setting.simulator.engine) == ("embedded", engine or "mujoco")
    for robot, engine, words in (
        ("t1", "quick", r"(?m)^engine\n  Input should be 'fast' or 'mujoco'"),
        ("nao-0", "fast", r"(?m)^engine\n  embedded with robot nao-0 has no such setting"),
    ):
        with pytest.raises(ValidationError, match=words):
            EvaluationSpec(engine=engine).applied_to(spec_of(robot=robot))


def test_evaluations_refuse_what_does_not_exist() -> None:
    for content, words in (
        ({"task": "marathon"}, "sprint1"),
        ({"simulator": "gazebo"}, "embedded"),
        ({"episodes": 0}, "1"),
    ):
        with pytest.raises(ValidationError, match=words):
            EvaluationSpec.model_validate(content)
    assert EvaluationSpec().episodes == 1000


def _numbers(schema: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the numbers of a settings model, with their schema."""
    for name, field in schema["properties"].items():
        for option in (field, *field.get("anyOf", ())):
            if option.get("type") in ("number", "integer") and not {"enum", "const"} & option.keys():
                yield name, option


@pytest.mark.parametrize("group", [plugins.TASKS, plugins.ROBOTS, plugins.SIMULATORS, plugins.LEARNERS])
def test_every_number_has_bounds(group: str) -> None:
    """A value out of all reason is refused before it trains."""
    unbounded = {
        f"{plugin}.{name}"
        for plugin, model, _ in variants(group)
        for name, option in _numbers(model.model_json_schema())
        if not ({"minimum", "exclusiveMinimum"} & option.keys() and {"maximum", "exclusiveMaximum"} & option.keys())
    }
    assert not unbounded


@pytest.mark.parametrize(
    "settings", [{"learning_rate": 1.0}, {"reward_scale": 1e30}, {"reward_scale": 1e-30}, {"torque_penalty": 1e9}]
)
def test_nonsense_is_refused_with_the_field(settings: dict[str, float]) -> None:
    (name,) = settings
    with pytest.raises(ValidationError, match=name):
        spec_of(**settings)


def test_errors_are_short_whatever_the_input_contains() -> None:
    with pytest.raises(ValidationError) as caught:
        TrainingSpec.model_validate({"k" * 60_000: 1, **{f"unknown{number}": 1 for number in range(500)}})
    words = validation_words(caught.value.errors())
    assert len(words) < 20_000
    assert re.search(r"and \d+ more$", words)
