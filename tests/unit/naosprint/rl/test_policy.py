"""Acting with NumPy only."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from naospec import TrainingSpec
from naosprint.rl.checkpoint import LEARNER, POLICY, read_file
from naosprint.rl.policy import NetworkPolicy, load_policy
from naosprint.rl.ppo import PPO
from naosprint.rl.rollout import TrainingEnvironment
from naosprint.rl.runner import train
from naosprint.tasks.environment import open_training_environment


def test_policy_agrees_with_torch(checkpoint: Path) -> None:
    """The mean action for raw observations is that of the trained network behind the normalizer."""
    policy, manifest = load_policy(checkpoint)
    inner, n_starts = open_training_environment(manifest.spec)
    environment = TrainingEnvironment.from_spec(manifest.spec, inner, n_starts)
    learner = PPO(manifest.spec, environment)
    learner.begin()
    arrays = read_file(checkpoint, manifest, POLICY)
    learner.load_policy_state(arrays)
    raw = np.concatenate([inner.step(np.random.default_rng(i).uniform(-1, 1, (8, 20))) for i in range(20)])
    seen = torch.from_numpy(learner.normalizer.observations(raw))
    with torch.no_grad():
        mean = learner.policy.get_distribution(seen).mode().numpy()
    np.testing.assert_allclose(policy.act(raw), np.clip(mean, -1, 1), atol=2e-6)
    latest = read_file(checkpoint, manifest, LEARNER)["latest.action_net.weight"]
    assert not np.array_equal(latest, arrays["action_net.weight"]), "the policy is the average of the weights"
    inner.close()


def test_draws_have_the_policys_spread(checkpoint: Path) -> None:
    """With a generator, actions vary by exp(log_std) around the mean."""
    policy, _ = load_policy(checkpoint)
    raw = np.zeros((20_000, 89))
    drawn, mean = policy.act(raw, np.random.default_rng(0)), policy.act(raw)
    assert isinstance(policy, NetworkPolicy)
    assert policy.log_std is not None
    spread = np.exp(policy.log_std)
    inner = np.abs(mean[0]) < 0.2
    assert inner.any()
    # clipping at 1 is some 2.7 standard deviations away, so it hardly narrows the spread
    np.testing.assert_allclose((drawn - mean)[:, inner].std(axis=0), spread[inner], rtol=0.05)
    assert np.abs(drawn).max() <= 1.0


def test_unnormalized_policy_acts_on_raw_numbers(
    tmp_path: Path, make_spec: Callable[..., TrainingSpec], recorder: Any
) -> None:
    """Without normalization nothing is subtracted, scaled or clipped."""
    spec = make_spec(normalize_observations=False, total_steps=256)
    policy, _ = load_policy(train(spec, workdir=tmp_path, reporter=recorder).checkpoint)
    raw = np.full((1, 89), 1234.5)
    assert isinstance(policy, NetworkPolicy)
    assert np.array_equal(policy.standardize(raw), raw.astype(np.float32))


def test_checkpoints_name_inputs_and_outputs(checkpoint: Path, make_spec: Callable[..., TrainingSpec]) -> None:
    """As the environments do."""
    _, manifest = load_policy(checkpoint)
    environment, _ = open_training_environment(make_spec())
    assert manifest.observations == environment.observer.names
    assert manifest.actions == environment.actuation.names
    environment.close()
