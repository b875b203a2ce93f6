"""What each column of a training's metrics means."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

from naosprint.episodes import WINDOW

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class Column:
    """Describe one column of the rows that :meth:`naosprint.reporter.Reporter.metrics` takes."""

    unit: str
    """Unit; empty for a number without one."""
    meaning: str
    """One sentence for people."""


_OVER_EPISODES = f"mean of the last {WINDOW} episodes; missing before the first one is over"

COLUMNS: Mapping[str, Column] = MappingProxyType(
    {
        "step": Column("steps", "Environment steps since the start of the job."),
        "time_s": Column("s", "Time spent training, over all attempts."),
        "episodes": Column("", "Episodes finished since the start of the job."),
        "reward": Column("", f"Sum of an episode's rewards, {_OVER_EPISODES}."),
        "distance_m": Column("m", f"How far forward the robot came, {_OVER_EPISODES}."),
        "episode_length": Column("steps", f"Length of an episode, {_OVER_EPISODES}."),
        "fall_rate": Column("", f"Share of episodes that ended by a fall, {_OVER_EPISODES}."),
        "speed_mps": Column("m/s", f"Distance by duration of an episode, {_OVER_EPISODES}."),
        "policy_loss": Column("", "PPO's clipped objective, negated, mean of the update's minibatches."),
        "value_loss": Column("", "Squared error of the critic, mean of the update's minibatches."),
        "approx_kl": Column("nat", "Estimated KL divergence of the last epoch's policy from the one that collected."),
        "clip_fraction": Column("", "Share of samples whose probability ratio was clipped."),
        "explained_variance": Column("", "Share of the returns' variance that the critic predicted."),
        "action_std": Column("", "Standard deviation of the exploration noise, mean of all joints."),
        "entropy": Column("nat", "Entropy of the policy's action distribution."),
        "learning_rate": Column("", "Adam's step size in this update."),
        "steps_per_s": Column("1/s", "Environment steps a second in this update, learning included."),
        "collect_s": Column("s", "Time that collecting the rollout took."),
        "learn_s": Column("s", "Time that updating the policy took."),
        "eta_s": Column("s", "Time that the rest of the training is going to take, at the mean speed of this attempt."),
        "server_failures": Column("", "Servers that failed and were replaced; `simulator: rcssserver3d` only."),
    }
)
"""Every column by name, in the order of a row."""
