"""Trainings with several stages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naospec import TrainingSpec
from naosprint import CheckpointError, train
from naosprint.rl.checkpoint import POLICY, read_arrays, read_manifest
from naosprint.rl.plan import plan
from naosprint.rl.reporter import NullReporter

from ..checkpoints import assert_same  # noqa: TID252 - a module of these tests

Make = Callable[..., TrainingSpec]

FIRST: dict[str, Any] = {"learning_rate": 1e-3}
SECOND: dict[str, Any] = {"learning_rate": 2e-4, "n_steps": 16, "final_log_std": -2.5}
DRIFT = 0.25


def two_stages(make_spec: Make) -> TrainingSpec:
    """Return a training whose second stage has another learning rate, rollout, seed and reward."""
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


def candidates(make_spec: Make) -> TrainingSpec:
    """Return a training whose second stage trains three candidates."""
    stages = [
        {"steps": 512, "algorithm": FIRST},
        {"steps": 1024, "seed": 9, "candidates": 3, "algorithm": FIRST},
        {"steps": 256, "seed": 2},
    ]
    return make_spec(stages=stages, seed=4, checkpoint_interval_steps=256)


@pytest.fixture
def alone(make_spec: Make, tmp_path: Path) -> dict[str, Path]:
    """Return the policies of the candidates, each trained by itself from the first stage's policy."""
    folder = tmp_path / "alone"

    def trained(name: str, seed: int, start: Path | None) -> Path:
        spec = make_spec(seed=seed, total_steps=512 if start is None else 1024, **FIRST)
        return train(spec, workdir=folder / name, reporter=NullReporter(), initial_policy=start).checkpoint

    first = trained("first", 4, None)
    return {"first": first, **{str(seed): trained(str(seed), seed, first) for seed in (9, 1009, 2009)}}


def test_the_best_candidate_continues(make_spec: Make, tmp_path: Path, recorder: Any, alone: dict[str, Path]) -> None:
    """Each candidate is a training of its own from the same policy; the next stage starts from the best one's."""
    spec = candidates(make_spec)
    assert (spec.total_steps, spec.planned_steps) == (3840, 3840)
    segments = plan(spec)
    assert [(each.stage, each.candidate, each.end) for each in segments] == [
        (0, 0, 512),
        (1, 0, 1536),
        (1, 1, 2560),
        (1, 2, 3584),
        (2, 0, 3840),
    ]
    assert [each.title for each in segments[1:3]] == [f", stage 2 of 3, candidate {k} of 3" for k in (1, 2)]
    result = train(spec, workdir=tmp_path / "whole", reporter=recorder)
    assert result.steps == 3840
    rows = [row for row in recorder.rows if row["stage"] == 2]
    assert [row["candidate"] for row in rows] == [1] * 4 + [2] * 4 + [3] * 4
    assert not any("candidate" in row for row in recorder.rows if row["stage"] != 2)
    rewards = [row["reward"] / row["episode_length"] for row in rows[3::4]]
    assert len(set(rewards)) == 3
    best = ("9", "1009", "2009")[int(np.argmax(rewards))]
    for steps, seed in ((1536, "9"), (2560, "1009"), (3584, best)):
        assert_same_policy(tmp_path / "whole" / f"step-{steps:012d}", alone[seed])
    last = train(
        make_spec(seed=2, total_steps=256), workdir=tmp_path / "last", reporter=recorder, initial_policy=alone[best]
    )
    assert_same(result.checkpoint, last.checkpoint)
    assert any(message == f"candidate {np.argmax(rewards) + 1} is the best of 3" for _, message in recorder.lines)


@pytest.mark.parametrize("stopped_at", [512, 1024, 1536, 2048, 2560, 3584])
def test_candidates_resume_from_one_checkpoint(make_spec: Make, tmp_path: Path, recorder: Any, stopped_at: int) -> None:
    """It is enough, wherever the training stopped: it contains their start and the best of them."""
    spec = candidates(make_spec)
    whole = train(spec, workdir=tmp_path / "whole", reporter=recorder)
    moved = tmp_path / "moved" / "checkpoint"
    moved.parent.mkdir()
    (tmp_path / "whole" / f"step-{stopped_at:012d}").rename(moved)
    resumed = train(spec, workdir=tmp_path / "resumed", reporter=recorder, resume=moved)
    assert (resumed.status, resumed.steps) == ("finished", 3840)
    assert_same(resumed.checkpoint, whole.checkpoint)
    assert read_manifest(resumed.checkpoint).episodes == read_manifest(whole.checkpoint).episodes


def test_the_last_stage_can_have_candidates(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    """The training's policy is the best of them, and a finished training stays finished."""
    spec = make_spec(stages=[{"steps": 1024, "candidates": 2}], seed=4, checkpoint_interval_steps=512)
    result = train(spec, workdir=tmp_path / "a", reporter=recorder)
    rewards = [row["reward"] / row["episode_length"] for row in recorder.rows[3::4]]
    seed = 4 + 1000 * int(np.argmax(rewards))
    best = train(make_spec(seed=seed, total_steps=1024), workdir=tmp_path / "b", reporter=recorder)
    assert_same_policy(result.checkpoint, best.checkpoint)
    again = train(spec, workdir=tmp_path / "again", reporter=recorder, resume=result.checkpoint)
    assert (again.status, again.steps) == ("finished", 2048)
    assert_same_policy(again.checkpoint, best.checkpoint)


def assert_same_policy(ours: Path, theirs: Path) -> None:
    one, other = (read_arrays(folder / POLICY) for folder in (ours, theirs))
    assert one.keys() == other.keys()
    for name in one:
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)
