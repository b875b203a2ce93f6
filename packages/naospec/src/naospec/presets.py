"""The settings that a preset stands for."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

PresetName = Literal["fast", "paper", "custom"]

# Table II of the paper, and what the code it names (PPO of OpenAI Baselines over MPI) does where the table is silent:
# 19 actors, gradients averaged over 64 samples of each, advantages standardised over the whole rollout, no gradient
# clipping, Adam epsilon 1e-5, hidden weights with columns of unit norm, log-std 0, rewards of 100 per metre.
_PAPER: dict[str, Any] = {
    "n_envs": 19,
    "n_steps": 4096,
    "batch_size": 1216,
    "n_epochs": 10,
    "learning_rate": 1e-4,
    "learning_rate_schedule": "constant",
    "clip_range": 0.1,
    "target_kl": None,
    "target_kl_final": None,
    "gamma": 0.99,
    "final_gamma": None,
    "gamma_steps": 0,
    "gae_lambda": 0.95,
    "entropy_coefficient": 0.0,
    "value_coefficient": 1.0,
    "max_grad_norm": None,
    "adam_epsilon": 1e-5,
    "advantage_normalisation": "rollout",
    "hidden_sizes": (64, 64),
    "weight_initialisation": "unit_norm",
    "symmetric_policy": False,
    "initial_log_std": 0.0,
    "final_log_std": None,
    "log_std_steps": None,
    "policy_averaging": 0.0,
    "normalise_observations": True,
    "observation_clip": 5.0,
    "normalise_rewards": False,
    "bootstrap_at_end": False,
    "reward_scale": 100.0,
    "drift_penalty": 0.0,
    "fall_penalty_m": 0.0,
    "start_practice": 0.0,
}

# Found by experiment, see benchmarks/learning: a symmetric network twice as wide as the paper's, small and frequent
# updates whose size the learning rate is adapted to and whose jitter is averaged out, little exploration noise that
# falls slowly and does not die out, a finish line that is no end, a price for drift, a quarter of the robots that do
# nothing but start, because starts are where robots fall, and a long horizon until they no longer do.
_FAST: dict[str, Any] = {
    "n_envs": 128,
    "n_steps": 64,
    "batch_size": 2048,
    "n_epochs": 5,
    "learning_rate": 5e-4,
    "learning_rate_schedule": "adaptive",
    "clip_range": 0.2,
    "target_kl": 0.03,
    "target_kl_final": None,
    "gamma": 0.995,
    "final_gamma": 0.99,
    "gamma_steps": 10_000_000,
    "gae_lambda": 0.95,
    "entropy_coefficient": 0.0,
    "value_coefficient": 0.5,
    "max_grad_norm": 0.5,
    "adam_epsilon": 1e-5,
    "advantage_normalisation": "minibatch",
    "hidden_sizes": (128, 128),
    "weight_initialisation": "orthogonal",
    "symmetric_policy": True,
    "initial_log_std": -1.6,
    "final_log_std": -2.0,
    "log_std_steps": 50_000_000,
    "policy_averaging": 0.98,
    "normalise_observations": True,
    "observation_clip": 10.0,
    "normalise_rewards": True,
    "bootstrap_at_end": True,
    "reward_scale": 100.0,
    "drift_penalty": 1.0,
    "fall_penalty_m": 0.0,
    "start_practice": 0.25,
}

PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "fast": MappingProxyType(_FAST),
        "paper": MappingProxyType(_PAPER),
        "custom": MappingProxyType(_FAST),
    }
)
"""Learning settings by preset. ``custom`` starts from those of ``fast`` and promises nothing."""

PRESET_SUMMARIES: Mapping[str, str] = MappingProxyType(
    {
        "fast": "What learns best per hour on two processor cores.",
        "paper": "Table II of the paper: 19 actors, 4096 steps each, clip 0.1, learning rate 1e-4.",
        "custom": "Your own settings, starting from those of preset fast.",
    }
)
"""One line for people per preset."""
