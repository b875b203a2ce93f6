"""Learn by PPO: stable-baselines3's algorithm with a lean rollout and update.

Networks, optimiser, rollout buffer, advantage estimate and loss are those of stable-baselines3. What is done
differently is the order of work: during a rollout only the actor runs, exploration noise is drawn once per rollout,
and values are computed in one pass at its end; an update works on tensors without copies to and from NumPy.
"""

from __future__ import annotations

import math
from time import perf_counter
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from torch import nn

from naosprint.dense import FEW_ROWS, dense_layers, run_network
from naosprint.symmetry import Mirror, tie_weights
from naosprint.vec_env import SprintVecEnv

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from naospec import TrainingSpec
    from stable_baselines3.common.buffers import RolloutBuffer
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv

    from naosprint.arrays import AnyArray, Float32Array

_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)
_RATE_STEP = 1.2
_RATE_RANGE = (1e-5, 1e-2)
_ADAM = ("step", "exp_avg", "exp_avg_sq")


class TrainingDivergedError(RuntimeError):
    """Say that a number of the training is no longer finite, and which."""


class SprintPPO(PPO):
    """Run stable-baselines3's PPO on a :class:`~naosprint.vec_env.SprintVecEnv`.

    Args:
        spec: the training's specification.
        env: its environments.
    """

    def __init__(self, spec: TrainingSpec, env: SprintVecEnv) -> None:
        # initial weights come from the seed without touching the process's generators
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(spec.seed)
            super().__init__(
                "MlpPolicy",
                env,
                learning_rate=_schedule(spec),
                n_steps=spec.n_steps,
                batch_size=spec.batch_size,
                n_epochs=spec.n_epochs,
                gamma=spec.gamma,
                gae_lambda=spec.gae_lambda,
                clip_range=spec.clip_range,
                normalize_advantage=spec.advantage_normalisation == "minibatch",
                ent_coef=spec.entropy_coefficient,
                vf_coef=spec.value_coefficient,
                max_grad_norm=math.inf if spec.max_grad_norm is None else spec.max_grad_norm,
                target_kl=spec.target_kl,
                policy_kwargs={
                    "net_arch": list(spec.hidden_sizes),
                    "activation_fn": nn.Tanh,
                    "log_std_init": spec.initial_log_std,
                    "ortho_init": spec.weight_initialisation == "orthogonal",
                    "optimizer_kwargs": {"eps": spec.adam_epsilon, "fused": True},
                },
                device="cpu",
            )
            if spec.weight_initialisation == "unit_norm":
                _initialise_unit_norm(self.policy)
            if spec.symmetric_policy:
                batch = env.batch
                tie_weights(self.policy, Mirror.of_names(batch.observer.names), Mirror.of_names(batch.actuation.names))
        if spec.final_log_std is not None:
            self.policy.log_std.requires_grad_(False)
        self.set_logger(Logger(folder=None, output_formats=[]))
        self.spec = spec
        self._actor = dense_layers((*self.policy.mlp_extractor.policy_net, self.policy.action_net))
        self._critic = dense_layers((*self.policy.mlp_extractor.value_net, self.policy.value_net))
        self.generator = torch.Generator()
        self.generator.manual_seed(spec.seed)
        self.collect_s = 0.0
        self.learn_s = 0.0
        self.rate_factor = 1.0
        self._average = {name: tensor.clone() for name, tensor in self.policy.state_dict().items()}
        self._averaged = 0
        self._total_timesteps = spec.planned_steps

    def begin(self) -> None:
        """Begin the first episodes."""
        self._last_obs = self._sprint_env.reset()
        self._last_episode_starts = np.ones(self.n_envs, dtype=np.bool_)

    @property
    def _sprint_env(self) -> SprintVecEnv:
        return cast("SprintVecEnv", self.env)

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback | None,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
        stop: Callable[[], bool] | None = None,
    ) -> bool:
        """Fill the rollout buffer.

        Args:
            env: the environments.
            callback: not used; the training loop reports between rollouts.
            rollout_buffer: where the rollout goes.
            n_rollout_steps: steps of each environment.
            stop: asked before every step; the rollout is given up when it says so.

        Returns:
            Whether the rollout is complete.

        Raises:
            TrainingDivergedError: if an observation is not finite.
        """
        del callback
        began = perf_counter()
        sprint = cast("SprintVecEnv", env)
        buffer = rollout_buffer
        n, gamma = sprint.num_envs, _discount(self.spec, self.num_timesteps)
        self.gamma = buffer.gamma = sprint.normaliser.gamma = gamma
        buffer.reset()
        policy = self.policy
        policy.set_training_mode(False)
        action_dim = buffer.action_dim
        with torch.no_grad():
            if self.spec.final_log_std is not None:
                policy.log_std.fill_(_scheduled_log_std(self.spec, self.num_timesteps))
            log_std = policy.log_std.detach()
            noise = torch.randn((n_rollout_steps, n, action_dim), generator=self.generator)
            actions = torch.from_numpy(buffer.actions)
            scaled_noise = noise * log_std.exp()
            observations = np.array(self._last_obs, dtype=np.float32)
            starts = np.array(self._last_episode_starts, dtype=np.bool_)
            many = n >= FEW_ROWS
            # while the simulator computes for one group, another is seen to
            for step in range(n_rollout_steps + 1):
                if stop is not None and step < n_rollout_steps and stop():
                    for group in sprint.groups if step else ():
                        sprint.receive(group)
                    return False
                for group in sprint.groups:
                    if step:
                        transition = sprint.receive(group)
                        if not np.isfinite(transition.observations.sum()):
                            raise TrainingDivergedError(_locate(sprint, transition.observations, group))
                        observations[group], starts[group] = transition.observations, transition.dones
                        rewards = buffer.rewards[step - 1, group]
                        rewards[:] = transition.rewards
                        if len(transition.cut_rows):
                            cut = run_network(self._critic, torch.from_numpy(transition.cut_observations)).numpy()
                            rewards[transition.cut_rows] += gamma * cut[:, 0]
                    if step < n_rollout_steps:
                        buffer.observations[step, group] = observations[group]
                        buffer.episode_starts[step, group] = starts[group]
                        mean = run_network(self._actor, torch.from_numpy(observations[group]), fused=many)
                        torch.add(mean, scaled_noise[step, group], out=actions[step, group])
                        sprint.send(buffer.actions[step, group], group)
            values = run_network(self._critic, torch.from_numpy(buffer.observations.reshape(n_rollout_steps * n, -1)))
            buffer.values[:] = values.numpy().reshape(n_rollout_steps, n)
            density = -0.5 * noise.square().sum(dim=2) - log_std.sum() - action_dim * _HALF_LOG_TWO_PI
            buffer.log_probs[:] = density.numpy()
            last_values = run_network(self._critic, torch.from_numpy(observations))
        buffer.pos, buffer.full = buffer.buffer_size, True
        buffer.compute_returns_and_advantage(last_values=last_values, dones=starts)
        self._last_obs = observations
        self._last_episode_starts = starts
        self.num_timesteps += n * n_rollout_steps
        self.collect_s = perf_counter() - began
        return True

    def train(self) -> None:
        """Improve the policy with the rollout in the buffer.

        Raises:
            TrainingDivergedError: if the loss or a weight is no longer finite.
        """
        began = perf_counter()
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        policy, spec, buffer = self.policy, self.spec, self.rollout_buffer
        policy.set_training_mode(True)
        rate = self.lr_schedule(self._current_progress_remaining) * self.rate_factor
        for group in policy.optimizer.param_groups:
            group["lr"] = rate
        size = buffer.buffer_size * buffer.n_envs
        observations = torch.from_numpy(buffer.observations.reshape(size, -1))
        actions = torch.from_numpy(buffer.actions.reshape(size, -1))
        old_log_probs = torch.from_numpy(buffer.log_probs.reshape(size))
        returns = torch.from_numpy(buffer.returns.reshape(size))
        advantages = torch.from_numpy(buffer.advantages.reshape(size))
        target_kl = _target_kl(spec, self._current_progress_remaining)
        if spec.advantage_normalisation == "rollout":
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        parameters = list(policy.parameters())
        clip = spec.clip_range
        logs: list[tuple[float, ...]] = []
        early = False
        for _ in range(spec.n_epochs):
            order = torch.randperm(size, generator=self.generator)
            kls: list[float] = []
            for first in range(0, size, spec.batch_size):
                chosen = order[first : first + spec.batch_size]
                seen = observations.index_select(0, chosen)
                log_std = policy.log_std
                mean = run_network(self._actor, seen)
                values = run_network(self._critic, seen).squeeze(1)
                deviation = (actions.index_select(0, chosen) - mean) * (-log_std).exp()
                normaliser = log_std.sum() + log_std.numel() * _HALF_LOG_TWO_PI
                log_probs = -0.5 * deviation.square().sum(dim=1) - normaliser
                advantage = advantages.index_select(0, chosen)
                if spec.advantage_normalisation == "minibatch":
                    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                log_ratio = log_probs - old_log_probs.index_select(0, chosen)
                ratio = log_ratio.exp()
                clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
                policy_loss = -torch.min(advantage * ratio, advantage * clipped).mean()
                value_loss = (returns.index_select(0, chosen) - values).square().mean()
                # of a Gaussian whose spread does not depend on the state
                entropy = log_std.sum() + log_std.numel() * (0.5 + _HALF_LOG_TWO_PI)
                loss = policy_loss - spec.entropy_coefficient * entropy + spec.value_coefficient * value_loss
                with torch.no_grad():
                    # Schulman's low-variance estimate, http://joschu.net/blog/kl-approx.html
                    kl = float(((ratio - 1.0) - log_ratio).mean())
                    clip_fraction = float(((ratio - 1.0).abs() > clip).float().mean())
                kls.append(kl)
                logs.append(
                    (float(policy_loss.detach()), float(value_loss.detach()), float(entropy.detach()), clip_fraction)
                )
                if not all(map(math.isfinite, (*logs[-1], kl))):
                    raise TrainingDivergedError(
                        f"the loss is no longer finite after {self.num_timesteps} steps "
                        f"(policy {logs[-1][0]}, value {logs[-1][1]}, KL {kl}); lower learning_rate"
                    )
                if target_kl is not None and kl > 1.5 * target_kl:
                    early = True
                    break
                policy.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                if spec.max_grad_norm is not None:
                    nn.utils.clip_grad_norm_(parameters, spec.max_grad_norm)
                policy.optimizer.step()
            self._n_updates += 1
            if early:
                break
        if not all(bool(torch.isfinite(parameter).all()) for parameter in parameters):
            raise TrainingDivergedError(
                f"a weight is no longer finite after {self.num_timesteps} steps; lower learning_rate"
            )
        self._update_average()
        means = np.mean(logs, axis=0).tolist()
        record = self.logger.record
        record("train/learning_rate", rate)
        if spec.learning_rate_schedule == "adaptive":
            self.rate_factor = _adapted(self.rate_factor, float(np.mean(kls)), target_kl, spec)
        record("train/policy_gradient_loss", means[0])
        record("train/value_loss", means[1])
        record("train/entropy_loss", -means[2])
        record("train/clip_fraction", means[3])
        record("train/approx_kl", float(np.mean(kls)))
        record("train/explained_variance", _explained_variance(buffer.values, buffer.returns))
        record("train/std", float(policy.log_std.detach().exp().mean()))
        self.learn_s = perf_counter() - began

    def figures(self) -> dict[str, float]:
        """Return what the last update recorded, under stable-baselines3's names."""
        return {name: float(value) for name, value in self.logger.name_to_value.items()}

    def _update_average(self) -> None:
        """Let the latest weights into their running mean: a plain mean until it is as long as the decay's memory."""
        self._averaged += 1
        share = max(1.0 - self.spec.policy_averaging, 1.0 / self._averaged)
        for name, tensor in self.policy.state_dict().items():
            self._average[name].lerp_(tensor, share)

    def policy_state(self) -> dict[str, AnyArray]:
        """Return the weights that a checkpoint's policy has, by stable-baselines3's names: their running mean."""
        return {name: tensor.numpy().copy() for name, tensor in self._average.items()}

    def load_policy_state(self, state: Mapping[str, AnyArray]) -> None:
        """Take over weights by stable-baselines3's names, as the latest ones and as their mean."""
        self.policy.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in state.items()})
        self._average = {name: torch.from_numpy(np.array(value)) for name, value in state.items()}

    def learner_state(self) -> dict[str, AnyArray]:
        """Return optimiser, generators, where the rollout stands, and the latest weights."""
        state: dict[str, AnyArray] = {
            "generator": self.generator.get_state().numpy().copy(),
            "episode_starts": np.array(self._last_episode_starts, dtype=np.bool_),
            "n_updates": np.array([self._n_updates], dtype=np.int64),
            "rate_factor": np.array([self.rate_factor]),
            "averaged": np.array([self._averaged], dtype=np.int64),
            **{f"latest.{name}": tensor.numpy().copy() for name, tensor in self.policy.state_dict().items()},
        }
        for name, parameter in self.policy.named_parameters():
            slots = self.policy.optimizer.state.get(parameter)
            for slot in _ADAM:
                value = slots[slot] if slots else torch.zeros_like(parameter if slot != "step" else torch.zeros(()))
                state[f"adam.{slot}.{name}"] = value.detach().numpy().copy()
        return state

    def load_learner_state(self, state: Mapping[str, AnyArray], observations: Float32Array) -> None:
        """Take over what :meth:`learner_state` returned; ``observations`` are those to act on next."""
        self.generator.set_state(torch.from_numpy(np.array(state["generator"], dtype=np.uint8)))
        self._last_episode_starts = np.array(state["episode_starts"], dtype=np.bool_)
        self._last_obs = observations
        self._n_updates = int(np.asarray(state["n_updates"])[0])
        self.rate_factor = float(np.asarray(state["rate_factor"], dtype=np.float64)[0])
        self._averaged = int(np.asarray(state["averaged"])[0])
        prefix = "latest."
        latest = {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}
        self.policy.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in latest.items()})
        for name, parameter in self.policy.named_parameters():
            self.policy.optimizer.state[parameter] = {
                slot: torch.from_numpy(np.array(state[f"adam.{slot}.{name}"], dtype=np.float32)) for slot in _ADAM
            }


def _schedule(spec: TrainingSpec) -> float | Callable[[float], float]:
    if spec.learning_rate_schedule != "linear":
        return spec.learning_rate
    rate = spec.learning_rate
    return lambda remaining: rate * max(remaining, 0.0)


def _discount(spec: TrainingSpec, steps: int) -> float:
    """Return the discount factor after so many steps."""
    return spec.gamma if spec.final_gamma is None or steps < spec.gamma_steps else spec.final_gamma


def _scheduled_log_std(spec: TrainingSpec, steps: int) -> float:
    """Return the log-std of the actions after so many steps, where it is not learnt."""
    final = spec.initial_log_std if spec.final_log_std is None else spec.final_log_std
    share = steps / (spec.log_std_steps or spec.planned_steps)
    return spec.initial_log_std + (final - spec.initial_log_std) * min(1.0, share)


def _target_kl(spec: TrainingSpec, remaining: float) -> float | None:
    """Return the target KL with ``remaining`` of the training ahead, 1 to 0."""
    if spec.target_kl is None or spec.target_kl_final is None:
        return spec.target_kl
    return spec.target_kl_final + (spec.target_kl - spec.target_kl_final) * max(0.0, remaining)


def _adapted(factor: float, kl: float, wanted: float | None, spec: TrainingSpec) -> float:
    """Lower the rate after an update that went too far from the rollout's policy, raise it after a timid one.

    The rule is that of RSL-RL (Rudin et al., "Learning to Walk in Minutes", 2022), once an update instead of once a
    minibatch.
    """
    if wanted is None:
        return factor
    if kl > 1.5 * wanted:
        factor /= _RATE_STEP
    elif kl < wanted / 1.5:
        factor *= _RATE_STEP
    return min(max(factor, _RATE_RANGE[0] / spec.learning_rate), _RATE_RANGE[1] / spec.learning_rate)


def _initialise_unit_norm(policy: Any) -> None:
    """Draw Gaussian weights and scale each unit's incoming ones to norm 1, those of the action layer to 0.01."""
    with torch.no_grad():
        for module in policy.modules():
            if isinstance(module, nn.Linear):
                norm = 0.01 if module is policy.action_net else 1.0
                module.weight.normal_()
                module.weight.mul_(norm / module.weight.norm(dim=1, keepdim=True))
                module.bias.zero_()


def _explained_variance(values: Float32Array, returns: Float32Array) -> float:
    variance = float(np.var(returns))
    return 1.0 - float(np.var(returns - values)) / variance if variance > 0.0 else 0.0


def _locate(env: SprintVecEnv, observations: Float32Array, group: slice) -> str:
    row, column = np.argwhere(~np.isfinite(observations))[0]
    return f"observation {env.batch.observer.names[column]!r} of environment {group.start + row} is no longer finite"
