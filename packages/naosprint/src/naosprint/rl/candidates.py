"""Candidates of a stage: policies that are trained one after the other, of which the best one continues."""

from __future__ import annotations

from math import inf, isfinite
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from naosprint.arrays import AnyArray


def reward_per_step(means: Mapping[str, float]) -> float:
    """Return what candidates are compared by: the mean reward per step of the latest episodes.

    The reward of whole episodes would favour slow robots in tasks that end at a finish line.
    """
    return means["reward"] / means["episode_length"]


class Candidates:
    """What the remaining candidates of a stage need from those before them.

    Attributes:
        start: policy that each starts from, as in a checkpoint; None: random weights.
        rewards: mean reward per step of each trained candidate.
        best: policy of the best of these.
    """

    def __init__(self) -> None:
        self.start: Mapping[str, AnyArray] | None = None
        self.best: Mapping[str, AnyArray] | None = None
        self.rewards: list[float] = []

    def add(self, means: Mapping[str, float], policy: Mapping[str, AnyArray]) -> None:
        """Add a trained candidate.

        Args:
            means: its live metrics.
            policy: its policy.
        """
        reward = reward_per_step(means) if means else -inf
        if not isfinite(reward):
            reward = -inf
        if self.best is None or reward > max(self.rewards):
            self.best = policy
        self.rewards.append(reward)

    def state(self) -> dict[str, AnyArray]:
        """Return the attributes as arrays."""
        state: dict[str, AnyArray] = {"rewards": np.array(self.rewards, dtype=np.float64)}
        for part, policy in (("start", self.start), ("best", self.best)):
            state.update({f"{part}.{name}": value for name, value in (policy or {}).items()})
        return state

    def load_state(self, state: Mapping[str, AnyArray]) -> None:
        """Restore what :meth:`state` returned."""
        self.rewards = np.asarray(state["rewards"]).tolist()
        self.start, self.best = (
            {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)} or None
            for prefix in ("start.", "best.")
        )
