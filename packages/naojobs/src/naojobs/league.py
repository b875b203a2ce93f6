"""League: ratings of teams over all their games."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from sqlalchemy import select

from naojobs.database import Sessions
from naojobs.models import Match, MatchGame
from naojobs.teams import MatchSpec

_MIDDLE, _SCALE = 1500.0, 400.0 / math.log(10.0)
"""Rating of an average team, and Elo points in which the odds change by a factor of e."""
_SWEEPS, _PRECISION = 2_000, 1e-7
"""Most sweeps of the fit, and the largest change of a strength at its end."""


@dataclass(slots=True)
class Standing:
    """Place of a team in the league."""

    name: str
    identity: str
    rating: float = _MIDDLE
    wins: int = 0
    draws: int = 0
    losses: int = 0
    goals: list[int] = field(default_factory=lambda: [0, 0])
    """Its own goals and those against it."""


def standings(games: Iterable[tuple[MatchSpec, Sequence[int]]]) -> list[Standing]:
    """Return the teams of some games, the highest rating first. The order of the games does not matter."""
    table: dict[str, Standing] = {}
    rivals: dict[str, dict[str, int]] = {}
    for spec, goals in games:
        pair = tuple(team.identity for team in spec.teams)
        if pair[0] == pair[1]:
            continue  # a team against itself says nothing
        for team, other, (own, against) in zip(spec.teams, pair[::-1], (goals, goals[::-1]), strict=True):
            row = table.setdefault(team.identity, Standing(team.name, team.identity))
            row.name = min(row.name, team.name)
            row.wins += own > against
            row.draws += own == against
            row.losses += own < against
            row.goals = [row.goals[0] + own, row.goals[1] + against]
            count = rivals.setdefault(team.identity, {})
            count[other] = count.get(other, 0) + 1
    scores = {identity: row.wins + 0.5 * row.draws for identity, row in table.items()}
    for identity, strength in strengths(scores, rivals).items():
        table[identity].rating = _MIDDLE + _SCALE * strength
    return sorted(table.values(), key=lambda team: (-team.rating, team.identity))


def strengths(scores: Mapping[str, float], rivals: Mapping[str, Mapping[str, int]]) -> dict[str, float]:
    """Return the strengths that make the results of all games most probable. Bradley and Terry (1952).

    A team of strength s wins against one of strength t with probability 1 / (1 + exp(t - s)); a draw is half a win. To
    keep the strength of a team finite that has won all its games, each has one more, a draw against strength 0. The
    logarithm of the probability is concave; each sweep improves one strength after the other by a step of Newton's
    method::

        p_j = 1 / (1 + exp(t_j - s))                                       chance against each opponent, the draw's too
        s += (score - sum of n_j p_j) / (sum of n_j p_j (1 - p_j))         by at most 1

    Args:
        scores: by team, its wins and half of its draws.
        rivals: by team, its games against each other team.
    """
    found = dict.fromkeys(sorted(scores), 0.0)
    for _ in range(_SWEEPS):
        largest = 0.0
        for team, strength in found.items():
            chance = 1.0 / (1.0 + math.exp(-strength))
            surplus, slope = scores[team] + 0.5 - chance, chance * (1.0 - chance)
            for other, count in sorted(rivals[team].items()):
                chance = 1.0 / (1.0 + math.exp(found[other] - strength))
                surplus -= count * chance
                slope += count * chance * (1.0 - chance)
            change = max(-1.0, min(1.0, surplus / slope))
            found[team] = strength + change
            largest = max(largest, abs(change))
        if largest < _PRECISION:
            break
    return found


def league(sessions: Sessions, owner: str | None) -> list[Standing]:
    """Return the standings over all games of an owner's matches; none for those of all owners."""
    rows = select(Match.spec, MatchGame.goals).join(MatchGame, MatchGame.match_id == Match.id)
    if owner is not None:
        rows = rows.where(Match.owner == owner)
    with sessions() as session:
        found = session.execute(rows).all()
    return standings((MatchSpec.model_validate(spec), goals) for spec, goals in found)
