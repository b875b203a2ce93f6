"""Fit a policy to a robot with other joints than the one it was trained with."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from naosprint.arrays import AnyArray, FloatArray

_SEEN_BY = ("mlp_extractor.policy_net.0.weight", "mlp_extractor.value_net.0.weight")


def refit(
    policy: Mapping[str, AnyArray],
    *,
    observations: tuple[Sequence[str], Sequence[str]],
    actions: tuple[Sequence[str], Sequence[str]],
    rest: FloatArray,
) -> dict[str, AnyArray]:
    """Rearrange a policy's arrays by the names of what it sees and moves.

    Joints that only the new robot has are not looked at yet, and held at angle 0 with the mean of the other joints'
    spread; their angles and rates are standardised as those of the other joints on average. What only the old robot
    has is left out. With the same names on both sides nothing changes.

    Args:
        policy: weights and observation statistics by name, as in a checkpoint.
        observations: the names of the observations, of the old robot and of the new one.
        actions: the same of the actions, which are joints.
        rest: (A,) actions of the new robot that hold its joints at angle 0.

    Returns:
        Arrays by the same names, for the new robot.
    """
    seen, unseen = _places(*observations)
    moved, still = _places(*actions)
    fitted = dict(policy)
    for name in _SEEN_BY:
        fitted[name] = np.where(unseen, np.float32(0.0), policy[name][:, seen])
    fitted["action_net.weight"] = np.where(still[:, None], np.float32(0.0), policy["action_net.weight"][moved])
    fitted["action_net.bias"] = np.where(still, rest, policy["action_net.bias"][moved]).astype(np.float32)
    fitted["log_std"] = np.where(still, policy["log_std"].mean(), policy["log_std"][moved]).astype(np.float32)
    variance = policy["observation_variance"]
    fitted["observation_mean"] = np.where(unseen, 0.0, policy["observation_mean"][seen])
    joints = [[f"{name}{kind}" for name in actions[0]] for kind in ("", "_rate")]
    angle, rate = (variance[_places(observations[0], names)[0]].mean() for names in joints)
    guess = [rate if name.endswith("_rate") else angle for name in observations[1]]
    fitted["observation_variance"] = np.where(unseen, guess, variance[seen])
    return fitted


def _places(old: Sequence[str], new: Sequence[str]) -> tuple[AnyArray, AnyArray]:
    """Return where each new name is among the old ones, 0 if nowhere, and which are nowhere."""
    place = {name: i for i, name in enumerate(old)}
    return (
        np.array([place.get(name, 0) for name in new], dtype=np.int64),
        np.array([name not in place for name in new], dtype=np.bool_),
    )
