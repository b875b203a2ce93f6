"""The algorithm sac: stable-baselines3's soft actor-critic, added to naosprint by a package of its own."""

from __future__ import annotations

import numpy as np
import stable_baselines3
import torch
from gymnasium.spaces import Box
from naospec import LearnerSettings
from naosprint.rl.learner import Learner, LearnerKind
from naosprint.rl.policy import NetworkPolicy, take
from naosprint.tasks import Chart, Metric
from pydantic import Field
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.utils import set_random_seed

CLIP, RANGE, MOMENTS = 10.0, 0.3, ("mean", "var", "count")
BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
ADAM = ("step", "exp_avg", "exp_avg_sq")
FOUND = {"learning_rate": 5e-4, "gamma": 0.99, "n_steps": 5, "ent_coef": "auto_0.01"}  # by experiment


class SACSettings(LearnerSettings):
    units: int = Field(default=256, ge=1, le=4096, title="Units", description="Units of each of two hidden layers.")
    gradient_steps: int = Field(default=64, ge=1, title="Gradient steps", description="Gradient steps per update.")
    buffer_steps: int = Field(default=100_000, ge=100, title="Buffer", description="Steps in the replay buffer.")
    random_steps: int = Field(default=10_000, ge=1, title="Random steps", description="Steps with random actions.")


class SACLearner(Learner):
    """Soft actor-critic whose observations are standardized by the moments of the random steps."""

    def __init__(self, spec, environment):
        self.seed, self.settings, self.environment = spec.seed, SACSettings.of(spec.algorithm), environment
        self.steps = self.updates = 0
        width, n_actions = environment.n_observations, environment.n_actions
        self.model = model = stable_baselines3.SAC(
            "MlpPolicy", None, buffer_size=self.settings.buffer_steps, target_entropy=-float(n_actions), **FOUND,
            policy_kwargs={"net_arch": [self.settings.units] * 2}, device="cpu", seed=spec.seed,
            _init_setup_model=False,
        )  # fmt: skip
        model.observation_space = Box(-np.inf, np.inf, (width,), np.float32)
        model.action_space, model.n_envs = Box(-1.0, 1.0, (n_actions,), np.float32), environment.n
        model._setup_model()
        model.set_logger(Logger(None, []))
        self.moments, self.rollout = RunningMeanStd(1e-4, (width,)), []

    def begin(self):
        self.environment.reset()

    def collect(self, stop=lambda: False):
        environment, self.rollout = self.environment, []
        set_random_seed((self.seed + 7919 * self.updates) % 2**31)
        for _ in range(self.settings.n_steps):
            if stop():
                return False
            seen = environment.observations.copy()
            if self.steps < self.settings.random_steps:
                actions = np.random.uniform(-RANGE, RANGE, (environment.n, environment.n_actions)).astype(np.float32)
            else:
                with torch.no_grad():
                    actions = self.model.actor(torch.from_numpy(self.standardize(seen))).numpy()
            for group in environment.groups:
                environment.step_async(actions[group], group)
            parts = [environment.step_wait(group) for group in environment.groups]
            following, ends = environment.observations.copy(), np.zeros((2, environment.n))
            for group, part in zip(environment.groups, parts, strict=True):
                rows = group.start + part.ended
                following[rows], ends[0, rows], ends[1, rows] = part.last_observations, 1.0, ~part.failed
            self.rollout.append((seen, following, actions, np.concatenate([part.rewards for part in parts]), *ends))
        self.steps += environment.n * self.settings.n_steps
        return True

    def standardize(self, observations):
        scaled = (observations - self.moments.mean) / np.sqrt(self.moments.var + 1e-8)
        return np.clip(scaled, -CLIP, CLIP).astype(np.float32)

    def update(self):
        random = self.steps <= self.settings.random_steps or self.updates == 0
        if random:
            self.moments.update(np.concatenate([seen for seen, *_ in self.rollout]))
        for seen, following, *rest, cut in self.rollout:
            pair = self.standardize(seen), self.standardize(following)
            self.model.replay_buffer.add(*pair, *rest, [{"TimeLimit.truncated": truncated} for truncated in cut])
        self.updates += 1
        if random:
            return {}
        self.model.train(self.settings.gradient_steps, batch_size=256)
        found = self.model.logger.name_to_value
        return {metric.name: float(found[metric.name.replace("sac_", "train/")]) for metric in SACKind.metrics}

    def policy_state(self):
        networks = {name: value.numpy().copy() for name, value in self.model.policy.state_dict().items()}
        moments = {f"moments.{name}": np.array(getattr(self.moments, name)) for name in MOMENTS}
        return {**networks, **moments, "log_ent_coef": self.model.log_ent_coef.detach().numpy().copy()}

    def load_policy_state(self, state):
        names = self.model.policy.state_dict()
        self.model.policy.load_state_dict({name: torch.tensor(state[name]) for name in names})
        self.model.log_ent_coef.data = torch.tensor(state["log_ent_coef"])
        for name in MOMENTS:
            setattr(self.moments, name, np.array(state[f"moments.{name}"])[()])

    def optimized(self):
        model = self.model
        for part, optimizer in enumerate((model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer)):
            for i, parameter in enumerate(optimizer.param_groups[0]["params"]):
                yield f"{part}.{i}", optimizer, parameter

    def state(self):
        buffer = self.model.replay_buffer
        state = {f"buffer.{name}": getattr(buffer, name) for name in BUFFER}  # only an update changes these
        for name, optimizer, parameter in self.optimized():
            empty = dict(zip(ADAM, (torch.zeros(()), *[torch.zeros_like(parameter)] * 2), strict=True))
            slots = empty | optimizer.state.get(parameter, {})
            state |= {f"{name}.{slot}": slots[slot].detach().numpy().copy() for slot in ADAM}
        return {**state, "buffer.position": np.array([buffer.pos, buffer.full])}

    def load_state(self, state, *, new_episodes):
        buffer = self.model.replay_buffer
        for name in BUFFER:
            getattr(buffer, name)[:] = state[f"buffer.{name}"]
        buffer.pos, buffer.full = int(state["buffer.position"][0]), bool(state["buffer.position"][1])
        for name, optimizer, parameter in self.optimized():
            optimizer.state[parameter] = {slot: torch.tensor(state[f"{name}.{slot}"]) for slot in ADAM}


class SACKind(LearnerKind):
    name, summary, Parameters = "sac", "Soft actor-critic of stable-baselines3.", SACSettings
    metrics = (
        Metric("sac_actor_loss", "Actor loss", "", "Loss of the actor, mean of the gradient steps.", 3),
        Metric("sac_critic_loss", "Critic loss", "", "Loss of the critics, mean of the gradient steps.", 3),
    )
    charts = (Chart("Losses of actor and critics", ("sac_actor_loss", "sac_critic_loss")),)

    def open(self, spec, environment):
        return SACLearner(spec, environment)

    def load_policy(self, state, settings, *, observations, actions):
        sizes, layers = (len(observations), settings.units, settings.units, len(actions)), []
        for i, name in enumerate(("actor.latent_pi.0", "actor.latent_pi.2", "actor.mu")):
            weights = take(state, f"{name}.weight", (sizes[i + 1], sizes[i]), np.float32)
            layers.append((weights, take(state, f"{name}.bias", (sizes[i + 1],), np.float32)))
        mean, variance = (take(state, f"moments.{name}", sizes[:1], np.float64) for name in MOMENTS[:2])
        scale = 1.0 / np.sqrt(variance + 1e-8)
        return NetworkPolicy(mean, scale, CLIP, tuple(layers), activation="relu", squashed=True)


SAC = SACKind()
