"""Population-based training: members train side by side; after each generation the worst continue from the best.

Every member of a generation is a trial, whose job starts from the policy of a trial of the generation before. The
choice is a function of the results of that generation, so any worker makes the same one, also after an interruption.

Source: Jaderberg et al. 2017, arXiv:1711.09846 (truncation selection, settings perturbed by a fifth).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from random import Random
from typing import Any

from naojobs.models import Trial, TrialState
from naospec.search import Choices, IntRange, Parameter, SearchSpec

REPLACED = 0.25
"""Part of a generation that continues from as many of the best."""
RESAMPLED = 0.25
"""Probability that a setting with named values gets another one, as each other setting does."""


@dataclass(frozen=True, slots=True)
class Start:
    """Beginning of a trial; without a parent it starts from nothing, with settings at random."""

    parent: Trial | None
    params: Mapping[str, Any]


def is_due(search: SearchSpec, trials: Mapping[int, Trial], number: int) -> bool:
    """Return whether trial `number` can start: the generation before its own has ended."""
    before = _generation_before(search, number)
    return all(other in trials and trials[other].state is not TrialState.RUNNING for other in before)


def start_of(search: SearchSpec, trials: Mapping[int, Trial], number: int) -> Start:
    """Return how trial `number` starts, which is due.

    A member continues from its own policy with its own settings. If it failed or is among the worst quarter, it
    continues from one of the best quarter, with that one's settings perturbed.
    """
    random = Random(int.from_bytes(hashlib.sha256(f"{search.seed}:{number}".encode()).digest()[:8], "big"))  # noqa: S311
    sign = 1.0 if search.objectives[0].direction == "maximize" else -1.0
    complete = sorted(
        (
            (sign * trial.values[0], -other, trial)
            for other in _generation_before(search, number)
            if (trial := trials[other]).state is TrialState.COMPLETE and trial.values and trial.job_id is not None
        ),
        reverse=True,
    )
    if not complete:
        return Start(None, {})
    count = max(1, round(REPLACED * search.population))
    own = next(
        (trial for _, _, trial in complete[: search.population - count] if trial.number == number - search.population),
        None,
    )
    if own is not None:
        return Start(own, own.params)
    parent = random.choice(complete[:count])[2]
    return Start(parent, {name: _perturbed(item, parent.params[name], random) for name, item in search.space.items()})


def _generation_before(search: SearchSpec, number: int) -> range:
    first = number // search.population * search.population
    return range(max(0, first - search.population), first)


def _perturbed(item: Parameter, value: Any, random: Random) -> Any:
    """Return a value near `value`, within its range."""
    if isinstance(item, Choices):
        return random.choice(item.choices) if random.random() < RESAMPLED else value
    direction = random.choice((-1, 1))
    moved = value * (1 + 0.2 * direction) if item.log else value + 0.1 * direction * (item.high - item.low)
    whole = isinstance(item, IntRange)
    if item.step is None and not whole:
        return min(max(moved, item.low), item.high)
    # of the numbers as they are written, so that no rounding moves a value off the grid
    low, high, step, before = (Fraction(str(number)) for number in (item.low, item.high, item.step or 1, value))
    steps = round((Fraction(moved) - low) / step)
    if steps == round((before - low) / step):  # the smallest change there is
        steps += direction
    result = low + step * min(max(steps, 0), (high - low) // step)
    return int(result) if whole else float(result)
