"""A policy that learns from a teacher, which observes more."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naospec import TrainingSpec
from naosprint.rl.distillation import DistillingPPO
from naosprint.rl.rollout import TrainingEnvironment
from naosprint.tasks.environment import open_environment, open_training_environment
from naosprint.tasks.frozen import FrozenPolicy
from pydantic import ValidationError

from ..checkpoints import assert_resumes  # noqa: TID252 - a module of these tests

Make = Callable[..., TrainingSpec]

T1: dict[str, Any] = {"task": "velocity", "robot": "t1", "engine": "fast"}
NAO: dict[str, Any] = {"task": "sprint1", "robot": "nao-0"}
LEARNING: dict[str, Any] = {
    "onboard_sensing": True,
    "n_envs": 4,
    "n_steps": 32,
    "batch_size": 32,
    "hidden_sizes": [16],
    "critic_observations": True,
    "seed": 4,
}
STUDENT = T1 | LEARNING | {"teacher": "t1-run-steady"}
ROLLOUT = 4 * 32


@pytest.mark.parametrize(
    ("robot", "teacher", "seeing", "unseen"),
    [
        (T1, "t1-run-steady", {"history_steps": 2}, {"velocity_x", "height", "line_offset"}),
        (NAO, "sprint-hour", {"ground_velocity": True}, {"forward_velocity", "told_yaw", "told_height"}),
    ],
    ids=["t1", "nao"],
)
def test_the_teacher_acts_as_where_it_was_trained(
    make_spec: Make, robot: dict[str, Any], teacher: str, seeing: dict[str, Any], unseen: set[str]
) -> None:
    """Episodes that it leads are those of an environment in which it sees everything itself, step by step."""
    long = 100 * ROLLOUT
    quiet: dict[str, Any] = {"initial_log_std": -10.0, "final_log_std": -10.0}
    spec = make_spec(
        **robot,
        **LEARNING,
        **quiet,
        teacher=teacher,
        history_steps=1,
        start_noise_deg=0.0,
        imitation_steps=long,
        total_steps=long,
    )
    environment, n_starts = open_training_environment(spec)
    frozen = FrozenPolicy(teacher)
    alone = open_environment(make_spec(**robot, **seeing, seed=4, start_noise_deg=0.0), 4, threads=1)
    try:
        learner = DistillingPPO(spec, TrainingEnvironment.from_spec(spec, environment, n_starts))
        assert not unseen & set(environment.observer.names)
        assert unseen <= set(environment.observer.critic_names)
        learner.begin()
        alone.load_starts(alone.task.starts(n_starts, spec.seed, 0.0))
        alone.restart(np.arange(4), np.zeros(4, dtype=np.int64))
        learner.collect()
        compared = 0
        for step in range(spec.algorithm.n_steps):
            actions = frozen.act(alone.observer, slice(0, 4))
            begun = learner.rollout.episode_starts[: step + 1].sum(axis=0) == 1.0
            assert np.allclose(learner.demonstrations[step, begun], actions[begun], atol=2e-3), step
            compared += begun.sum()
            alone.step(learner.rollout.actions[step])
        assert compared > 2 * spec.algorithm.n_steps, "in first episodes"
    finally:
        environment.close()
        alone.close()


@pytest.mark.parametrize("stopped_at", [ROLLOUT, 2 * ROLLOUT, 3 * ROLLOUT])
def test_resuming_continues_bit_for_bit(make_spec: Make, tmp_path: Path, recorder: Any, stopped_at: int) -> None:
    """What the teacher remembers is part of checkpoints."""
    spec = make_spec(**STUDENT, imitation_steps=2 * ROLLOUT, total_steps=4 * ROLLOUT, checkpoint_interval_steps=ROLLOUT)
    assert_resumes(spec, stopped_at, tmp_path, recorder)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"imitation_steps": 0}, r"teacher: needs imitation_steps above 0"),
        ({"critic_observations": False}, r"teacher: needs .* critic_observations=true"),
        (
            {"teacher": "t1-getup"},
            r"algorithm.teacher: 't1-getup' is no bundled policy of robot t1 for task velocity; use",
        ),
        ({"teacher": "k1-run"}, r"algorithm.teacher: 'k1-run' is no bundled policy of robot t1"),
        ({"action_range_rad": 1.0}, r"algorithm.teacher: t1-run-steady has other ranges of actions than robot t1"),
    ],
    ids=["without imitation", "blind critic", "another task", "another robot", "another range"],
)
def test_a_teacher_that_cannot_teach_is_named_before_the_job_is_accepted(
    make_spec: Make, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValidationError, match=message):
        make_spec(**STUDENT | {"imitation_steps": ROLLOUT, "total_steps": ROLLOUT} | settings)
