"""Proximal policy optimization (Schulman et al., 2017), to be read from top to bottom.

Networks are those of stable-baselines3, and one update is that of its ``PPO.train``
(tests/unit/naosprint/rl/test_ppo.py). The order of work differs: during a rollout only the actor runs, exploration
noise is drawn once per rollout, values are computed in one pass at its end, and an update works on tensors without
copies to and from NumPy.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
import torch
from gymnasium import spaces
from naosim.simulator import NativeHandle
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from naosprint.mirror import Mirror
from naosprint.rl import schedules
from naosprint.rl.adam import Adam
from naosprint.rl.forward import Forward
from naosprint.rl.gradients import KernelGradients, Samples, gaussian_entropy
from naosprint.rl.learner import Learner, TrainingDivergedError
from naosprint.rl.networks import TorchForward, actor_of, blind, critic_of, linear_layers
from naosprint.rl.normalization import COUNT, CRITIC, STATISTICS, Normalizer, with_counts
from naosprint.rl.settings import PPOSettings
from naosprint.rl.symmetry import Symmetry, tie_weights
from naosprint.rl.warm_start import adapt, widen, with_critic

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from naospec import TrainingSpec
    from torch import Tensor

    from naosprint.arrays import AnyArray, BoolArray, Float32Array
    from naosprint.rl.rollout import TrainingEnvironment

_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)
_ADAM = ("step", "exp_avg", "exp_avg_sq")
_FIRST = "mlp_extractor.policy_net.0.weight"


class Rollout:
    """Storage of one rollout: T steps of n environments.

    Attributes:
        observations: (T, n, D) normalized observations.
        actions: (T, n, A) actions as drawn, not clipped.
        rewards: (T, n) normalized rewards, plus the discounted value of the next state where an episode ended and that
            value is estimated.
        episode_starts: (T, n) whether an observation is the first of its episode.
        values: (T, n) the critic's values of the observations.
        log_probs: (T, n) logarithms of the actions' probability densities.
        advantages: (T, n) estimated advantages.
        returns: (T, n) estimated returns.
        frozen: (T, n) whether another policy acted instead.
    """

    def __init__(self, n_steps: int, n_envs: int, n_observations: int, n_actions: int) -> None:
        self.observations: Float32Array = np.zeros((n_steps, n_envs, n_observations), np.float32)
        self.actions: Float32Array = np.zeros((n_steps, n_envs, n_actions), np.float32)
        self.rewards: Float32Array = np.zeros((n_steps, n_envs), np.float32)
        self.episode_starts: Float32Array = np.zeros((n_steps, n_envs), np.float32)
        self.values: Float32Array = np.zeros((n_steps, n_envs), np.float32)
        self.log_probs: Float32Array = np.zeros((n_steps, n_envs), np.float32)
        self.advantages: Float32Array = np.zeros((n_steps, n_envs), np.float32)
        self.returns: Float32Array = np.zeros((n_steps, n_envs), np.float32)
        self.frozen: BoolArray = np.zeros((n_steps, n_envs), np.bool_)

    def estimate_advantages(self, last_values: Float32Array, dones: BoolArray, gamma: float, gae_lambda: float) -> None:
        """Fill in advantages and returns by generalized advantage estimation (Schulman et al., 2016).

        Args:
            last_values: (n,) values of the observations after the last step.
            dones: (n,) whether these are the first of an episode.
            gamma: discount factor.
            gae_lambda: lambda of the estimate.
        """
        follows = 1.0 - dones.astype(np.float32)
        next_values = last_values
        estimate: Any = 0
        for step in reversed(range(len(self.rewards))):
            delta = self.rewards[step] + gamma * next_values * follows - self.values[step]
            estimate = delta + gamma * gae_lambda * follows * estimate
            self.advantages[step] = estimate
            follows = 1.0 - self.episode_starts[step]
            next_values = self.values[step]
        self.returns = self.advantages + self.values

    def leave_out_frozen(self, normalized: bool) -> None:
        """Give actions that did not act the advantage 0, or the mean if advantages are normalized: they teach nothing.

        The critic still learns what follows from them.
        """
        if self.frozen.any():
            acting = self.advantages[~self.frozen]
            self.advantages[self.frozen] = acting.mean() if normalized and len(acting) else 0.0

    def flat(self, name: str) -> Tensor:
        """Return one of the arrays as a tensor with one row per sample."""
        array = getattr(self, name)
        return torch.from_numpy(array.reshape(-1, *array.shape[2:]))


class Losses:
    """PPO's losses and their gradients by PyTorch, with which the compiled kernel is compared.

    Args:
        policy: the networks, whose ``grad`` is filled in.
        settings: PPO's settings.
    """

    def __init__(self, policy: ActorCriticPolicy, settings: PPOSettings) -> None:
        self._log_std = policy.log_std
        self._settings = settings
        self._actor, self._critic = actor_of(policy), critic_of(policy)

    def prepare(self, samples: Samples) -> Samples:
        """Return the samples of a rollout as :meth:`both` takes them."""
        return samples

    def both(self, samples: Samples, chosen: Tensor) -> tuple[float, float, float, float, float]:
        """Compute the gradients of both networks for the samples ``chosen``, (k,) indices.

        Returns:
            Policy loss, value loss, entropy, fraction of clipped samples, and approximate KL divergence from the old
            policy.
        """
        policy_loss, entropy, clipped, kl = self.actor(samples, chosen)
        return policy_loss, self.critic(samples, chosen), entropy, clipped, kl

    def actor(self, samples: Samples, chosen: Tensor) -> tuple[float, float, float, float]:
        """Compute the gradient of policy loss and entropy for the samples ``chosen``, (k,) indices.

        Returns:
            Policy loss, entropy, fraction of clipped samples, and approximate KL divergence from the old policy.
        """
        settings, log_std = self._settings, self._log_std
        _forget(*self._actor.parameters(), log_std)
        # log pi(a|s) of a Gaussian: -1/2 sum(((a - mu(s)) / sigma)^2) - sum(log sigma) - A/2 log(2 pi)
        mean = self._actor(samples.observations.index_select(0, chosen))
        deviation = (samples.actions.index_select(0, chosen) - mean) * (-log_std).exp()
        log_probs = -0.5 * deviation.square().sum(dim=1) - (log_std.sum() + log_std.numel() * _HALF_LOG_TWO_PI)
        advantages = samples.advantages.index_select(0, chosen)
        if settings.advantage_normalization == "minibatch":
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        # r = pi(a|s) / pi_old(a|s); L = -E[min(r A, clip(r, 1 - c, 1 + c) A)]
        log_ratio = log_probs - samples.log_probs.index_select(0, chosen)
        ratio, clip = log_ratio.exp(), settings.clip_range
        policy_loss = -torch.min(advantages * ratio, advantages * ratio.clamp(1.0 - clip, 1.0 + clip)).mean()
        entropy = gaussian_entropy(log_std)
        (policy_loss - settings.entropy_coefficient * entropy).backward()
        with torch.no_grad():
            # KL = E[(r - 1) - log r], Schulman's low-variance estimate, http://joschu.net/blog/kl-approx.html
            kl = float(((ratio - 1.0) - log_ratio).mean())
            clipped = float(((ratio - 1.0).abs() > clip).float().mean())
            return float(policy_loss), float(entropy), clipped, kl

    def imitation(self, samples: Samples, chosen: Tensor) -> tuple[float, float]:
        """Compute the gradients of both networks for the samples ``chosen``, whose actions are demonstrations.

        Returns:
            Mean squared distance of the means from the demonstrations, and value loss.
        """
        _forget(*self._actor.parameters(), self._log_std)
        mean = self._actor(samples.observations.index_select(0, chosen))
        distance = (mean - samples.actions.index_select(0, chosen)).square().mean()
        distance.backward()
        return float(distance.detach()), self.critic(samples, chosen)

    def critic(self, samples: Samples, chosen: Tensor) -> float:
        """Compute the gradient of the value loss for the samples ``chosen``, (k,) indices, and return the loss."""
        _forget(*self._critic.parameters())
        # L = E[(R - V(s))^2]
        values = self._critic(samples.observations.index_select(0, chosen)).squeeze(1)
        value_loss = (samples.returns.index_select(0, chosen) - values).square().mean()
        (self._settings.value_coefficient * value_loss).backward()
        return float(value_loss.detach())


class PPO(Learner):
    """PPO for one training.

    Args:
        spec: the training's specification.
        environment: its environments.
    """

    own_state: ClassVar[tuple[str, ...]] = ("generator", "episode_starts", "normalizer.returns")

    def __init__(self, spec: TrainingSpec, environment: TrainingEnvironment) -> None:
        settings = PPOSettings.of(spec.algorithm)
        self.spec = spec
        self.settings = settings
        self.environment = environment
        self.processes = environment.processes
        self.policy, symmetry = _build_policy(spec, environment)
        self._optimizer = cast("Adam", self.policy.optimizer)
        actor, critic = actor_of(self.policy), critic_of(self.policy)
        self._losses: Losses | KernelGradients = Losses(self.policy, settings)
        self._actor: Forward | TorchForward = TorchForward(actor)
        self._critic: Forward | TorchForward = TorchForward(critic)
        if settings.compiled_update:
            seen = len(environment.environment.observer.names)
            threads = NativeHandle.threads_of(environment.environment.simulator)
            concurrent = spec.runtime.learner_threads > 1
            self._losses = KernelGradients(self.policy, settings, symmetry, seen=seen, concurrent=concurrent)
            self._actor, self._critic = (
                Forward.of(linear_layers(actor), threads),
                Forward.of(linear_layers(critic), threads),
            )
        inner = environment.environment
        self.normalizer = Normalizer(
            environment.n,
            environment.n_observations,
            observations=settings.normalize_observations,
            observation_clip=settings.observation_clip,
            rewards=settings.normalize_rewards,
            gamma=settings.gamma,
            mirror=inner.observer.mirror if settings.symmetric_policy else None,
            threads=NativeHandle.threads_of(inner.simulator),
        )
        self.rollout = Rollout(settings.n_steps, environment.n, environment.n_observations, environment.n_actions)
        self.generator = torch.Generator()
        self.generator.manual_seed(self.processes.share(spec).seed)
        self.steps = 0
        self.updates = 0
        self.rate_factor = 1.0
        self._n_passes = 0
        self._n_seen = len(environment.environment.observer.names)
        self._average = {name: tensor.clone() for name, tensor in self.policy.state_dict().items()}
        self._averaged = 0
        self._starts: BoolArray = np.ones(environment.n, dtype=np.bool_)

    def begin(self) -> None:
        """Begin the first episodes."""
        self.environment.reset()
        self.normalizer.update_observations(self.environment.observations)
        self._starts = np.ones(self.environment.n, dtype=np.bool_)

    # --- collection ---------------------------------------------------------------------------------------------------

    def jumps(self, before: TrainingSpec, steps: int) -> list[str]:
        """Return which scheduled settings change."""
        return schedules.jumps(before, self.spec, steps)

    def collect(self, stop: Callable[[], bool] = lambda: False) -> bool:
        """Collect one rollout; see :meth:`Learner.collect`."""
        environment, rollout, policy, normalizer = self.environment, self.rollout, self.policy, self.normalizer
        n, n_steps = environment.n, self.settings.n_steps
        gamma = normalizer.gamma = schedules.discount(self.spec, self.steps)
        policy.set_training_mode(False)
        self._actor.pack()
        self._critic.pack()
        with torch.no_grad():
            if self.settings.final_log_std is not None:
                policy.log_std.fill_(schedules.log_std(self.spec, self.steps))
            log_std = policy.log_std.detach()
            # a = mu(s) + sigma * noise
            noise = torch.randn((n_steps, n, environment.n_actions), generator=self.generator)
            scaled_noise = (noise * log_std.exp()).numpy()
        # by what all groups and processes have contributed to the statistics
        observations, starts = normalizer.observations(environment.observations), self._starts.copy()
        frozen = environment.environment.task.frozen
        _require_finite(environment, observations, slice(0, n))
        rollout.observations[0], rollout.episode_starts[0] = observations, starts
        bootstraps = self.settings.bootstrap_at_end and not environment.environment.task.ends_are_final
        # while the simulator computes for one group, another is processed here
        for step in range(n_steps + 1):
            if step < n_steps and stop():
                for group in environment.groups if step else ():
                    environment.step_wait(group)
                return False
            for group in environment.groups:
                seen = rollout.observations[step, group] if step < n_steps else observations[group]
                if step:
                    transition = environment.step_wait(group)
                    if not normalizer.observe(environment.observations[group], seen):
                        _require_finite(environment, seen, group)
                    starts[group] = transition.dones
                    rewards = rollout.rewards[step - 1, group]
                    normalizer.rewards(transition.rewards, transition.dones, group, rewards)
                    # where the episode could go on: r + gamma V(s')
                    follows = ~transition.failed if bootstraps else transition.truncated
                    if len(follows) and follows.any():
                        last = normalizer.observations(transition.last_observations[follows])
                        rewards[transition.ended[follows]] += gamma * self._critic(last)[:, 0]
                if step < n_steps:
                    rollout.episode_starts[step, group] = starts[group]
                    if frozen is not None:
                        rollout.frozen[step, group] = frozen[group]
                    actions = rollout.actions[step, group]
                    self._act(seen, scaled_noise[step, group], actions, step, group)
                    environment.step_async(actions, group)
        with torch.no_grad():
            # log pi_old(a|s), which needs only the noise: (a - mu) / sigma
            density = -0.5 * noise.square().sum(dim=2) - log_std.sum() - environment.n_actions * _HALF_LOG_TWO_PI
            rollout.log_probs[:] = density.numpy()
        # V(s) of all observations in one pass, and the advantages that follow
        samples = rollout.observations.reshape(n_steps * n, -1)
        rollout.values[:] = self._critic(samples).reshape(n_steps, n)
        last_values = self._critic(observations)[:, 0]
        rollout.estimate_advantages(last_values, starts, gamma, self.settings.gae_lambda)
        rollout.leave_out_frozen(self.settings.advantage_normalization != "none")
        self._starts = starts
        self.steps += n * n_steps * self.processes.size
        return True

    def _act(self, seen: Float32Array, noise: Float32Array, out: Float32Array, step: int, group: slice) -> None:
        """Write the (k, A) actions of a group at a step of the rollout to ``out``: the mean plus noise."""
        del step, group
        self._actor(seen, noise, out)

    # --- update -------------------------------------------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """Improve the policy with the rollout; see :meth:`Learner.update`."""
        self.normalizer.merge(self.processes)
        policy, settings, rollout = self.policy, self.settings, self.rollout
        policy.set_training_mode(True)
        # the step size of Adam: schedule times what earlier divergences have made of it
        rate = schedules.learning_rate(self.spec, self.steps) * self.rate_factor
        self._optimizer.lr = rate
        target_kl = schedules.target_kl(self.spec, self.steps)
        samples = Samples(
            **{name: rollout.flat(name) for name in ("observations", "actions", "log_probs", "advantages", "returns")}
        )
        if settings.advantage_normalization == "rollout":
            mean, std = self._spread(samples.advantages)
            samples = replace(samples, advantages=(samples.advantages - mean) / (std + 1e-8))
        samples = self._losses.prepare(samples)
        batch_size = settings.batch_size // self.processes.size
        parameters = list(policy.parameters())
        losses: list[tuple[float, ...]] = []
        kls: list[float] = []
        for _ in range(settings.n_epochs):
            # one pass over the rollout in minibatches of a new order
            order = torch.randperm(len(samples.returns), generator=self.generator)
            kls = []
            for first in range(0, len(samples.returns), batch_size):
                chosen = order[first : first + batch_size]
                # actor and critic share nothing but the norm of the gradient
                policy_loss, value_loss, entropy, clipped, kl = self._mean_of_processes(
                    parameters, self._losses.both(samples, chosen)
                )
                kls.append(kl)
                losses.append((policy_loss, value_loss, entropy, clipped))
                self._require_finite(losses[-1], kl)
                # the policy is too far from the one that collected: no step more
                if target_kl is not None and kl > 1.5 * target_kl:
                    break
                # g <- g min(1, max_grad_norm / |g|), then Adam
                self._optimizer.step(settings.max_grad_norm)
            self._n_passes += 1
            if target_kl is not None and kls[-1] > 1.5 * target_kl:
                break
        if not all(bool(torch.isfinite(array).all()) for array in (*parameters, policy.log_std.detach().exp())):
            raise TrainingDivergedError(
                f"a weight or the actions' standard deviation is no longer finite after {self.steps} steps; "
                "lower learning_rate"
            )
        # checkpoints contain the running mean of the weights
        self._update_average()
        kl = float(np.mean(kls))
        if settings.learning_rate_schedule == "adaptive":
            self.rate_factor = schedules.adapted_factor(self.spec, self.rate_factor, kl, target_kl)
        self.updates += 1
        policy_loss_mean, value_loss_mean, entropy_mean, clip_fraction = np.mean(losses, axis=0).tolist()
        return {
            "policy_loss": policy_loss_mean,
            "value_loss": value_loss_mean,
            "approx_kl": kl,
            "clip_fraction": clip_fraction,
            "explained_variance": explained_variance(rollout.values, rollout.returns),
            "action_std": float(policy.log_std.detach().exp().mean()),
            "entropy": entropy_mean,
            "learning_rate": rate,
        }

    def _mean_of_processes(self, parameters: Sequence[Tensor], figures: tuple[float, ...]) -> tuple[float, ...]:
        """Average gradients and figures of a minibatch over all processes, each of which had its share of it."""
        if self.processes.size == 1:
            return figures
        numbers = torch.tensor(figures, dtype=torch.float32)
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        self.processes.average([*gradients, numbers])
        return tuple(numbers.tolist())

    def _spread(self, values: Tensor) -> tuple[Any, Any]:
        """Return mean and standard deviation of all processes' values."""
        if self.processes.size == 1:
            return values.mean(), values.std()
        wide = values.double()
        count, total, squares = self.processes.sum(
            np.array([float(len(values)), float(wide.sum()), float(wide.square().sum())])
        )
        return total / count, math.sqrt(max(squares - total * total / count, 0.0) / (count - 1.0))

    def _require_finite(self, losses: tuple[float, ...], kl: float) -> None:
        if not all(map(math.isfinite, (*losses, kl))):
            raise TrainingDivergedError(
                f"the loss is no longer finite after {self.steps} steps "
                f"(policy {losses[0]}, value {losses[1]}, KL {kl}); lower learning_rate"
            )

    def _update_average(self) -> None:
        """Merge the latest weights into their moving average, which is a plain mean at first."""
        self._averaged += 1
        share = max(1.0 - self.settings.ema_decay, 1.0 / self._averaged)
        for name, tensor in self.policy.state_dict().items():
            self._average[name].lerp_(tensor, share)

    # --- state --------------------------------------------------------------------------------------------------------

    def policy_state(self) -> dict[str, AnyArray]:
        """Return the moving average of the weights, by stable-baselines3's names, and the observations' statistics."""
        statistics, seen = self.normalizer.state(), self._n_seen
        state: dict[str, AnyArray] = {name: tensor.numpy().copy() for name, tensor in self._average.items()}
        state[_FIRST] = state[_FIRST][:, :seen].copy()
        state |= {name: statistics[name][:seen] for name in (*STATISTICS, COUNT)}
        if seen < self.environment.n_observations:
            state |= {CRITIC + name: statistics[name][seen:] for name in STATISTICS}
        return state

    def load_policy_state(self, state: Mapping[str, AnyArray]) -> None:
        """Continue with these weights, as the latest ones and as their average, and with these statistics."""
        found = {name: np.array(value) for name, value in with_counts(state).items()}
        statistics = {**self.normalizer.state(), COUNT: found.pop(COUNT)}
        for name in STATISTICS:
            statistics[name] = np.append(found.pop(name), found.pop(CRITIC + name, ()))
        first = np.zeros((len(found[_FIRST]), self.environment.n_observations), np.float32)
        first[:, : self._n_seen] = found[_FIRST]
        weights = {name: torch.from_numpy(value) for name, value in {**found, _FIRST: first}.items()}
        self.policy.load_state_dict(weights)
        self._average = {name: tensor.clone() for name, tensor in weights.items()}
        self.normalizer.load_statistics(statistics)

    def adapt_policy(
        self,
        state: Mapping[str, AnyArray],
        *,
        observations: tuple[Sequence[str], Sequence[str]],
        actions: tuple[Sequence[str], Sequence[str]],
        critic: tuple[Sequence[str], Sequence[str]],
    ) -> Mapping[str, AnyArray]:
        """Return the policy of another training rearranged by names; see :mod:`naosprint.rl.warm_start`."""
        state = with_counts(state)
        if (observations[0], actions[0]) != (observations[1], actions[1]):
            inner = self.environment.environment
            rest, spreads = inner.actuation.rest, inner.observer.spreads
            state = adapt(state, observations=observations, actions=actions, rest=rest, spreads=spreads)
        return widen(with_critic(state, self._n_seen, critic), self.policy_state())

    def state(self) -> dict[str, AnyArray]:
        """Return optimizer, generator, episode starts, normalization, and the latest weights."""
        state: dict[str, AnyArray] = {
            "generator": self.generator.get_state().numpy().copy(),
            "episode_starts": self._starts.copy(),
            "n_updates": np.array([self._n_passes], dtype=np.int64),
            "rate_factor": np.array([self.rate_factor]),
            "averaged": np.array([self._averaged], dtype=np.int64),
            **{f"normalizer.{name}": value for name, value in self.normalizer.state().items()},
            **{f"latest.{name}": tensor.numpy().copy() for name, tensor in self.policy.state_dict().items()},
        }
        for name, parameter in self.policy.named_parameters():
            slots = self._optimizer.state.get(parameter)
            for slot in _ADAM:
                value = slots[slot] if slots else torch.zeros_like(parameter if slot != "step" else torch.zeros(()))
                state[f"adam.{slot}.{name}"] = value.detach().numpy().copy()
        return state

    def upgraded_state(self, state: Mapping[str, AnyArray]) -> Mapping[str, AnyArray]:
        """Return what :meth:`state` of an earlier version returned as this version's."""
        counts = "normalizer.observation_counts"
        if counts in state or "normalizer.observation_count" not in state:
            return state
        return {**state, counts: np.repeat(state["normalizer.observation_count"], self.environment.n_observations)}

    def load_state(self, state: Mapping[str, AnyArray], *, new_episodes: bool) -> None:
        """Restore what :meth:`state` returned; see :meth:`Learner.load_state`."""
        if new_episodes:
            n = self.environment.n
            state = {**state, "episode_starts": np.ones(n, np.bool_), "normalizer.returns": np.zeros(n)}
        self.normalizer.load_state({name: state[f"normalizer.{name}"] for name in self.normalizer.state()})
        self.generator.set_state(torch.from_numpy(np.array(state["generator"], dtype=np.uint8)))
        self._starts = np.array(state["episode_starts"], dtype=np.bool_)
        self._n_passes = int(np.asarray(state["n_updates"])[0])
        self.rate_factor = float(np.asarray(state["rate_factor"], dtype=np.float64)[0])
        self._averaged = int(np.asarray(state["averaged"])[0])
        prefix = "latest."
        latest = {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}
        self.policy.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in latest.items()})
        for name, parameter in self.policy.named_parameters():
            self._optimizer.state[parameter] = {
                slot: torch.from_numpy(np.array(state[f"adam.{slot}.{name}"], dtype=np.float32)) for slot in _ADAM
            }


def _forget(*parameters: Tensor) -> None:
    for parameter in parameters:
        parameter.grad = None


def _build_policy(spec: TrainingSpec, environment: TrainingEnvironment) -> tuple[ActorCriticPolicy, Symmetry | None]:
    """Return stable-baselines3's actor-critic networks with their optimizer, initialized from the seed.

    Also return the mirrors of the networks if their weights are tied.
    """
    settings = PPOSettings.of(spec.algorithm)
    symmetry: Symmetry | None = None
    # without touching the process's generators
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(spec.seed)
        policy = ActorCriticPolicy(
            spaces.Box(-np.inf, np.inf, (environment.n_observations,), np.float32),
            spaces.Box(-1.0, 1.0, (environment.n_actions,), np.float32),
            lambda _: settings.learning_rate,
            net_arch=list(settings.hidden_sizes),
            activation_fn=nn.Tanh,
            log_std_init=settings.initial_log_std,
            ortho_init=settings.weight_initialization == "orthogonal",
            optimizer_class=cast("Any", Adam),
            optimizer_kwargs={"eps": settings.adam_epsilon},
        ).to("cpu")
        if settings.weight_initialization == "unit_norm":
            _initialize_unit_norm(policy)
        if settings.symmetric_policy:
            inner = environment.environment
            actions = Mirror.of_names(inner.actuation.names, *inner.actuation.mirror)
            symmetry = tie_weights(policy, inner.observer.mirror, actions)
        blind(policy, len(environment.environment.observer.names))
    if settings.final_log_std is not None:
        policy.log_std.requires_grad_(False)
    return policy, symmetry


def _initialize_unit_norm(policy: ActorCriticPolicy) -> None:
    """Draw Gaussian weights and scale each unit's incoming ones to norm 1, those of the action layer to 0.01."""
    with torch.no_grad():
        for module in policy.modules():
            if isinstance(module, nn.Linear):
                norm = 0.01 if module is policy.action_net else 1.0
                module.weight.normal_()
                module.weight.mul_(norm / module.weight.norm(dim=1, keepdim=True))
                module.bias.zero_()


def explained_variance(values: Float32Array, returns: Float32Array) -> float:
    """Return which share of the returns' variance the values explain."""
    variance = float(np.var(returns))
    return 1.0 - float(np.var(returns - values)) / variance if variance > 0.0 else 0.0


def _require_finite(environment: TrainingEnvironment, observations: Float32Array, group: slice) -> None:
    if np.isfinite(observations.sum()):
        return
    row, column = np.argwhere(~np.isfinite(observations))[0]
    observer = environment.environment.observer
    name = (*observer.names, *observer.critic_names)[column]
    raise TrainingDivergedError(f"observation {name!r} of environment {group.start + row} is no longer finite")
