"""Test that the lean PPO is stable-baselines3's PPO."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from naospec import TrainingSpec
from naosprint.environment import open_training_batch
from naosprint.learner import SprintPPO, TrainingDivergedError
from naosprint.vec_env import SprintVecEnv
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger

Open = Callable[..., SprintPPO]


@pytest.fixture
def open_learner(make_spec: Callable[..., TrainingSpec]) -> Iterator[Open]:
    """Return the maker of learners on small environments."""
    opened = []

    def make(**fields: object) -> SprintPPO:
        spec = make_spec(**fields)
        batch, n_starts = open_training_batch(spec)
        opened.append(batch)
        learner = SprintPPO(spec, SprintVecEnv.from_spec(spec, batch, n_starts))
        learner.begin()
        return learner

    yield make
    for batch in opened:
        batch.close()


def collect(learner: SprintPPO) -> None:
    """Collect one rollout."""
    assert learner.env is not None
    assert learner.collect_rollouts(learner.env, None, learner.rollout_buffer, learner.n_steps)


def test_rollout_holds_the_policys_own_values_and_densities(open_learner: Open) -> None:
    """Values and log-probabilities are those that stable-baselines3's policy gives for the stored data."""
    learner = open_learner()
    collect(learner)
    buffer = learner.rollout_buffer
    size = buffer.buffer_size * buffer.n_envs
    with torch.no_grad():
        values, log_probs, _ = learner.policy.evaluate_actions(
            torch.from_numpy(buffer.observations.reshape(size, -1)), torch.from_numpy(buffer.actions.reshape(size, -1))
        )
    np.testing.assert_allclose(buffer.values.reshape(size), values.numpy()[:, 0], atol=1e-5)
    np.testing.assert_allclose(buffer.log_probs.reshape(size), log_probs.numpy(), atol=1e-4)


def test_actions_explore_with_the_policys_spread(open_learner: Open) -> None:
    """What is added to the mean action has the standard deviation exp(log_std)."""
    learner = open_learner(n_steps=128, initial_log_std=-0.7)
    collect(learner)
    buffer = learner.rollout_buffer
    with torch.no_grad():
        features = learner.policy.mlp_extractor.policy_net(torch.from_numpy(buffer.observations))
        noise = buffer.actions - learner.policy.action_net(features).numpy()
    assert noise.std() == pytest.approx(np.exp(-0.7), rel=0.03)
    assert abs(noise.mean()) < 0.02


def test_time_limit_bootstraps_the_value_of_what_was_cut_off(
    open_learner: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reward at a time limit includes the discounted value of the last observation; at an end it does not."""
    learner = open_learner(n_steps=16, normalise_rewards=False)
    env = learner._sprint_env
    batch = env.batch
    monkeypatch.setattr(batch, "task", replace(batch.task, max_steps=5))
    seen: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []
    advance = env.advance

    def watch(actions: np.ndarray) -> object:
        transition = advance(actions)
        seen.append((len(seen), transition.rewards.copy(), transition.cut_rows, transition.cut_observations))
        return transition

    monkeypatch.setattr(env, "advance", watch)
    collect(learner)
    cuts = 0
    for step, rewards, rows, observations in seen:
        expected = rewards.copy()
        if len(rows):
            with torch.no_grad():
                value = learner.policy.predict_values(torch.from_numpy(observations)).numpy()[:, 0]
            expected[rows] += 0.99 * value
            cuts += len(rows)
        np.testing.assert_allclose(learner.rollout_buffer.rewards[step], expected, atol=1e-5)
    assert cuts >= 16


@pytest.mark.parametrize("entropy", [0.0, 0.01])
def test_update_is_that_of_stable_baselines3(
    open_learner: Open, entropy: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the same rollout and minibatches, PPO.train and ours arrive at the same weights."""
    fields = {"entropy_coefficient": entropy, "n_epochs": 3, "target_kl": None, "learning_rate": 1e-3}
    ours, theirs = open_learner(**fields), open_learner(**fields)
    collect(ours)
    collect(theirs)
    size = ours.rollout_buffer.buffer_size * ours.rollout_buffer.n_envs
    orders = [torch.randperm(size, generator=torch.Generator().manual_seed(i)) for i in range(3)]
    ours_orders, theirs_orders = iter(orders), iter(orders)
    monkeypatch.setattr(torch, "randperm", lambda n, generator: next(ours_orders))
    ours.train()
    monkeypatch.undo()

    # stable-baselines3 flattens environment by environment, we step by step
    n_steps, n_envs = theirs.rollout_buffer.buffer_size, theirs.rollout_buffer.n_envs

    def permutation(n: int) -> np.ndarray:
        assert n == size
        flat = next(theirs_orders).numpy()
        order: np.ndarray = (flat % n_envs) * n_steps + flat // n_envs
        return order

    monkeypatch.setattr(np.random, "permutation", permutation)
    theirs.set_logger(Logger(folder=None, output_formats=[]))
    PPO.train(theirs)
    for (name, mine), (_, stock) in zip(ours.policy.named_parameters(), theirs.policy.named_parameters(), strict=True):
        torch.testing.assert_close(mine, stock, atol=2e-5, rtol=1e-3, msg=name)
    recorded = theirs.logger.name_to_value
    for name, value in ours.figures().items():
        assert value == pytest.approx(float(recorded[name]), rel=1e-2, abs=1e-4), name


def test_target_kl_ends_an_update_early(open_learner: Open) -> None:
    """A huge step is noticed and no further ones are taken."""
    learner = open_learner(target_kl=0.001, learning_rate=0.1, n_epochs=50)
    collect(learner)
    learner.train()
    assert learner._n_updates < 50


def test_rollout_advantages_are_standardised_once(open_learner: Open) -> None:
    """With advantages standardised over the rollout an update still learns, from other gradients."""
    weights = {}
    for kind in ("minibatch", "rollout", "none"):
        learner = open_learner(advantage_normalisation=kind)
        collect(learner)
        learner.train()
        weights[kind] = learner.policy_state()["action_net.weight"]
    assert not np.array_equal(weights["minibatch"], weights["rollout"])
    assert not np.array_equal(weights["rollout"], weights["none"])


def test_unit_norm_initialisation(open_learner: Open) -> None:
    """Each unit's incoming weights have norm 1, those of an action 0.01, biases are zero."""
    state = open_learner(weight_initialisation="unit_norm").policy_state()
    for name, values in state.items():
        if name.endswith(".bias"):
            assert not values.any(), name
        elif name.endswith(".weight"):
            norm = 0.01 if name == "action_net.weight" else 1.0
            np.testing.assert_allclose(np.linalg.norm(values, axis=1), norm, rtol=1e-5, err_msg=name)


def test_initial_weights_come_from_the_seed_alone(open_learner: Open) -> None:
    """The process's generators neither matter nor are touched."""
    torch.manual_seed(1)
    first = open_learner(seed=9).policy_state()
    torch.manual_seed(2)
    before = torch.get_rng_state()
    second = open_learner(seed=9).policy_state()
    assert torch.equal(before, torch.get_rng_state())
    other = open_learner(seed=10).policy_state()
    assert all(np.array_equal(first[name], second[name]) for name in first)
    assert not np.array_equal(first["action_net.weight"], other["action_net.weight"])


def test_learning_rate_falls_linearly_where_asked(open_learner: Open) -> None:
    """Halfway through, the linear schedule is at half the rate."""
    learner = open_learner(learning_rate_schedule="linear", learning_rate=1e-3, total_steps=512)
    collect(learner)
    learner.train()
    assert learner.figures()["train/learning_rate"] == pytest.approx(5e-4)


def test_loss_that_is_not_finite_is_reported(open_learner: Open) -> None:
    """The message says when and what."""
    learner = open_learner()
    collect(learner)
    learner.rollout_buffer.returns[3, 2] = np.nan
    with pytest.raises(TrainingDivergedError, match="loss is no longer finite after 256 steps"):
        learner.train()


def test_observation_that_is_not_finite_is_named(open_learner: Open) -> None:
    """The message names the observation and the environment."""
    learner = open_learner()
    env = learner._sprint_env
    env.normaliser.observation_moments.mean[43] = np.nan
    with pytest.raises(TrainingDivergedError, match="'height' of environment 0"):
        collect(learner)


def test_weight_that_is_not_finite_is_reported(open_learner: Open) -> None:
    """A learning rate that destroys the weights is noticed in the same update."""
    learner = open_learner(target_kl=None, max_grad_norm=None, normalise_rewards=False)
    collect(learner)
    weight = learner.policy.get_parameter("action_net.weight")
    hook = weight.register_hook(lambda grad: grad * float("inf"))  # type: ignore[no-untyped-call]
    with pytest.raises(TrainingDivergedError, match="no longer finite"):
        learner.train()
    hook.remove()
