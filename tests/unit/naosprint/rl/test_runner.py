"""Trainings from end to end on small specifications."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naosim import robots
from naosim.mujoco.embedded import MujocoSimulator
from naosim.robots.actuation import Actuation
from naospec import TrainingSpec
from naosprint import CheckpointError, train
from naosprint.rl.checkpoint import (
    ENVIRONMENT,
    LEARNER,
    POLICY,
    TrainingState,
    read_arrays,
    read_file,
    read_manifest,
    save_checkpoint,
)
from naosprint.rl.columns import ENGINES, columns
from naosprint.rl.policy import load_policy
from naosprint.rl.settings import PPOSettings
from naosprint.tasks.measurements import StoredNumbers
from naosprint.tasks.sprint import Sprint1
from naosprint.terms import Store, source

from ..checkpoints import assert_same  # noqa: TID252 - a module of these tests

Make = Callable[..., TrainingSpec]


def test_training_takes_its_steps_and_reports(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """One row per update with all documented metrics, checkpoints at the start, the interval and the end."""
    spec = make_spec(total_steps=2000, n_steps=64, checkpoint_interval_steps=1000)
    result = train(spec, workdir=tmp_path, reporter=recorder)
    assert (result.status, result.steps) == ("finished", 2048)
    assert [row["step"] for row in recorder.rows] == [512, 1024, 1536, 2048]
    assert [step for _, step in recorder.checkpoints] == [0, 1024, 2048]
    assert result.checkpoint == recorder.checkpoints[-1][0]
    assert read_manifest(result.checkpoint).steps == 2048
    documented = {metric.name for metric in columns(spec)}
    # a NAO has one embedded engine and no servers, there are no stages, and a worker measures the processes
    elsewhere = {
        "server_failures",
        "stage",
        "cpus",
        "memory_mb",
        "left_to_mujoco",
        "disturbance_strength",
        "task_growth",
    }
    assert recorder.rows[-1].keys() == documented - elsewhere - {metric.name for metric in ENGINES}
    assert all(0 < row["simulator_s"] < row["collect_s"] for row in recorder.rows)
    for row in recorder.rows:
        assert all(isinstance(value, float) and math.isfinite(value) for value in row.values())


def test_checkpoints_keep_their_distance_in_seconds(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """An interval of one update does not fill a disk; the end is saved in any case."""
    spec = make_spec(total_steps=2000, n_steps=64, checkpoint_interval_steps=1)
    train(spec, workdir=tmp_path, reporter=recorder, min_checkpoint_s=3600)
    assert [step for _, step in recorder.checkpoints] == [0, 2048]


def test_metrics_without_a_value_are_left_out(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """There is no distance before the first episode has ended."""
    train(make_spec(n_envs=2, n_steps=4, batch_size=8, total_steps=8), workdir=tmp_path, reporter=recorder)
    assert "distance_m" not in recorder.rows[0]
    assert recorder.rows[0]["episodes"] == 0.0


def test_same_seed_gives_the_same_weights(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """Another seed gives other results."""
    runs = {
        name: train(make_spec(seed=seed), workdir=tmp_path / name, reporter=recorder).checkpoint
        for name, seed in (("a", 3), ("b", 3), ("c", 4))
    }
    assert_same(runs["a"], runs["b"])
    assert not np.array_equal(
        read_arrays(runs["a"] / POLICY)["action_net.weight"], read_arrays(runs["c"] / POLICY)["action_net.weight"]
    )


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_resuming_continues_bit_for_bit(make_spec: Make, tmp_path: Path, recorder: Any, preset: str) -> None:
    """Training 2k steps, and being stopped after 1k and then resumed, end in the same state in every array."""
    fast = preset == "fast"
    settings = {
        "preset": preset,
        "n_steps": 128,
        "final_log_std": -2.0 if fast else None,
        "critic_observations": fast,
        "history_steps": int(fast),
        "extra_delay_max": 2 if fast else 0,
    }
    whole = train(make_spec(total_steps=2048, **settings), workdir=tmp_path / "whole", reporter=recorder)
    updates = len(recorder.rows)
    half = train(
        make_spec(total_steps=2048, **settings),
        workdir=tmp_path / "half",
        reporter=recorder,
        stop=lambda: len(recorder.rows) > updates,
    )
    assert (half.status, half.steps) == ("stopped", 1024)
    rest = train(
        make_spec(total_steps=2048, **settings),
        workdir=tmp_path / "rest",
        reporter=recorder,
        resume=half.checkpoint,
    )
    assert rest.steps == whole.steps == 2048
    assert_same(rest.checkpoint, whole.checkpoint)
    policy, manifest = load_policy(rest.checkpoint)
    assert policy.act(np.zeros((1, len(manifest.observations)))).shape == (1, len(manifest.actions))


def test_settings_that_are_said_to_have_no_effect_have_none(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    off = {"target_kl": None, "learning_rate_schedule": "constant", "normalize_observations": False}
    off |= {"final_gamma": None, "final_log_std": None, "log_std_steps": None}
    idle = {"target_kl_final": 1e-5, "gamma_steps": 1, "log_std_steps": 1, "observation_clip": 0.01}
    specs = {"without": make_spec(**off), "with": make_spec(**off | idle)}
    assert {sentence.split(":")[0] for sentence in specs["with"].without_effect()} == {f"algorithm.{n}" for n in idle}
    without, given = (train(spec, workdir=tmp_path / n, reporter=recorder).checkpoint for n, spec in specs.items())
    assert_same(without, given)


def test_threads_change_nothing_in_the_simulator(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """The same training with one and with two simulator threads."""
    one = train(make_spec(), workdir=tmp_path / "1", reporter=recorder)
    two = train(make_spec(simulator_threads=2), workdir=tmp_path / "2", reporter=recorder)
    assert_same(one.checkpoint, two.checkpoint)


def test_stopping_in_a_rollout_saves_the_last_update(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """The stopped training, resumed, ends where the uninterrupted one does."""
    spec = make_spec(total_steps=1024)
    calls = 0

    def stop() -> bool:
        nonlocal calls
        calls += 1
        return calls > 2 * spec.algorithm.n_steps + 7

    stopped = train(spec, workdir=tmp_path / "stopped", reporter=recorder, stop=stop)
    assert (stopped.status, stopped.steps) == ("stopped", 512)
    assert recorder.checkpoints[-1] == (stopped.checkpoint, 512)
    resumed = train(spec, workdir=tmp_path / "resumed", reporter=recorder, resume=stopped.checkpoint)
    whole = train(spec, workdir=tmp_path / "whole", reporter=recorder)
    assert_same(resumed.checkpoint, whole.checkpoint)


def test_stopping_at_once_leaves_the_first_checkpoint(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """There is always a checkpoint to resume from."""
    result = train(make_spec(), workdir=tmp_path, reporter=recorder, stop=lambda: True)
    assert (result.status, result.steps) == ("stopped", 0)
    assert read_manifest(result.checkpoint).steps == 0
    assert recorder.rows == []


def test_resuming_a_finished_training_is_finished(
    make_spec: Make, checkpoint: Path, tmp_path: Path, recorder: Any
) -> None:
    """Nothing is left to do, and the result contains the checkpoint."""
    result = train(make_spec(), workdir=tmp_path, reporter=recorder, resume=checkpoint)
    assert (result.status, result.steps) == ("finished", 512)
    assert_same(result.checkpoint, checkpoint)


@pytest.mark.parametrize(
    ("fields", "word"),
    [({"seed": 1}, "seed"), ({"clip_range": 0.3}, "algorithm.clip_range"), ({"task": "sprint2"}, "task.name")],
)
def test_checkpoint_of_another_specification_is_refused(
    make_spec: Make, checkpoint: Path, tmp_path: Path, recorder: Any, fields: dict[str, Any], word: str
) -> None:
    """The message names the field and both values."""
    with pytest.raises(CheckpointError, match=f"{word}: the checkpoint was trained with"):
        train(make_spec(**fields), workdir=tmp_path, reporter=recorder, resume=checkpoint)


def test_initial_policy_gives_weights_and_statistics(
    make_spec: Make, checkpoint: Path, tmp_path: Path, recorder: Any
) -> None:
    """A new training starts from another's policy, with its own seed, task and counters."""
    spec = make_spec(seed=8, task="sprint2", total_steps=256)
    started = train(spec, workdir=tmp_path, reporter=recorder, initial_policy=checkpoint, stop=lambda: True).checkpoint
    theirs, ours = read_arrays(checkpoint / POLICY), read_arrays(started / POLICY)
    for name in theirs:
        if not name.startswith("observation_"):
            assert np.array_equal(ours[name], theirs[name]), name
    assert ours["observation_count"][0] == theirs["observation_count"][0] + spec.algorithm.n_envs
    assert read_manifest(started).steps == 0


@pytest.mark.parametrize(("final", "spread"), [(None, -1.6), (-3.0, -0.5)])
def test_initial_log_std_applies_to_a_start_from_a_policy_as_described(
    make_spec: Make, checkpoint: Path, tmp_path: Path, recorder: Any, final: float | None, spread: float
) -> None:
    spec = make_spec(initial_log_std=-0.5, final_log_std=final, total_steps=256)
    train(spec, workdir=tmp_path, reporter=recorder, initial_policy=checkpoint)
    assert math.log(recorder.rows[0]["action_std"]) == pytest.approx(spread, abs=0.05)
    assert "unless final_log_std is set" in (PPOSettings.model_fields["initial_log_std"].description or "")


def test_initial_policy_of_another_shape_is_refused(
    make_spec: Make, checkpoint: Path, tmp_path: Path, recorder: Any
) -> None:
    """The message names the setting to change."""
    with pytest.raises(CheckpointError, match=r"this training has \[8, 8\]; set algorithm.hidden_sizes to \["):
        train(make_spec(hidden_sizes=(8, 8)), workdir=tmp_path, reporter=recorder, initial_policy=checkpoint)


def test_a_policy_of_another_robot_is_no_start(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    first = train(make_spec(), workdir=tmp_path / "nao", reporter=recorder).checkpoint
    with pytest.raises(CheckpointError, match="is for robot nao-0, this training is for t1; use a robot of family nao"):
        train(make_spec(robot="t1"), workdir=tmp_path / "t1", reporter=recorder, initial_policy=first)


def test_a_symmetric_policy_starts_from_one_and_may_stop_being_one(
    make_spec: Make, tmp_path: Path, recorder: Any
) -> None:
    """From another one it would act unlike the network that is differentiated, and learn nothing."""

    def start(symmetric: bool, **settings: Any) -> Path:
        spec = make_spec(symmetric_policy=symmetric, total_steps=256)
        return train(spec, workdir=tmp_path / str(len(settings)), reporter=recorder, **settings).checkpoint

    both, one = start(True), start(False)
    start(False, initial_policy=both)
    with pytest.raises(
        CheckpointError, match="policy has symmetric_policy False, this training has True; set algorithm"
    ):
        start(True, initial_policy=one)
    with pytest.raises(CheckpointError, match="policy has normalize_observations True, this training has False"):
        train(make_spec(normalize_observations=False), workdir=tmp_path, reporter=recorder, initial_policy=both)


def test_a_robot_with_toes_starts_from_the_policy_of_one_without(
    make_spec: Make, checkpoint: Path, tmp_path: Path, recorder: Any
) -> None:
    """Its other joints move as with the old policy, its toes stay straight, and it learns."""
    spec = make_spec(robot="nao-4", total_steps=256)
    began = train(spec, workdir=tmp_path, reporter=recorder, initial_policy=checkpoint, stop=lambda: True).checkpoint
    (theirs, before), (ours, after) = load_policy(checkpoint), load_policy(began)
    new = sorted(set(after.observations) - set(before.observations))
    assert new == ["llj7", "llj7_rate", "rlj7", "rlj7_rate"]
    seen = np.random.default_rng(0).normal(size=(5, len(after.observations)))
    known = seen[:, [after.observations.index(name) for name in before.observations]]
    moved = [after.actions.index(name) for name in before.actions]
    # the new robot's first observations are part of its statistics already
    np.testing.assert_allclose(ours.act(seen)[:, moved], theirs.act(known), atol=0.02)
    toes = Actuation(robots.get("nao-4")).targets(ours.act(seen))[:, [16, 23]]
    np.testing.assert_allclose(toes, 0.0, atol=1e-6)
    finished = train(spec, workdir=tmp_path / "on", reporter=recorder, initial_policy=checkpoint)
    assert finished.status == "finished"


def test_resume_and_initial_policy_exclude_each_other(
    make_spec: Make, checkpoint: Path, tmp_path: Path, recorder: Any
) -> None:
    """The two options exclude each other."""
    with pytest.raises(ValueError, match="exclude each other"):
        train(make_spec(), workdir=tmp_path, reporter=recorder, resume=checkpoint, initial_policy=checkpoint)


@pytest.mark.parametrize("robot_type", range(5))
def test_every_robot_type_trains(make_spec: Make, tmp_path: Path, recorder: Any, robot_type: int) -> None:
    """The toes of type 4 included."""
    result = train(make_spec(robot=f"nao-{robot_type}", total_steps=256), workdir=tmp_path, reporter=recorder)
    manifest = read_manifest(result.checkpoint)
    assert len(manifest.actions) == (22 if robot_type == 4 else 20)


def test_a_short_training_learns(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """In a few thousand steps the reward per step grows: training improves the policy."""
    spec = make_spec(
        n_envs=32, n_steps=64, batch_size=512, n_epochs=5, total_steps=60_000, learning_rate=1e-3, hidden_sizes=(64, 64)
    )
    train(spec, workdir=tmp_path, reporter=recorder)
    speeds = [row["speed_mps"] for row in recorder.rows]
    assert np.mean(speeds[-3:]) > np.mean(speeds[:3]) + 0.15


@pytest.mark.parametrize(
    ("settings", "jump"),
    [
        ({"learning_rate_schedule": "linear", "learning_rate": 1e-3}, "learning rate from 0 to 0.0005"),
        ({"learning_rate_schedule": "constant", "target_kl": 0.02, "target_kl_final": 0.01}, "target KL from 0.01 to"),
        ({"learning_rate_schedule": "constant"}, None),
    ],
    ids=["learning rate", "target KL", "no schedule"],
)
def test_a_schedule_that_jumps_when_a_training_is_extended_is_named(
    settings: dict[str, Any],
    jump: str | None,
    tmp_path: Path,
    make_spec: Callable[..., TrainingSpec],
    recorder: Any,
) -> None:
    short, long = (make_spec(total_steps=steps, **settings) for steps in (512, 1024))
    finished = train(short, workdir=tmp_path, reporter=recorder)
    assert train(long, workdir=tmp_path, reporter=recorder, resume=finished.checkpoint).steps == 1024
    warnings = [text for level, text in recorder.lines if level == "warning" and "total_steps" in text]
    if jump is None:
        assert warnings == []
    else:
        (text,) = warnings
        assert "total_steps is 1,024 instead of 512, which schedules follow at once" in text
        assert jump in text


def test_a_snapshot_by_another_version_of_the_simulator_begins_new_episodes(
    make_spec: Make, tmp_path: Path, recorder: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weights, optimizer and steps continue; the same snapshot by this version is damage."""
    spec = make_spec(checkpoint_interval_steps=256)
    end = train(spec, workdir=tmp_path, reporter=recorder).checkpoint
    manifest = read_manifest(end.parent / "step-000000000256")
    files = {name: read_file(end.parent / "step-000000000256", manifest, name) for name in manifest.files}
    files[ENVIRONMENT]["environment.simulator"] = files[ENVIRONMENT]["environment.simulator"][:, :-8].copy()
    fields = {name: getattr(manifest, name) for name in TrainingState.__slots__ if hasattr(manifest, name)}
    state = TrainingState(**fields, policy=files[POLICY], learner=files[LEARNER], environment=files[ENVIRONMENT])
    ours = save_checkpoint(tmp_path / "ours" / "step-000000000256", spec, state)
    with pytest.raises(CheckpointError, match=r"environment.simulator.*the specification needs"):
        train(spec, workdir=ours.parent, reporter=recorder, resume=ours)
    with monkeypatch.context() as patch:
        patch.setattr("naosprint.rl.checkpoint.installed_versions", lambda: {"naosim": "0.1.0"})
        theirs = save_checkpoint(tmp_path / "theirs" / "step-000000000256", spec, state)
    again = train(spec, workdir=theirs.parent, reporter=recorder, resume=theirs)
    assert (again.status, again.steps) == ("finished", 512)
    assert ("warning", "the checkpoint has no state for this simulator; new episodes begin") in recorder.lines


def test_without_snapshots_curricula_and_numbers_of_episodes_go_on(
    make_spec: Make, tmp_path: Path, recorder: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server cannot return to its state: new episodes begin, which are those after the checkpoint's."""
    monkeypatch.setattr(MujocoSimulator, "snapshot", lambda _: None)
    spec = make_spec(**{"task.name": "velocity", "robot.name": "t1"}, command_growth=0.001)
    end = train(spec, workdir=tmp_path / "first", reporter=recorder).checkpoint
    manifest = read_manifest(end)
    files = {name: read_file(end, manifest, name) for name in manifest.files}
    assert "environment.simulator" not in files[ENVIRONMENT]
    files[ENVIRONMENT]["environment.task.grown"][:] = 0.75
    files[ENVIRONMENT]["episode"] += 1000
    fields = {name: getattr(manifest, name) for name in TrainingState.__slots__ if hasattr(manifest, name)}
    state = TrainingState(**fields, policy=files[POLICY], learner=files[LEARNER], environment=files[ENVIRONMENT])
    grown = save_checkpoint(tmp_path / "second" / end.name, spec, state)
    recorder.rows.clear()
    more = make_spec(**{"task.name": "velocity", "robot.name": "t1"}, command_growth=0.001, total_steps=1024)
    last = train(more, workdir=grown.parent, reporter=recorder, resume=grown).checkpoint
    assert 0.7 < recorder.rows[0]["task_growth"] < 0.8
    assert recorder.rows[-1]["episodes"] >= manifest.episodes > 0
    found = read_file(last, read_manifest(last), ENVIRONMENT)
    assert (found["episode"] > files[ENVIRONMENT]["episode"]).all()
    assert (found["environment.steps"] < 64 + 1).all()


def test_a_checkpoint_from_before_stores_were_saved_is_resumed(
    make_spec: Make, tmp_path: Path, recorder: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It lacks what stores keep and the task does not name, which then continues as in new environments."""
    early = train(make_spec(), workdir=tmp_path / "early", reporter=recorder).checkpoint
    usual = Sprint1.__init__

    def with_a_count(task: Sprint1, *arguments: Any) -> None:
        usual(task, *arguments)
        count = source(np.zeros(task.n))
        task.measurements = (*task.measurements, StoredNumbers([Store(count, update=count + 1.0)]))

    monkeypatch.setattr(Sprint1, "__init__", with_a_count)
    late = train(make_spec(total_steps=1024), workdir=tmp_path / "late", reporter=recorder, resume=early).checkpoint
    name = "environment.stores.measurements.4.0"
    kept = read_file(late, read_manifest(late), ENVIRONMENT)[name].view(np.float64)
    assert (kept >= 64.0).all()
    further = train(
        make_spec(total_steps=1536), workdir=tmp_path / "further", reporter=recorder, resume=late
    ).checkpoint
    np.testing.assert_array_equal(
        read_file(further, read_manifest(further), ENVIRONMENT)[name].view(np.float64), kept + 64.0
    )
