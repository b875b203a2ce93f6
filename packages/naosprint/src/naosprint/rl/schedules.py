"""Settings that change over a training, each a function of its steps."""

from __future__ import annotations

from typing import TYPE_CHECKING

from naosprint.rl.settings import PPOSettings

if TYPE_CHECKING:
    from naospec import TrainingSpec

RATE_FACTOR = 1.2
"""Factor by which the adaptive learning rate changes."""

RATE_RANGE = (1e-5, 1e-2)
"""Limits of the adaptive learning rate."""


def remaining(spec: TrainingSpec, steps: int) -> float:
    """Return the fraction of the training that is left, 1 to 0."""
    return 1.0 - float(steps) / float(spec.planned_steps)


def learning_rate(spec: TrainingSpec, steps: int) -> float:
    """Return the learning rate after a number of steps, before it is adapted."""
    settings = PPOSettings.of(spec.algorithm)
    rate = settings.learning_rate
    return rate * max(remaining(spec, steps), 0.0) if settings.learning_rate_schedule == "linear" else rate


def discount(spec: TrainingSpec, steps: int) -> float:
    """Return the discount factor after a number of steps."""
    settings = PPOSettings.of(spec.algorithm)
    if settings.final_gamma is None or steps < settings.gamma_steps:
        return settings.gamma
    return settings.final_gamma


def log_std(spec: TrainingSpec, steps: int) -> float:
    """Return the log-std of the actions after a number of steps, if it is not learned."""
    settings = PPOSettings.of(spec.algorithm)
    first = settings.initial_log_std
    final = first if settings.final_log_std is None else settings.final_log_std
    share = steps / (settings.log_std_steps or spec.planned_steps)
    return first + (final - first) * min(1.0, share)


def target_kl(spec: TrainingSpec, steps: int) -> float | None:
    """Return the target KL divergence after a number of steps; None if there is none."""
    settings = PPOSettings.of(spec.algorithm)
    first, final = settings.target_kl, settings.target_kl_final
    if first is None or final is None:
        return first
    return final + (first - final) * max(0.0, remaining(spec, steps))


def jumps(before: TrainingSpec, after: TrainingSpec, steps: int) -> list[str]:
    """Return in words which settings another total of steps changes at once, when a training is extended."""
    found = []
    for title, setting in (("learning rate", learning_rate), ("target KL", target_kl), ("log-std", log_std)):
        old, new = setting(before, steps), setting(after, steps)
        if old is not None and new is not None and old != new:
            found.append(f"{title} from {old:.3g} to {new:.3g}")
    return found


def adapted_factor(spec: TrainingSpec, factor: float, kl: float, target: float | None) -> float:
    """Return the learning rate's factor after an update with this KL divergence.

    It falls after an update that moved too far from the rollout's policy and rises after one that moved too little. The
    rule is that of RSL-RL (Rudin et al., "Learning to Walk in Minutes", 2022), once an update instead of once a
    minibatch.
    """
    if target is None:
        return factor
    if kl > 1.5 * target:
        factor /= RATE_FACTOR
    elif kl < target / 1.5:
        factor *= RATE_FACTOR
    rate = PPOSettings.of(spec.algorithm).learning_rate
    # a rate outside the range is where the user began, and is only approached from there
    return float(min(max(factor, min(RATE_RANGE[0] / rate, 1.0)), max(RATE_RANGE[1] / rate, 1.0)))
