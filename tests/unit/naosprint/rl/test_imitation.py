"""The part of PPO in which the policy imitates what the task demonstrates."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naospec import TrainingSpec, plugins
from naosprint import train
from naosprint.rl.imitation import ImitatingPPO
from naosprint.rl.rollout import TrainingEnvironment
from naosprint.tasks.environment import open_training_environment
from pydantic import ValidationError

from ..checkpoints import assert_resumes  # noqa: TID252 - a module of these tests

Make = Callable[..., TrainingSpec]

GETUP: dict[str, Any] = {"task": "getup", "robot": "t1", "action_range_rad": 3.2, "n_envs": 4, "n_steps": 32, "seed": 4}
ROLLOUT = 4 * 32


def test_the_policy_learns_the_demonstrations_and_then_by_itself(
    make_spec: Make, tmp_path: Path, recorder: Any
) -> None:
    """Each rollout has whole episodes; the losses of those that are mostly led are comparable."""
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
    assert min(losses[1:6]) < 0.5 * losses[0]
    divergences = [row["approx_kl"] for row in recorder.rows]
    assert divergences[:20] == [0.0] * 20 and divergences[20] != 0.0
    rates = [row["learning_rate"] for row in recorder.rows[:20]]
    assert rates == sorted(rates, reverse=True) and rates[-1] < 0.1 * rates[0]


def test_demonstrations_lead_a_share_of_the_environments_that_goes_down_to_none(make_spec: Make) -> None:
    """Without noise, all four environments do what is demonstrated at first, and two of them at half the time."""
    spec = make_spec(
        **GETUP, batch_size=32, initial_log_std=-10.0, final_log_std=-10.0, imitation_steps=2 * ROLLOUT, total_steps=999
    )
    environment, n_starts = open_training_environment(spec)
    try:
        learner = ImitatingPPO(spec, TrainingEnvironment.from_spec(spec, environment, n_starts))
        learner.begin()
        for led in (4, 2):
            learner.collect()
            follows = np.isclose(learner.rollout.actions, learner.demonstrations, atol=1e-3).all(axis=(0, 2))
            assert follows.tolist() == [row < led for row in range(4)]
        learner.collect()
        assert not len(learner.demonstrations)
    finally:
        environment.close()


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
    assert_resumes(spec, stopped_at, tmp_path, recorder)


def test_a_task_that_demonstrates_nothing_is_named(
    make_spec: Make, tmp_path: Path, recorder: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ValidationError, match=r"100 needs demonstrations, which robot nao-0"):
        make_spec(imitation_steps=100)
    monkeypatch.setattr(plugins.load(plugins.TASKS, "sprint1"), "demonstrates", lambda robot: True)
    with pytest.raises(ValueError, match=r"algorithm.imitation_steps: task sprint1 demonstrates nothing .*; use 0"):
        train(make_spec(imitation_steps=100), workdir=tmp_path, reporter=recorder)
