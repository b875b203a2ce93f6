"""PPO gives the results of stable-baselines3's in another order of computation."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from naospec import TrainingSpec
from naosprint.mirror import Mirror
from naosprint.rl import schedules
from naosprint.rl.learner import TrainingDivergedError
from naosprint.rl.policy import actor_of
from naosprint.rl.ppo import PPO, Rollout
from naosprint.rl.rollout import TrainingEnvironment
from naosprint.rl.symmetry import tie_weights
from naosprint.tasks.environment import open_training_environment
from stable_baselines3 import PPO as StockPPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv

Open = Callable[..., PPO]


@pytest.fixture
def open_learner(make_spec: Callable[..., TrainingSpec]) -> Iterator[Open]:
    """Return the maker of learners on small environments."""
    opened = []

    def make(**settings: object) -> PPO:
        spec = make_spec(**settings)
        environment, n_starts = open_training_environment(spec)
        opened.append(environment)
        learner = PPO(spec, TrainingEnvironment.from_spec(spec, environment, n_starts))
        learner.begin()
        return learner

    yield make
    for environment in opened:
        environment.close()


def actions_mirror(learner: PPO) -> Mirror:
    """Return the mirror of actions."""
    actuation = learner.environment.environment.actuation
    return Mirror.of_names(actuation.names, *actuation.mirror)


class Spaces(gymnasium.Env[np.ndarray, np.ndarray]):
    """Environment that only has the spaces of a learner's environment."""

    def __init__(self, learner: PPO) -> None:
        environment = learner.environment
        self.observation_space = spaces.Box(-np.inf, np.inf, (environment.n_observations,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (environment.n_actions,), np.float32)


def stock_learner(ours: PPO) -> StockPPO:
    """Return stable-baselines3's PPO with the settings, weights and rollout of naosprint's."""
    settings, environment = ours.settings, ours.environment
    rollout = ours.rollout
    theirs = StockPPO(
        "MlpPolicy",
        DummyVecEnv([lambda: Spaces(ours)] * environment.n),
        n_steps=settings.n_steps,
        batch_size=settings.batch_size,
        n_epochs=settings.n_epochs,
        learning_rate=settings.learning_rate,
        clip_range=settings.clip_range,
        ent_coef=settings.entropy_coefficient,
        vf_coef=settings.value_coefficient,
        max_grad_norm=settings.max_grad_norm,
        policy_kwargs={
            "net_arch": list(settings.hidden_sizes),
            "activation_fn": torch.nn.Tanh,
            "optimizer_kwargs": {"eps": settings.adam_epsilon},
        },
        device="cpu",
    )
    if settings.symmetric_policy:
        tie_weights(theirs.policy, environment.environment.observer.mirror, actions_mirror(ours))
    theirs.policy.load_state_dict({name: tensor.clone() for name, tensor in ours.policy.state_dict().items()})
    theirs.policy.log_std.requires_grad_(ours.policy.log_std.requires_grad)
    buffer = theirs.rollout_buffer
    for name in (
        "observations",
        "actions",
        "rewards",
        "episode_starts",
        "values",
        "log_probs",
        "advantages",
        "returns",
    ):
        getattr(buffer, name)[:] = getattr(rollout, name)
    buffer.pos, buffer.full = settings.n_steps, True
    theirs.set_logger(Logger(folder=None, output_formats=[]))
    return theirs


def test_rollout_contains_the_policys_own_values_and_densities(open_learner: Open) -> None:
    """Values and log-probabilities are those that stable-baselines3's policy gives for the stored data."""
    learner = open_learner()
    assert learner.collect()
    buffer = learner.rollout
    size = buffer.rewards.size
    with torch.no_grad():
        values, log_probs, _ = learner.policy.evaluate_actions(
            torch.from_numpy(buffer.observations.reshape(size, -1)), torch.from_numpy(buffer.actions.reshape(size, -1))
        )
    np.testing.assert_allclose(buffer.values.reshape(size), values.numpy()[:, 0], atol=1e-5)
    np.testing.assert_allclose(buffer.log_probs.reshape(size), log_probs.numpy(), atol=1e-4)


def test_actions_explore_with_the_policys_spread(open_learner: Open) -> None:
    """What is added to the mean action has the standard deviation exp(log_std)."""
    learner = open_learner(n_steps=128, initial_log_std=-0.7)
    assert learner.collect()
    buffer = learner.rollout
    with torch.no_grad():
        features = learner.policy.mlp_extractor.policy_net(torch.from_numpy(buffer.observations))
        noise = buffer.actions - learner.policy.action_net(features).numpy()
    assert noise.std() == pytest.approx(np.exp(-0.7), rel=0.03)
    assert abs(noise.mean()) < 0.02


def test_time_limit_bootstraps_the_value_of_what_would_have_followed(
    open_learner: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reward at a time limit includes the discounted value of the last observation; at an end it does not."""
    learner = open_learner(n_steps=16, normalize_rewards=False, normalize_observations=False)
    environment = learner.environment
    environment.environment.task.max_steps = 5
    seen: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    step_wait = environment.step_wait

    def watch(group: slice) -> object:
        transition = step_wait(group)
        follows = ~transition.failed
        last = learner.normalizer.observations(transition.last_observations[follows])
        seen.append((transition.rewards.copy(), transition.ended[follows], last))
        return transition

    monkeypatch.setattr(environment, "step_wait", watch)
    assert learner.collect()
    bootstrapped = 0
    for step, (rewards, rows, observations) in enumerate(seen):
        expected = rewards.copy()
        if len(rows):
            with torch.no_grad():
                value = learner.policy.predict_values(torch.from_numpy(observations)).numpy()[:, 0]
            expected[rows] += learner.settings.gamma * value
            bootstrapped += len(rows)
        np.testing.assert_allclose(learner.rollout.rewards[step], expected, atol=1e-5)
    assert bootstrapped >= 16


@pytest.mark.parametrize(("entropy", "symmetric"), [(0.0, True), (0.01, True), (0.01, False)])
@pytest.mark.parametrize("compiled", [True, False])
def test_update_is_that_of_stable_baselines3(
    open_learner: Open, entropy: float, symmetric: bool, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the same rollout and minibatches, stable-baselines3's PPO.train and naosprint's give the same weights."""
    ours = open_learner(
        entropy_coefficient=entropy,
        symmetric_policy=symmetric,
        compiled_update=compiled,
        n_epochs=3,
        target_kl=None,
        learning_rate=1e-3,
        learning_rate_schedule="constant",
        **({} if symmetric else {"final_log_std": None}),
    )
    assert ours.collect()
    theirs = stock_learner(ours)
    before = {name: tensor.clone() for name, tensor in ours.policy.state_dict().items()}
    n_steps, n_envs = ours.rollout.rewards.shape
    size = n_steps * n_envs
    orders = [torch.randperm(size, generator=torch.Generator().manual_seed(i)) for i in range(3)]
    ours_orders, theirs_orders = iter(orders), iter(orders)
    monkeypatch.setattr(torch, "randperm", lambda n, generator: next(ours_orders))
    metrics = ours.update()
    monkeypatch.undo()

    # stable-baselines3 flattens environment by environment, we step by step
    def permutation(n: int) -> np.ndarray:
        assert n == size
        flat = next(theirs_orders).numpy()
        order: np.ndarray = (flat % n_envs) * n_steps + flat // n_envs
        return order

    monkeypatch.setattr(np.random, "permutation", permutation)
    theirs.train()
    moved = 0.0
    for (name, mine), (_, stock) in zip(ours.policy.named_parameters(), theirs.policy.named_parameters(), strict=True):
        torch.testing.assert_close(mine, stock, atol=2e-5, rtol=1e-3, msg=name)
        moved = max(moved, float((mine.detach() - before[name]).abs().max()))
    assert moved > 1e-3
    recorded = theirs.logger.name_to_value
    names = {"policy_loss": "policy_gradient_loss", "action_std": "std", "entropy": "entropy_loss"}
    for name, value in metrics.items():
        known = float(recorded[f"train/{names.get(name, name)}"])
        assert value == pytest.approx(-known if name == "entropy" else known, rel=1e-2, abs=1e-4), name


def test_advantages_are_those_of_stable_baselines3() -> None:
    """Equal to the last bit, through ends of episodes."""
    n_steps, n_envs, rng = 64, 8, np.random.default_rng(0)
    ours = Rollout(n_steps, n_envs, 3, 2)
    space = spaces.Box(-1.0, 1.0, (3,), np.float32)
    theirs = RolloutBuffer(n_steps, space, space, device="cpu", gamma=0.993, gae_lambda=0.95, n_envs=n_envs)
    for name in ("rewards", "values"):
        getattr(ours, name)[:] = getattr(theirs, name)[:] = rng.normal(size=(n_steps, n_envs)).astype(np.float32)
    ours.episode_starts[:] = theirs.episode_starts[:] = rng.random((n_steps, n_envs)) < 0.1
    last_values, dones = rng.normal(size=n_envs).astype(np.float32), rng.random(n_envs) < 0.5
    ours.estimate_advantages(last_values, dones, 0.993, 0.95)
    theirs.compute_returns_and_advantage(torch.from_numpy(last_values), dones)
    np.testing.assert_array_equal(ours.advantages, theirs.advantages)
    np.testing.assert_array_equal(ours.returns, theirs.returns)


@pytest.mark.parametrize(
    ("final", "share", "wanted"), [(None, 0.7, 0.03), (0.01, 0.0, 0.03), (0.01, 0.5, 0.02), (0.01, 1.1, 0.01)]
)
def test_target_kl_moves_linearly_to_its_final_value(
    make_spec: Callable[..., TrainingSpec], final: float | None, share: float, wanted: float
) -> None:
    spec = make_spec(target_kl=0.03, target_kl_final=final, total_steps=2560)
    assert schedules.target_kl(spec, round(2560 * share)) == pytest.approx(wanted)
    constant = make_spec(target_kl=None, learning_rate_schedule="constant")
    assert schedules.target_kl(constant, 100) is None


@pytest.mark.parametrize(("total_steps", "log_std_steps"), [(1024, None), (2048, 1024)])
def test_scheduled_spread_follows_the_steps_and_nothing_else(
    open_learner: Open, total_steps: int, log_std_steps: int | None
) -> None:
    """It changes linearly from the first value to the last, regardless of updates, and actions explore with it."""
    learner = open_learner(
        initial_log_std=-1.0,
        final_log_std=-2.0,
        log_std_steps=log_std_steps,
        total_steps=total_steps,
        learning_rate=0.01,
    )
    assert learner.spec.rollout_steps == 256
    for wanted in (-1.0, -1.25, -1.5, -1.75, -2.0, -2.0):
        assert learner.collect()
        assert learner.policy.log_std.tolist() == pytest.approx([wanted] * 20)
        with torch.no_grad():
            observations = torch.from_numpy(learner.rollout.observations.reshape(256, -1))
            means = learner.policy.get_distribution(observations).mode().numpy()
        spread = float(np.std(learner.rollout.actions.reshape(256, -1) - means))
        assert spread == pytest.approx(np.exp(wanted), rel=0.1)
        learner.update()
        assert learner.policy.log_std.tolist() == pytest.approx([wanted] * 20)


def test_the_discount_changes_at_its_step_everywhere(open_learner: Open) -> None:
    """Returns, advantages and the rewards' normalization use the same one."""
    learner = open_learner(gamma=0.9, final_gamma=0.5, gamma_steps=512, total_steps=1024)
    for wanted in (0.9, 0.9, 0.5, 0.5):
        assert learner.collect()
        buffer = learner.rollout
        assert learner.normalizer.gamma == wanted
        after = buffer.episode_starts[-1] == 0
        delta = buffer.rewards[-2] + wanted * buffer.values[-1] - buffer.values[-2]
        expected = delta + wanted * learner.settings.gae_lambda * buffer.advantages[-1]
        np.testing.assert_allclose(buffer.advantages[-2][after], expected[after], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("decay", [0.0, 0.75])
def test_checkpoints_contain_the_running_mean_of_the_weights(open_learner: Open, decay: float) -> None:
    """A plain mean at first, then an exponential one; without averaging, the latest weights."""
    learner = open_learner(ema_decay=decay, learning_rate=0.01)
    name = "action_net.weight"
    seen = []
    for _ in range(6):
        assert learner.collect()
        learner.update()
        seen.append(learner.policy.state_dict()[name].numpy().astype(np.float64))
    if decay:
        wanted = np.mean(seen[:4], axis=0)
        for latest in seen[4:]:
            wanted = 0.75 * wanted + 0.25 * latest
    else:
        wanted = seen[-1]
    np.testing.assert_allclose(learner.policy_state()[name], wanted, atol=1e-6)
    assert np.array_equal(learner.state()[f"latest.{name}"], seen[-1].astype(np.float32))


def test_target_kl_ends_an_update_early(open_learner: Open) -> None:
    """A huge step is detected and the update ends."""
    learner = open_learner(target_kl=0.001, learning_rate=0.1, n_epochs=50)
    assert learner.collect()
    learner.update()
    assert int(learner.state()["n_updates"][0]) < 50


def test_two_threads_learn_what_one_learns(open_learner: Open) -> None:
    states = []
    for threads in (1, 2):
        learner = open_learner(learner_threads=threads, max_grad_norm=0.1, symmetric_policy=True)
        for _ in range(2):
            learner.collect()
            learner.update()
        states.append(learner.state())
    assert states[0].keys() == states[1].keys()
    for name, array in states[0].items():
        assert np.array_equal(array, states[1][name]), name


def test_rollout_advantages_are_standardized_once(open_learner: Open) -> None:
    """With advantages standardized over the rollout an update still learns, from other gradients."""
    weights = {}
    for kind in ("minibatch", "rollout", "none"):
        learner = open_learner(advantage_normalization=kind)
        assert learner.collect()
        learner.update()
        weights[kind] = learner.policy_state()["action_net.weight"]
    assert not np.array_equal(weights["minibatch"], weights["rollout"])
    assert not np.array_equal(weights["rollout"], weights["none"])


def test_unit_norm_initialization(open_learner: Open) -> None:
    """Each unit's incoming weights have norm 1, those of an action 0.01, biases are zero."""
    state = open_learner(weight_initialization="unit_norm").policy_state()
    for name, values in state.items():
        if name.endswith(".bias"):
            assert not values.any(), name
        elif name.endswith(".weight"):
            norm = 0.01 if name == "action_net.weight" else 1.0
            np.testing.assert_allclose(np.linalg.norm(values, axis=1), norm, rtol=1e-5, err_msg=name)


def test_initial_weights_come_from_the_seed_alone(open_learner: Open) -> None:
    """The process's generators have no influence and are not changed."""
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
    rates = []
    for _ in range(2):
        assert learner.collect()
        rates.append(learner.update()["learning_rate"])
    # the rate is taken after the rollout's steps
    assert rates == pytest.approx([5e-4, 0.0])


@pytest.mark.parametrize(("target_kl", "grows"), [(1e-6, False), (10.0, True)])
def test_learning_rate_follows_the_kl_divergence(open_learner: Open, target_kl: float, grows: bool) -> None:
    """An update that is too large lowers the next rate, one that is too small raises it."""
    learner = open_learner(
        learning_rate_schedule="adaptive", learning_rate=1e-3, target_kl=target_kl, target_kl_final=None
    )
    for _ in range(2):
        assert learner.collect()
        metrics = learner.update()
    assert metrics["learning_rate"] == pytest.approx(1.2e-3 if grows else 1e-3 / 1.2)


def test_adaptive_learning_rate_stays_within_bounds(open_learner: Open) -> None:
    """The rate stays within its limits."""
    for rate, target_kl, bound in ((2e-5, 1e-12, 1e-5), (1e-3, 10.0, 1e-2)):
        learner = open_learner(
            learning_rate_schedule="adaptive", learning_rate=rate, target_kl=target_kl, target_kl_final=None, n_steps=8
        )
        for _ in range(16):
            assert learner.collect()
            metrics = learner.update()
        assert metrics["learning_rate"] == pytest.approx(bound)


@pytest.mark.parametrize("robot", ["nao-0", "t1", "k1"])
def test_symmetric_policy_stays_symmetric(open_learner: Open, robot: str) -> None:
    """After updates the mirrored observation still gets the mirrored action, and the same value."""
    learner = open_learner(symmetric_policy=True, batch_size=32, robot=robot)
    for _ in range(3):
        assert learner.collect()
        learner.update()
    seen, done = learner.environment.environment.observer.mirror, actions_mirror(learner)
    state = learner.policy_state()
    weights = state["mlp_extractor.policy_net.0.weight"]
    half = len(weights) // 2
    np.testing.assert_array_equal(weights[:half], weights[half:, seen.index] * seen.sign.astype(np.float32))
    np.testing.assert_array_equal(state["log_std"], state["log_std"][done.index])
    observations = learner.rollout.observations[0]
    both = (observations, seen.apply(observations).astype(np.float32))
    with torch.no_grad():
        pair = [learner.policy.action_net(learner.policy.mlp_extractor.policy_net(torch.from_numpy(o))) for o in both]
        values = [learner.policy.predict_values(torch.from_numpy(o)) for o in both]
    np.testing.assert_allclose(pair[1].numpy(), done.apply(pair[0].numpy()), atol=1e-6)
    np.testing.assert_allclose(values[1].numpy(), values[0].numpy(), atol=1e-6)
    assert np.abs(pair[0].numpy()).max() > 1e-3


@pytest.mark.parametrize("compiled", [True, False])
def test_a_privileged_critic_sees_what_the_policy_does_not(open_learner: Open, compiled: bool) -> None:
    """The critic's weights for it change, the actor's stay 0, and the policy acts without it."""
    learner = open_learner(critic_observations=True, batch_size=32, robot="t1", compiled_update=compiled)
    observer = learner.environment.environment.observer
    names = ("true_height", "true_forward_velocity", "true_lateral_velocity")
    assert observer.critic_names == names
    d = len(observer.names)
    before = learner.policy.get_parameter("mlp_extractor.value_net.0.weight").detach().numpy()[:, d:].copy()
    for _ in range(2):
        assert learner.collect()
        learner.update()
    assert np.ptp(learner.rollout.observations[:, :, d:], axis=(0, 1)).min() > 0.0
    state = learner.policy_state()
    assert np.abs(learner.policy.get_parameter("mlp_extractor.policy_net.0.weight").detach().numpy()[:, d:]).max() == 0
    assert np.abs(state["mlp_extractor.value_net.0.weight"][:, d:] - before).max() > 0.0
    assert state["mlp_extractor.policy_net.0.weight"].shape[1] == len(state["observation_mean"]) == d
    policy = actor_of(state, learner.settings, d, learner.environment.n_actions)
    with torch.no_grad():
        learner.policy.load_state_dict(learner._average)
        normalized = torch.from_numpy(learner.normalizer.observations(learner.environment.observations))
        mean = learner.policy.action_net(learner.policy.mlp_extractor.policy_net(normalized)).numpy()
    raw = np.ascontiguousarray(learner.environment.observations[:, :d])
    np.testing.assert_allclose(policy.act(raw), np.clip(mean, -1.0, 1.0), atol=1e-5)


def test_a_policy_goes_on_with_another_critic(open_learner: Open) -> None:
    """A privileged critic begins with weight 0 for what the other did not see; a plain one forgets it."""
    plain, privileged = open_learner(robot="t1"), open_learner(robot="t1", critic_observations=True, seed=5)
    for learner in (plain, privileged):
        assert learner.collect()
        learner.update()
    actor, first = "mlp_extractor.policy_net.0.weight", "mlp_extractor.value_net.0.weight"
    d = plain.environment.n_observations
    for giver, taker in ((plain, privileged), (privileged, plain), (privileged, open_learner(robot="t1"))):
        given = giver.policy_state()
        names = giver.environment.environment.observer.names, giver.environment.environment.actuation.names
        critics = tuple(each.environment.environment.observer.critic_names for each in (giver, taker))
        adapted = taker.adapt_policy(given, observations=(names[0],) * 2, actions=(names[1],) * 2, critic=critics)
        taker.load_policy_state(adapted)
        taken = taker.policy_state()
        np.testing.assert_array_equal(taken[actor], given[actor])
        np.testing.assert_array_equal(taken["observation_mean"], given["observation_mean"])
        np.testing.assert_array_equal(taken[first][:, :d], given[first][:, :d])
        assert np.abs(taken[first][:, d:]).max(initial=0.0) == 0.0
    again = open_learner(robot="t1", critic_observations=True)
    given = {**privileged.policy_state(), first: np.ones_like(privileged.policy_state()[first])}
    again.load_policy_state(given)
    np.testing.assert_array_equal(again.policy_state()[first], given[first])


def test_what_a_critic_observes_is_found_by_its_name(open_learner: Open) -> None:
    """Two critics of as many observations, one of which is another quantity."""
    soft, slow = (
        open_learner(robot="t1", critic_observations=True, symmetric_policy=False, **disturbed)
        for disturbed in ({"stiffness_min": 0.5}, {"friction_min": 0.5, "extra_delay_max": 2})
    )
    first = "mlp_extractor.value_net.0.weight"
    names = tuple(each.environment.environment.observer.critic_names for each in (soft, slow))
    assert len(names[0]) == len(names[1])
    assert (names[0][-1], names[1][-1]) == ("contact_stiffness", "extra_delay")
    assert soft.collect()
    soft.update()
    given = soft.policy_state()
    d = given[first].shape[1] - len(names[0])
    inner = slow.environment.environment
    same = {"observations": (inner.observer.names,) * 2, "actions": (inner.actuation.names,) * 2}
    for known in (names[0], ()):
        taken = slow.adapt_policy(given, **same, critic=(known, names[1]))
        kept = len(names[1]) - 1 if known else 0
        np.testing.assert_array_equal(taken[first][:, : d + kept], given[first][:, : d + kept])
        assert np.abs(given[first][:, d:]).min() > 0.0
        assert not taken[first][:, d + kept :].any()
        for part, blank in (("mean", 0.0), ("variance", 1.0), ("counts", 1e-4)):
            found, before = taken[f"critic_observation_{part}"], given[f"critic_observation_{part}"]
            np.testing.assert_array_equal(found[:kept], before[:kept])
            assert (found[kept:] == blank).all()


def test_what_joins_a_policy_is_standardized_by_its_own_samples(open_learner: Open) -> None:
    """The start of its statistics must not weigh as much as all that the policy has observed before."""
    plain = open_learner(robot="t1")
    assert plain.collect()
    given = {**plain.policy_state(), "observation_counts": np.full(plain.environment.n_observations, 1e8)}
    privileged = open_learner(robot="t1", critic_observations=True)
    observer = privileged.environment.environment.observer
    same = {"observations": (observer.names,) * 2, "actions": (privileged.environment.environment.actuation.names,) * 2}
    privileged.load_policy_state(privileged.adapt_policy(given, **same, critic=((), observer.critic_names)))
    assert privileged.collect()
    state, d = privileged.state(), len(observer.names)
    counts = state["normalizer.observation_counts"]
    assert (counts[:d] > 1e8).all()
    assert (counts[d:] < 1e4).all()
    height = d + observer.critic_names.index("true_height")
    assert abs(state["normalizer.observation_mean"][height] - 0.66) < 0.1
    assert state["normalizer.observation_variance"][height] < 0.01
    again = open_learner(robot="t1", critic_observations=True)
    again.load_state(again.upgraded_state(state), new_episodes=True)
    np.testing.assert_array_equal(again.state()["normalizer.observation_counts"], counts)
    earlier = {name: value for name, value in state.items() if name != "normalizer.observation_counts"}
    again.load_state(again.upgraded_state(earlier), new_episodes=True)
    np.testing.assert_array_equal(
        again.state()["normalizer.observation_counts"], np.full(len(counts), state["normalizer.observation_count"][0])
    )


def test_tied_gradient_is_that_of_data_and_mirrored_data(open_learner: Open) -> None:
    """Tying projects a gradient onto the mean of itself and of its mirror image."""
    learner = open_learner(symmetric_policy=True)
    seen = learner.environment.environment.observer.mirror
    net = learner.policy.value_net, learner.policy.mlp_extractor.value_net
    parameter = learner.policy.get_parameter("mlp_extractor.value_net.0.weight")
    x = torch.randn((5, len(seen.index)), generator=torch.Generator().manual_seed(0))
    mirrored = torch.from_numpy(seen.apply(x.numpy()).astype(np.float32))

    def gradient(data: torch.Tensor) -> torch.Tensor:
        learner.policy.zero_grad()
        net[0](net[1](data)).square().mean().backward()
        assert parameter.grad is not None
        return parameter.grad.clone()

    torch.testing.assert_close(gradient(x), gradient(mirrored), atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(gradient(x), gradient(torch.cat([x, mirrored])), atol=1e-6, rtol=1e-4)


def test_loss_that_is_not_finite_is_reported(open_learner: Open) -> None:
    """The message contains the step and the value."""
    learner = open_learner()
    assert learner.collect()
    learner.rollout.returns[3, 2] = np.nan
    with pytest.raises(TrainingDivergedError, match="loss is no longer finite after 256 steps"):
        learner.update()


def test_observation_that_is_not_finite_is_named(open_learner: Open) -> None:
    """The message names the observation and the environment."""
    learner = open_learner()
    learner.normalizer.observation_moments.mean[43] = np.nan
    with pytest.raises(TrainingDivergedError, match="'height' of environment 0"):
        assert learner.collect()


def test_weight_that_is_not_finite_is_reported(open_learner: Open) -> None:
    """A learning rate that destroys the weights is noticed in the same update."""
    learner = open_learner(
        target_kl=None,
        learning_rate_schedule="constant",
        max_grad_norm=None,
        normalize_rewards=False,
        compiled_update=False,  # the kernel calls no hooks
    )
    assert learner.collect()
    weight = learner.policy.get_parameter("action_net.weight")
    hook = weight.register_hook(lambda grad: grad * float("inf"))  # type: ignore[no-untyped-call]
    with pytest.raises(TrainingDivergedError, match="no longer finite"):
        learner.update()
    hook.remove()
