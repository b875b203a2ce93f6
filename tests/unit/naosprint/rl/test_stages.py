"""Trainings with several stages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from naospec import TrainingSpec
from naosprint import CheckpointError, train
from naosprint.rl.checkpoint import read_manifest

from ..checkpoints import assert_same  # noqa: TID252 - a module of these tests

Make = Callable[..., TrainingSpec]

FIRST: dict[str, Any] = {"learning_rate": 1e-3}
SECOND: dict[str, Any] = {"learning_rate": 2e-4, "n_steps": 16, "final_log_std": -2.5, "hidden_sizes": [24, 16]}
DRIFT = 0.25


def two_stages(make_spec: Make) -> TrainingSpec:
    """Return a training whose second stage has another learning rate, rollout, width, seed and reward."""
    stages = [
        {"steps": 512, "algorithm": FIRST},
        {"steps": 512, "seed": 9, "algorithm": SECOND, "task": {"drift_penalty": DRIFT}},
    ]
    return make_spec(stages=stages, seed=4, checkpoint_interval_steps=256)


def test_stages_are_a_chain_of_trainings(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """The final checkpoint is that of two trainings of which the second starts from the first's policy, bit for bit."""
    spec = two_stages(make_spec)
    whole = train(spec, workdir=tmp_path / "whole", reporter=recorder)
    first = train(make_spec(seed=4, **FIRST), workdir=tmp_path / "1", reporter=recorder).checkpoint
    second = train(
        make_spec(seed=9, drift_penalty=DRIFT, **SECOND),
        workdir=tmp_path / "2",
        reporter=recorder,
        initial_policy=first,
    )
    assert (whole.steps, second.steps) == (1024, 512)
    assert_same(tmp_path / "whole" / "step-000000000512", first)
    assert_same(whole.checkpoint, second.checkpoint)
    manifest = read_manifest(whole.checkpoint)
    assert (manifest.stage, manifest.steps, manifest.updates, manifest.spec) == (1, 1024, 2 + 4, spec)


def test_metrics_continue_over_the_border(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """One curve: steps, episodes and time continue, and rows contain their stage."""
    train(two_stages(make_spec), workdir=tmp_path, reporter=recorder)
    rows = recorder.rows
    assert [row["step"] for row in rows] == [256, 512, 640, 768, 896, 1024]
    assert [row["stage"] for row in rows] == [1, 1, 2, 2, 2, 2]
    for name in ("episodes", "time_s"):
        values = [row[name] for row in rows]
        assert values == sorted(values), name
    assert rows[-1]["learning_rate"] < rows[0]["learning_rate"]
    assert [step for _, step in recorder.checkpoints] == [0, 256, 512, 768, 1024]


def test_a_stage_can_train_another_task(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """It starts from the policy before it: equal observations are found by name."""
    few: dict[str, Any] = {"task": "velocity", "robot": "t1", "n_envs": 2, "seed": 4}
    spec = make_spec(**few, stages=[{"steps": 64, "task": {"name": "sprint1"}}, {"steps": 64}])
    whole = train(spec, workdir=tmp_path / "whole", reporter=recorder)
    first = tmp_path / "whole" / "step-000000000064"
    second = train(
        make_spec(**few, total_steps=64), workdir=tmp_path / "2", reporter=recorder, initial_policy=first
    ).checkpoint
    assert_same(whole.checkpoint, second)
    tasks = [read_manifest(checkpoint).stage_spec.task.name for checkpoint in (first, whole.checkpoint)]
    assert tasks == ["sprint1", "velocity"]


@pytest.mark.parametrize("stopped_at", [256, 512, 640, 768])
def test_resuming_anywhere_equals_the_uninterrupted_training(
    make_spec: Make, tmp_path: Path, recorder: Any, stopped_at: int
) -> None:
    """Stopped in the first stage, at the border, or in the second."""
    spec = two_stages(make_spec)
    whole = train(spec, workdir=tmp_path / "whole", reporter=recorder)
    recorder.rows.clear()
    stopped = train(
        spec,
        workdir=tmp_path / "stopped",
        reporter=recorder,
        stop=lambda: bool(recorder.rows) and recorder.rows[-1]["step"] >= stopped_at,
    )
    assert (stopped.status, stopped.steps) == ("stopped", stopped_at)
    resumed = train(spec, workdir=tmp_path / "resumed", reporter=recorder, resume=stopped.checkpoint)
    assert (resumed.status, resumed.steps) == ("finished", 1024)
    assert_same(resumed.checkpoint, whole.checkpoint)
    ours, theirs = read_manifest(resumed.checkpoint), read_manifest(whole.checkpoint)
    assert (ours.updates, ours.episodes, ours.stage) == (theirs.updates, theirs.episodes, theirs.stage)


def test_resuming_from_the_first_stages_last_checkpoint(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """A worker that dies between the stages leaves the last checkpoint of the first."""
    spec = two_stages(make_spec)
    whole = train(spec, workdir=tmp_path / "whole", reporter=recorder)
    border = tmp_path / "whole" / "step-000000000512"
    assert read_manifest(border).stage == 0
    resumed = train(spec, workdir=tmp_path / "resumed", reporter=recorder, resume=border)
    assert_same(resumed.checkpoint, whole.checkpoint)
    assert read_manifest(resumed.checkpoint).episodes == read_manifest(whole.checkpoint).episodes


def test_resuming_a_finished_training_is_finished(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    spec = two_stages(make_spec)
    whole = train(spec, workdir=tmp_path / "whole", reporter=recorder)
    again = train(spec, workdir=tmp_path / "again", reporter=recorder, resume=whole.checkpoint)
    assert (again.status, again.steps) == ("finished", 1024)
    assert_same(again.checkpoint, whole.checkpoint)


def test_other_stages_are_another_training(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """A checkpoint cannot be resumed with other stages than it was trained with."""
    spec = two_stages(make_spec)
    checkpoint = train(spec, workdir=tmp_path / "a", reporter=recorder, stop=lambda: len(recorder.rows) > 0).checkpoint
    other = make_spec(stages=[{"steps": 1024, "algorithm": FIRST}], seed=4)
    with pytest.raises(CheckpointError, match="stages: the checkpoint was trained with"):
        train(other, workdir=tmp_path / "b", reporter=recorder, resume=checkpoint)


def test_stopping_right_after_the_border_saves_nothing_twice(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """The checkpoint between the stages does not change, and is reported once."""
    spec = two_stages(make_spec)

    def stop() -> bool:
        return any("stage 2 of 2" in message for _, message in recorder.lines)

    stopped = train(spec, workdir=tmp_path, reporter=recorder, stop=stop)
    assert (stopped.status, stopped.steps) == ("stopped", 512)
    assert [step for _, step in recorder.checkpoints] == [0, 256, 512]
    assert read_manifest(stopped.checkpoint).stage == 0
    again = train(spec, workdir=tmp_path / "again", reporter=recorder, resume=stopped.checkpoint)
    whole = train(spec, workdir=tmp_path / "whole", reporter=recorder)
    assert_same(again.checkpoint, whole.checkpoint)
