"""League: ratings of teams over all their games."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from naojobs.database import Sessions
from naojobs.models import Match, MatchGame
from naojobs.teams import present_name

_MIDDLE, _SCALE = 1500.0, 400.0 / math.log(10.0)
"""Rating of an average team, and Elo points in which the odds change by a factor of e."""
_SWEEPS, _PRECISION = 2_000, 1e-7
"""Most sweeps of the fit, and the largest change of a strength at its end."""
_MOST_KEPT = 100
"""Owners whose standings are kept."""


@dataclass(frozen=True, slots=True)
class Results:
    """Results of all games of one team against another; without a comment, of the first of them."""

    identities: tuple[str, str]
    """What equal teams share, also of several owners: the id of an uploaded team, or policies by skill."""
    names: tuple[str, str]
    wins: int
    draws: int
    losses: int
    goals: tuple[int, int]
    """Goals of both."""


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


def standings(results: Iterable[Results]) -> list[Standing]:
    """Return the teams of some games, the highest rating first. The order of the results does not matter."""
    table: dict[str, Standing] = {}
    rivals: dict[str, dict[str, int]] = {}
    for found in results:
        if found.identities[0] == found.identities[1]:
            continue  # a team against itself says nothing
        for side, (own, lost) in enumerate(((found.wins, found.losses), (found.losses, found.wins))):
            identity, other = found.identities[side], found.identities[1 - side]
            row = table.setdefault(identity, Standing(found.names[side], identity))
            row.name = min(row.name, found.names[side])
            row.wins += own
            row.draws += found.draws
            row.losses += lost
            row.goals = [row.goals[0] + found.goals[side], row.goals[1] + found.goals[1 - side]]
            count = rivals.setdefault(identity, {})
            count[other] = count.get(other, 0) + own + found.draws + lost
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
    teams = sorted(scores)
    place = {team: i for i, team in enumerate(teams)}
    found = [0.0] * len(teams)
    games = [(scores[team] + 0.5, [(place[other], n) for other, n in sorted(rivals[team].items())]) for team in teams]
    exp = math.exp  # a sweep over a thousand pairs is to take less than a millisecond
    for _ in range(_SWEEPS):
        largest = 0.0
        for i, (score, opponents) in enumerate(games):
            strength = found[i]
            chance = 1.0 / (1.0 + exp(-strength))
            surplus, slope = score - chance, chance * (1.0 - chance)
            for other, count in opponents:
                chance = 1.0 / (1.0 + exp(found[other] - strength))
                expected = count * chance
                surplus -= expected
                slope += expected * (1.0 - chance)
            change = max(-1.0, min(1.0, surplus / slope))
            found[i] = strength + change
            largest = max(largest, abs(change))
        if largest < _PRECISION:
            break
    return dict(zip(teams, found, strict=True))


class League:
    """Standings by owner, kept until a match of the owner has changed. One thread at a time may use it."""

    def __init__(self, sessions: Sessions) -> None:
        self._sessions = sessions
        self._kept: dict[str | None, tuple[object, list[Standing]]] = {}
        """State of the matches and the standings by owner, the latest used last."""

    def standings(self, owner: str | None) -> list[Standing]:
        """Return the standings over all games of an owner's matches; none for those of all owners."""
        seen, table = self._kept.pop(owner, (None, []))
        with self._sessions() as session:
            state = tuple(session.execute(_state(owner)).one())  # read first: a later game counts at the next call
            results = _results(session, owner) if state != seen else None
        if results is not None:
            table = standings(results)
        self._kept[owner] = state, table
        if len(self._kept) > _MOST_KEPT:
            del self._kept[next(iter(self._kept))]
        return table


def _state(owner: str | None) -> Select[int, str, datetime, int]:
    """Return the query of what changes with every game that is stored or deleted.

    A game is stored in the transaction that updates its match and adds the bytes of its log: a row for each match is
    read, not one for each game.
    """
    state = select(func.count(Match.id), func.max(Match.id), func.max(Match.updated_at), func.sum(Match.size))
    return state if owner is None else state.where(Match.owner == owner)


def _results(session: Session, owner: str | None) -> list[Results]:
    """Count the games of an owner's matches by pair of teams; none for those of all owners."""
    first, second = MatchGame.goals[1], MatchGame.goals[2]
    # By match first: a match has many games, and reading its specification takes longer than counting them.
    of_match = select(
        MatchGame.match_id,
        func.count().filter(first > second).label("wins"),
        func.count().filter(first == second).label("draws"),
        func.count().filter(first < second).label("losses"),
        func.sum(first).label("first_goals"),
        func.sum(second).label("second_goals"),
    ).group_by(MatchGame.match_id)
    if owner is not None:
        of_match = of_match.where(MatchGame.match_id.in_(select(Match.id).where(Match.owner == owner)))
    counted = of_match.subquery()
    teams = [Match.spec["teams"][i] for i in range(2)]
    fields = [
        *(func.coalesce(team["team_id"].astext, team["policies"].astext) for team in teams),
        *(team[name] for name in ("name", "policies") for team in teams),
    ]
    sums = [func.sum(counted.c[name]) for name in ("wins", "draws", "losses", "first_goals", "second_goals")]
    rows = (
        select(*(field.label(f"of_team_{i}") for i, field in enumerate(fields)), *sums)
        .join(counted, counted.c.match_id == Match.id)
        .group_by(*fields)
    )
    found = []
    for one, other, name, other_name, policies, others, *numbers in session.execute(rows):
        wins, draws, losses, goals, against = map(int, numbers)
        names = present_name(name, policies), present_name(other_name, others)
        found.append(Results((one, other), names, wins, draws, losses, (goals, against)))
    return found
