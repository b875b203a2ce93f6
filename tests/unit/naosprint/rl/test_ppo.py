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
from naosprint.symmetry import Mirror
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
    receive = env.receive

    def watch(group: slice) -> object:
        transition = receive(group)
        seen.append((len(seen), transition.rewards.copy(), transition.cut_rows, transition.cut_observations))
        return transition

    monkeypatch.setattr(env, "receive", watch)
    collect(learner)
    cuts = 0
    for step, rewards, rows, observations in seen:
        expected = rewards.copy()
        if len(rows):
            with torch.no_grad():
                value = learner.policy.predict_values(torch.from_numpy(observations)).numpy()[:, 0]
            expected[rows] += learner.spec.gamma * value
            cuts += len(rows)
        np.testing.assert_allclose(learner.rollout_buffer.rewards[step], expected, atol=1e-5)
    assert cuts >= 16


@pytest.mark.parametrize("entropy", [0.0, 0.01])
def test_update_is_that_of_stable_baselines3(
    open_learner: Open, entropy: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the same rollout and minibatches, PPO.train and ours arrive at the same weights."""
    fields = {
        "entropy_coefficient": entropy,
        "n_epochs": 3,
        "target_kl": None,
        "learning_rate": 1e-3,
        "learning_rate_schedule": "constant",
    }
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


@pytest.mark.parametrize(
    ("final", "remaining", "wanted"), [(None, 0.3, 0.03), (0.01, 1.0, 0.03), (0.01, 0.5, 0.02), (0.01, -0.1, 0.01)]
)
def test_target_kl_moves_linearly_to_its_final_value(final: float | None, remaining: float, wanted: float) -> None:
    from naosprint.learner import _target_kl

    spec = TrainingSpec(target_kl=0.03, target_kl_final=final)
    assert _target_kl(spec, remaining) == pytest.approx(wanted)
    assert _target_kl(TrainingSpec(target_kl=None, learning_rate_schedule="constant"), remaining) is None


@pytest.mark.parametrize(("total_steps", "log_std_steps"), [(1024, None), (2048, 1024)])
def test_scheduled_spread_follows_the_steps_and_nothing_else(
    open_learner: Open, total_steps: int, log_std_steps: int | None
) -> None:
    """It goes straight from the first value to the last, whatever updates say, and actions explore with it."""
    learner = open_learner(
        initial_log_std=-1.0,
        final_log_std=-2.0,
        log_std_steps=log_std_steps,
        total_steps=total_steps,
        learning_rate=0.01,
    )
    assert learner.spec.rollout_steps == 256
    for wanted in (-1.0, -1.25, -1.5, -1.75, -2.0, -2.0):
        collect(learner)
        assert learner.policy.log_std.tolist() == pytest.approx([wanted] * 20)
        with torch.no_grad():
            observations = torch.from_numpy(learner.rollout_buffer.observations.reshape(256, -1))
            means = learner.policy.get_distribution(observations).mode().numpy()
        spread = float(np.std(learner.rollout_buffer.actions.reshape(256, -1) - means))
        assert spread == pytest.approx(np.exp(wanted), rel=0.1)
        learner.train()
        assert learner.policy.log_std.tolist() == pytest.approx([wanted] * 20)


def test_the_discount_changes_at_its_step_everywhere(open_learner: Open) -> None:
    """Returns, advantages and the rewards' normalisation use the same one."""
    learner = open_learner(gamma=0.9, final_gamma=0.5, gamma_steps=512, total_steps=1024)
    for wanted in (0.9, 0.9, 0.5, 0.5):
        collect(learner)
        buffer = learner.rollout_buffer
        assert (learner.gamma, buffer.gamma, learner._sprint_env.normaliser.gamma) == (wanted, wanted, wanted)
        after = buffer.episode_starts[-1] == 0
        delta = buffer.rewards[-2] + wanted * buffer.values[-1] - buffer.values[-2]
        expected = delta + wanted * buffer.gae_lambda * buffer.advantages[-1]
        np.testing.assert_allclose(buffer.advantages[-2][after], expected[after], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("decay", [0.0, 0.75])
def test_checkpoints_hold_the_running_mean_of_the_weights(open_learner: Open, decay: float) -> None:
    """A plain mean at first, then one that forgets; without averaging, the latest weights."""
    learner = open_learner(policy_averaging=decay, learning_rate=0.01)
    name = "action_net.weight"
    seen = []
    for _ in range(6):
        collect(learner)
        learner.train()
        seen.append(learner.policy.state_dict()[name].numpy().astype(np.float64))
    if decay:
        wanted = np.mean(seen[:4], axis=0)
        for latest in seen[4:]:
            wanted = 0.75 * wanted + 0.25 * latest
    else:
        wanted = seen[-1]
    np.testing.assert_allclose(learner.policy_state()[name], wanted, atol=1e-6)
    assert np.array_equal(learner.learner_state()[f"latest.{name}"], seen[-1].astype(np.float32))


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


@pytest.mark.parametrize(("target_kl", "grows"), [(1e-6, False), (10.0, True)])
def test_learning_rate_follows_the_kl_divergence(open_learner: Open, target_kl: float, grows: bool) -> None:
    """An update that went too far lowers the next one's rate, a timid one raises it."""
    learner = open_learner(
        learning_rate_schedule="adaptive", learning_rate=1e-3, target_kl=target_kl, target_kl_final=None
    )
    for _ in range(2):
        collect(learner)
        learner.train()
    assert learner.figures()["train/learning_rate"] == pytest.approx(1.2e-3 if grows else 1e-3 / 1.2)


def test_adaptive_learning_rate_stays_within_bounds(open_learner: Open) -> None:
    """However long the updates are too small or too large."""
    for rate, target_kl, bound in ((2e-5, 1e-12, 1e-5), (1e-3, 100.0, 1e-2)):
        learner = open_learner(
            learning_rate_schedule="adaptive", learning_rate=rate, target_kl=target_kl, target_kl_final=None, n_steps=8
        )
        for _ in range(16):
            collect(learner)
            learner.train()
        assert learner.figures()["train/learning_rate"] == pytest.approx(bound)


def test_symmetric_policy_stays_symmetric(open_learner: Open) -> None:
    """After updates the mirrored observation still gets the mirrored action, and the same value."""
    learner = open_learner(symmetric_policy=True, batch_size=32)
    for _ in range(3):
        collect(learner)
        learner.train()
    batch = learner._sprint_env.batch
    seen, done = Mirror.of_names(batch.observer.names), Mirror.of_names(batch.actuation.names)
    state = learner.policy_state()
    weights = state["mlp_extractor.policy_net.0.weight"]
    half = len(weights) // 2
    np.testing.assert_array_equal(weights[:half], weights[half:, seen.place] * seen.sign.astype(np.float32))
    np.testing.assert_array_equal(state["log_std"], state["log_std"][done.place])
    observations = learner.rollout_buffer.observations[0]
    both = (observations, seen.apply(observations).astype(np.float32))
    with torch.no_grad():
        pair = [learner.policy.action_net(learner.policy.mlp_extractor.policy_net(torch.from_numpy(o))) for o in both]
        values = [learner.policy.predict_values(torch.from_numpy(o)) for o in both]
    np.testing.assert_allclose(pair[1].numpy(), done.apply(pair[0].numpy()), atol=1e-6)
    np.testing.assert_allclose(values[1].numpy(), values[0].numpy(), atol=1e-6)
    assert np.abs(pair[0].numpy()).max() > 1e-3


def test_tied_gradient_is_that_of_data_and_mirrored_data(open_learner: Open) -> None:
    """Tying projects a gradient onto the mean of itself and of its mirror image."""
    learner = open_learner(symmetric_policy=True)
    batch = learner._sprint_env.batch
    seen = Mirror.of_names(batch.observer.names)
    net = learner.policy.value_net, learner.policy.mlp_extractor.value_net
    parameter = learner.policy.get_parameter("mlp_extractor.value_net.0.weight")
    x = torch.randn((5, len(seen.place)), generator=torch.Generator().manual_seed(0))
    mirrored = torch.from_numpy(seen.apply(x.numpy()).astype(np.float32))

    def gradient(data: torch.Tensor) -> torch.Tensor:
        learner.policy.zero_grad()
        net[0](net[1](data)).square().mean().backward()
        assert parameter.grad is not None
        return parameter.grad.clone()

    torch.testing.assert_close(gradient(x), gradient(mirrored), atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(gradient(x), gradient(torch.cat([x, mirrored])), atol=1e-6, rtol=1e-4)


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
    learner = open_learner(
        target_kl=None, learning_rate_schedule="constant", max_grad_norm=None, normalise_rewards=False
    )
    collect(learner)
    weight = learner.policy.get_parameter("action_net.weight")
    hook = weight.register_hook(lambda grad: grad * float("inf"))  # type: ignore[no-untyped-call]
    with pytest.raises(TrainingDivergedError, match="no longer finite"):
        learner.train()
    hook.remove()
