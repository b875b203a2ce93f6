"""Adaptation of a policy to a robot with other joints, a task with other observations, or wider networks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from naosprint.rl.normalization import CRITIC, GUESSED_SAMPLES, NO_SAMPLES, STATISTICS
from naosprint.tasks.observations import PAST

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from naosprint.arrays import AnyArray, FloatArray, IntArray

_CRITIC = tuple(CRITIC + name for name in STATISTICS)
_FIRST_LAYERS = ("mlp_extractor.policy_net.0.weight", "mlp_extractor.value_net.0.weight")


def adapt(
    policy: Mapping[str, AnyArray],
    *,
    observations: tuple[Sequence[str], Sequence[str]],
    actions: tuple[Sequence[str], Sequence[str]],
    rest: FloatArray,
    spreads: Mapping[str, float] | None = None,
) -> dict[str, AnyArray]:
    """Rearrange a policy's arrays by the names of its observations and actions.

    Observations that only the new training has get weight 0 at first; joints that only it has are held at angle 0 and
    explored with the mean of the other joints' standard deviations. New joint angles and rates are standardized as
    those of the other joints on average, earlier observations as the latest ones, other new observations by the given
    spreads or as what has not been observed yet. Such a guess weighs as much as a few samples, whereas the other
    statistics keep their numbers of samples. What only the old training has is left out. With the same names on both
    sides nothing changes.

    Args:
        policy: weights and observation statistics by name, with the number of samples of each.
        observations: names of the observations, of the old training and of the new one.
        actions: the same for the actions, which are joints.
        rest: (A,) actions of the new robot that hold its joints at angle 0.
        spreads: typical standard deviations of new observations by name.

    Returns:
        Arrays by the same names, for the new training.
    """
    seen, unseen = _indices(*observations)
    moved, still = _indices(*actions)
    fitted = dict(policy)
    for name in _FIRST_LAYERS:
        critic = policy[name][:, len(observations[0]) :]  # what only a critic observes stays as it is
        fitted[name] = np.append(np.where(unseen, np.float32(0.0), policy[name][:, seen]), critic, axis=1)
    fitted["action_net.weight"] = np.where(still[:, None], np.float32(0.0), policy["action_net.weight"][moved])
    fitted["action_net.bias"] = np.where(still, rest, policy["action_net.bias"][moved]).astype(np.float32)
    fitted["log_std"] = np.where(still, policy["log_std"].mean(), policy["log_std"][moved]).astype(np.float32)
    mean, variance, counts = (policy[name] for name in STATISTICS)
    guesses: dict[str, float] = {}
    for suffix in ("", "_rate"):
        known = [name + suffix for name in actions[0] if name + suffix in observations[0]]
        if known:
            typical = variance[_indices(observations[0], known)[0]].mean()
            guesses |= {name + suffix: typical for name in actions[1]}
    guesses |= {name: spread * spread for name, spread in (spreads or {}).items()}
    # what is remembered is spread like what is observed now
    present = [name.rsplit(PAST, 1)[0] for name in observations[1]]
    latest, unknown = _indices(observations[0], present)
    guess = np.array([guesses.get(name, 1.0) for name in present])
    guessed = np.where(unknown, [name in guesses for name in present], True)
    fitted["observation_mean"] = np.where(unknown, 0.0, mean[latest])
    fitted["observation_variance"] = np.where(unknown, guess, variance[latest])
    fitted["observation_counts"] = np.where(unseen, np.where(guessed, GUESSED_SAMPLES, NO_SAMPLES), counts[seen])
    return fitted


def with_critic(
    policy: Mapping[str, AnyArray], seen: int, names: tuple[Sequence[str], Sequence[str]]
) -> Mapping[str, AnyArray]:
    """Rearrange a policy's arrays by the names of what only its critic observes, besides the policy's ``seen``.

    New ones get weight 0 at first, and statistics without a sample. So do all of a checkpoint without their names. What
    this critic does not observe is left out.

    Args:
        policy: weights and observation statistics by name, as in a checkpoint.
        seen: number of the policy's own observations.
        names: names of what only a critic observes, of the old training and of the new one.
    """
    means, weights = policy.get(_CRITIC[0], np.zeros(0)), policy.get(_FIRST_LAYERS[1], np.zeros(0))
    named = len(names[0]) == len(means)
    before = names[0] if named else ()
    if (named and tuple(before) == tuple(names[1])) or weights.ndim != 2:
        return policy
    known, new = _indices(before, names[1])
    fitted = {name: array for name, array in policy.items() if name not in _CRITIC}
    # one more column, so that there is one to choose for new names
    old = np.append(weights[:, seen:], np.zeros((len(weights), 1), np.float32), axis=1)
    own = np.where(new, np.float32(0.0), old[:, known])
    fitted[_FIRST_LAYERS[1]] = np.append(weights[:, :seen], own, axis=1)
    if len(names[1]):
        for name, blank in zip(_CRITIC, (0.0, 1.0, NO_SAMPLES), strict=True):
            fitted[name] = np.where(new, blank, np.append(policy.get(name, ()), blank)[known])
    return fitted


def widen(policy: Mapping[str, AnyArray], wider: Mapping[str, AnyArray]) -> Mapping[str, AnyArray]:
    """Embed a policy's networks in those of a wider policy without a change of what they compute.

    Added units keep the wider policy's weights, and what follows gives them weight 0 at first (after Chen, Goodfellow
    and Shlens, "Net2Net: Accelerating Learning via Knowledge Transfer", 2016). Pairs of mirrored units stay pairs.
    Arrays that do not fit stay as they are, for who checks them.

    Args:
        policy: weights by name, for as many layers and the same inputs and outputs.
        wider: weights of a new policy, with at least as many units in each layer.
    """
    fitted = dict(policy)
    for net in ("policy", "value"):
        hidden = [name.removesuffix(".weight") for name in wider if name.startswith(f"mlp_extractor.{net}_net.")]
        head = "action_net" if net == "policy" else "value_net"
        columns: IntArray | None = None
        for layer in (*(name for name in hidden if not name.endswith(".bias")), head):
            weight, bias = f"{layer}.weight", f"{layer}.bias"
            old, new = policy.get(weight, np.zeros(0)), wider[weight]
            columns = np.arange(new.shape[1]) if columns is None else columns
            fits = old.ndim == 2 and old.shape[1] == len(columns) and len(old) <= len(new)
            if not fits or policy.get(bias, np.zeros(0)).shape != (len(old),):
                return policy
            rows = _places(len(old), len(new))
            fitted[weight], fitted[bias] = new.copy(), wider[bias].copy()
            fitted[weight][rows], fitted[bias][rows] = np.float32(0.0), policy[bias]
            fitted[weight][np.ix_(rows, columns)] = old
            columns = rows
    return fitted


def _places(old: int, new: int) -> IntArray:
    """Return where the units of a layer are in a wider one: each half in a half, since they mirror each other."""
    half = old if old % 2 or new % 2 else old // 2
    return np.append(np.arange(half, dtype=np.int64), new // 2 + np.arange(old - half, dtype=np.int64))


def _indices(old: Sequence[str], new: Sequence[str]) -> tuple[AnyArray, AnyArray]:
    """Return the index of each new name among the old ones, 0 for new ones, and which are new."""
    index = {name: i for i, name in enumerate(old)}
    return (
        np.array([index.get(name, 0) for name in new], dtype=np.int64),
        np.array([name not in index for name in new], dtype=np.bool_),
    )
