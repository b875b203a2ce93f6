"""PPO for continuous actions in one file, with the details of CleanRL's ``ppo_continuous_action.py``.

Those are: orthogonal initialization with gains sqrt(2), 0.01 and 1; a state-independent log-std; running normalization
and clipping of observations and rewards by Gymnasium's wrappers; generalized advantage estimation; advantages
standardized per minibatch; clipped value loss; gradient norm limit; linearly falling learning rate; Adam epsilon 1e-5.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import vector as wrappers
from torch import nn
from torch.distributions import Normal

GAMMA, GAE_LAMBDA, CLIP, EPOCHS, MINIBATCHES = 0.99, 0.95, 0.2, 10, 32
LEARNING_RATE, VALUE_COEFFICIENT, ENTROPY_COEFFICIENT, MAX_GRAD_NORM = 3e-4, 0.5, 0.0, 0.5


@dataclass
class Record:
    """Metrics of a training."""

    steps: int = 0
    returns: list[float] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)


def layer(inputs: int, outputs: int, gain: float = float(np.sqrt(2))) -> nn.Linear:
    linear = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(linear.weight, gain)
    nn.init.zeros_(linear.bias)
    return linear


class Agent(nn.Module):
    def __init__(self, width: int, n_actions: int) -> None:
        super().__init__()
        self.critic = nn.Sequential(layer(width, 64), nn.Tanh(), layer(64, 64), nn.Tanh(), layer(64, 1, 1.0))
        self.actor = nn.Sequential(layer(width, 64), nn.Tanh(), layer(64, 64), nn.Tanh(), layer(64, n_actions, 0.01))
        self.log_std = nn.Parameter(torch.zeros(1, n_actions))

    def distribution(self, observations: torch.Tensor) -> Normal:
        mean = self.actor(observations)
        return Normal(mean, self.log_std.expand_as(mean).exp())


def train(envs: Any, *, total_timesteps: int, num_steps: int, seed: int) -> Record:
    """Train on a vector environment that restarts robots in the step after their last."""
    envs = wrappers.RecordEpisodeStatistics(envs)
    envs = wrappers.ClipAction(envs)
    envs = wrappers.NormalizeObservation(envs)
    envs = wrappers.TransformObservation(envs, lambda observations: np.clip(observations, -10, 10))
    envs = wrappers.NormalizeReward(envs, gamma=GAMMA)
    envs = wrappers.TransformReward(envs, lambda rewards: np.clip(rewards, -10, 10))
    assert isinstance(envs.single_action_space, gymnasium.spaces.Box)

    torch.manual_seed(seed)
    n = envs.num_envs
    batch = n * num_steps
    agent = Agent(int(np.prod(envs.single_observation_space.shape)), int(np.prod(envs.single_action_space.shape)))
    optimizer = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)
    shape = (num_steps, n)
    observations = torch.zeros(*shape, *envs.single_observation_space.shape)
    actions = torch.zeros(*shape, *envs.single_action_space.shape)
    log_probs, rewards, dones, values = (torch.zeros(shape) for _ in range(4))
    record = Record()

    def tensor(array: Any) -> torch.Tensor:
        return torch.as_tensor(np.asarray(array), dtype=torch.float32)

    latest = tensor(envs.reset(seed=seed)[0])
    done = torch.zeros(n)
    iterations = total_timesteps // batch
    for iteration in range(iterations):
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1.0 - iteration / iterations)
        for step in range(num_steps):
            record.steps += n
            observations[step], dones[step] = latest, done
            with torch.no_grad():
                distribution = agent.distribution(latest)
                action = distribution.sample()
                actions[step], values[step] = action, agent.critic(latest).flatten()
                log_probs[step] = distribution.log_prob(action).sum(1)
            new, reward, terminated, truncated, infos = envs.step(action.numpy())
            latest, rewards[step] = tensor(new), tensor(reward)
            done = tensor(terminated | truncated)
            if "episode" in infos:
                record.returns += infos["episode"]["r"][infos["_episode"]].tolist()

        with torch.no_grad():
            advantages = torch.zeros(shape)
            following, estimate, value = 1.0 - done, torch.zeros(n), agent.critic(latest).flatten()
            for step in reversed(range(num_steps)):
                delta = rewards[step] + GAMMA * value * following - values[step]
                estimate = delta + GAMMA * GAE_LAMBDA * following * estimate
                advantages[step] = estimate
                following, value = 1.0 - dones[step], values[step]
            returns = advantages + values

        flat = [part.flatten(0, 1) for part in (observations, actions, log_probs, advantages, returns, values)]
        for _ in range(EPOCHS):
            for chosen in torch.randperm(batch).split(batch // MINIBATCHES):
                seen, acted, old, advantage, target, before = (part[chosen] for part in flat)
                distribution = agent.distribution(seen)
                ratio = (distribution.log_prob(acted).sum(1) - old).exp()
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                clipped = ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
                policy_loss = torch.max(-advantage * ratio, -advantage * clipped).mean()
                estimated = agent.critic(seen).flatten()
                near = before + (estimated - before).clamp(-CLIP, CLIP)
                value_loss = 0.5 * torch.max((estimated - target).square(), (near - target).square()).mean()
                entropy = distribution.entropy().sum(1).mean()
                loss = policy_loss - ENTROPY_COEFFICIENT * entropy + VALUE_COEFFICIENT * value_loss
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), MAX_GRAD_NORM)
                optimizer.step()
        record.losses.append(float(loss.detach()))
    return record
