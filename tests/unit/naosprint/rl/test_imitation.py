"""The part of PPO in which the policy imitates what the task demonstrates."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from naospec import TrainingSpec
from naosprint import train

from ..checkpoints import assert_same  # noqa: TID252 - a module of these tests

Make = Callable[..., TrainingSpec]

GETUP: dict[str, Any] = {"task": "getup", "robot": "t1", "action_range_rad": 3.2, "n_envs": 4, "n_steps": 32, "seed": 4}
ROLLOUT = 4 * 32


def test_the_policy_learns_the_demonstrations_and_then_by_itself(
    make_spec: Make, tmp_path: Path, recorder: Any
) -> None:
    """Each rollout has whole episodes, so that the losses of all are comparable."""
    whole = 4 * 128
    spec = make_spec(
        **GETUP | {"n_steps": 128, "episode_steps": 128},
        batch_size=32,
        hidden_sizes=[64, 64],
        n_epochs=2,
        imitation_steps=20 * whole - 1,
        total_steps=22 * whole,
    )
    train(spec, workdir=tmp_path, reporter=recorder)
    losses = [row["policy_loss"] for row in recorder.rows]
    assert losses[19] < 0.75 * losses[0]
    divergences = [row["approx_kl"] for row in recorder.rows]
    assert divergences[:20] == [0.0] * 20 and divergences[20] != 0.0


@pytest.mark.parametrize("stopped_at", [ROLLOUT, 2 * ROLLOUT, 3 * ROLLOUT])
def test_resuming_continues_bit_for_bit(make_spec: Make, tmp_path: Path, recorder: Any, stopped_at: int) -> None:
    """During imitation, at its end, and after it."""
    spec = make_spec(
        **GETUP,
        batch_size=32,
        hidden_sizes=[16],
        imitation_steps=2 * ROLLOUT,
        total_steps=4 * ROLLOUT,
        checkpoint_interval_steps=ROLLOUT,
    )
    whole = train(spec, workdir=tmp_path / "whole", reporter=recorder)
    resumed = train(
        spec,
        workdir=tmp_path / "resumed",
        reporter=recorder,
        resume=tmp_path / "whole" / f"step-{stopped_at:012d}",
    )
    assert_same(resumed.checkpoint, whole.checkpoint)


def test_a_task_that_demonstrates_nothing_is_named(make_spec: Make, tmp_path: Path, recorder: Any) -> None:
    with pytest.raises(ValueError, match=r"algorithm.imitation_steps: task sprint1 demonstrates nothing .*; use 0"):
        train(make_spec(imitation_steps=100), workdir=tmp_path, reporter=recorder)
