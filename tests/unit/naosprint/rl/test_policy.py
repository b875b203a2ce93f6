"""Test acting with NumPy alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from naospec import TrainingSpec
from naosprint.environment import open_training_batch
from naosprint.learner import SprintPPO
from naosprint.policy import load_policy
from naosprint.training import _Session, train
from naosprint.vec_env import SprintVecEnv


def test_policy_agrees_with_torch(
    checkpoint: Path, tmp_path: Path, make_spec: Callable[..., TrainingSpec], recorder: Any
) -> None:
    """The mean action for raw observations is that of the trained network behind the normaliser."""
    policy, manifest = load_policy(checkpoint)
    batch, n_starts = open_training_batch(manifest.spec)
    env = SprintVecEnv.from_spec(manifest.spec, batch, n_starts)
    session = _Session(make_spec(), env, tmp_path, recorder)
    session.resume(checkpoint)
    session.ppo.load_policy_state(session.ppo.policy_state())  # act with the running mean, not with the latest weights
    raw = np.concatenate([batch.step(np.random.default_rng(i).uniform(-1, 1, (8, 20))) for i in range(20)])
    with torch.no_grad():
        seen = torch.from_numpy(env.normaliser.observations(raw))
        mean = session.ppo.policy.get_distribution(seen).mode().numpy()
    np.testing.assert_allclose(policy.act(raw), np.clip(mean, -1, 1), atol=2e-6)


def test_draws_have_the_policys_spread(checkpoint: Path) -> None:
    """With a generator, actions vary by exp(log_std) around the mean."""
    policy, _ = load_policy(checkpoint)
    raw = np.zeros((20_000, 89))
    drawn, mean = policy.act(raw, np.random.default_rng(0)), policy.act(raw)
    spread = np.exp(policy.log_std)
    inner = np.abs(mean[0]) < 0.2
    assert inner.any()
    # clipping at 1 is some 2.7 standard deviations away, so it hardly narrows the spread
    np.testing.assert_allclose((drawn - mean)[:, inner].std(axis=0), spread[inner], rtol=0.05)
    assert np.abs(drawn).max() <= 1.0


def test_unnormalised_policy_acts_on_raw_numbers(
    tmp_path: Path, make_spec: Callable[..., TrainingSpec], recorder: Any
) -> None:
    """Without normalisation nothing is subtracted, scaled or clipped."""
    spec = make_spec(normalise_observations=False, total_steps=256)
    policy, _ = load_policy(train(spec, workdir=tmp_path, reporter=recorder).checkpoint)
    raw = np.full((1, 89), 1234.5)
    assert np.array_equal(policy.standardise(raw), raw.astype(np.float32))


def test_learner_and_policy_need_the_same_names(checkpoint: Path, make_spec: Callable[..., TrainingSpec]) -> None:
    """What a checkpoint says of its inputs and outputs is what the environments say."""
    _, manifest = load_policy(checkpoint)
    batch, n_starts = open_training_batch(make_spec())
    learner = SprintPPO(make_spec(), SprintVecEnv.from_spec(make_spec(), batch, n_starts))
    assert manifest.observations == batch.observer.names
    assert manifest.actions == batch.actuation.names
    assert learner.observation_space.shape == (len(manifest.observations),)
    assert learner.action_space.shape == (len(manifest.actions),)
