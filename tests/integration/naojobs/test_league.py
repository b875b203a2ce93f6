"""The league over the games of a real Postgres: what is counted, and when it is counted again."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
from naojobs import league, matches, outcomes, requests
from naojobs.league import League, Results, Standing
from naojobs.leases import Lease
from naojobs.matches import MatchRequest, StoredGame
from naojobs.models import Match, MatchGame
from naojobs.states import WorkState
from naojobs.store import ManifestEntry, StoreManifest
from naospec.teams import SKILLS
from sqlalchemy import select, text
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work

Sessions = sessionmaker[Session]

TEAMS = ("example", "example:walk=t1-run-robust", "example:getup=t1-getup")


def store(sessions: Sessions, lease: Lease, number: int, *goals: int) -> None:
    """Store a game of a match."""
    log = ManifestEntry(name="game.npz", size=1_000, sha256="0" * 64)
    game = StoredGame(number, (goals[0], goals[1]), [], f"{lease.id}/{number}", StoreManifest(files=(log,)))
    matches.record_game(sessions, lease, game, {"games": number})


def play(sessions: Sessions, owner: str, teams: tuple[str, ...], *scores: tuple[int, int]) -> Lease:
    """Submit a match and store the first of its games; return the worker's lease."""
    request = MatchRequest(teams=(teams[0], teams[1]), games=10, players=1, half_s=1.0)
    claim = claim_work(sessions, Match, matches.submit_match(sessions, request, owner=owner)[0].id, "worker")
    assert claim is not None
    for number, goals in enumerate(scores, start=1):
        store(sessions, claim.lease, number, *goals)
    return claim.lease


def one_by_one(sessions: Sessions, owner: str | None) -> list[Standing]:
    """Return the standings over games that are read one by one."""
    found = []
    with sessions() as session:
        rows = select(Match.owner, Match.spec, MatchGame.goals).join(MatchGame, MatchGame.match_id == Match.id)
        for whose, spec, (own, against) in session.execute(rows):
            if owner in (None, whose):
                first, second = spec["teams"]
                sides = (str(first["policies"]), str(second["policies"])), (first["name"], second["name"])
                found.append(Results(*sides, own > against, own == against, own < against, (own, against)))
    return league.standings(found)


def test_games_are_counted_by_pair_of_teams_and_by_owner(sessions: Sessions) -> None:
    chance = random.Random(1)
    for number in range(12):
        teams = (chance.choice(TEAMS), chance.choice(TEAMS))
        scores = [(chance.randrange(4), chance.randrange(4)) for _ in range(chance.randrange(5))]
        play(sessions, ("alice", "bob")[number % 2], teams, *scores)
    table = League(sessions)
    for owner in (None, "alice", "bob"):
        found = [replace(row, identity="") for row in table.standings(owner)]
        assert found == [replace(row, identity="") for row in one_by_one(sessions, owner)]
    assert table.standings("alice") != table.standings("bob")
    assert table.standings("nobody") == []


def test_an_example_of_other_default_policies_is_another_team(
    sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Games of an earlier version, which had another walker, do not count for today's, and name their own."""
    with monkeypatch.context() as earlier:
        earlier.setitem(SKILLS, "walk", ("velocity", "t1-run"))
        play(sessions, "erin", ("example", "example:walk=t1-run-robust"), (0, 1))
    play(sessions, "erin", ("example", "example:walk=t1-run-robust"), (2, 0), (3, 0))
    found = {team.name: (team.wins, team.losses) for team in League(sessions).standings("erin")}
    assert found == {"example": (2, 0), "example:walk=t1-run": (0, 1), "example:walk=t1-run-robust": (1, 2)}


def test_games_are_counted_again_only_when_one_was_stored_or_deleted(
    sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one that was stored after the database's clock was set back."""
    counted: list[str | None] = []
    results = league._results

    def seen(session: Session, owner: str | None) -> list[Results]:
        counted.append(owner)
        return results(session, owner)

    monkeypatch.setattr(league, "_results", seen)
    table = League(sessions)
    leases = {owner: play(sessions, owner, TEAMS, (1, 0)) for owner in ("carol", "dave")}

    def ask() -> tuple[list[list[int]], list[str | None]]:
        """Return the wins of the owners' teams, and the owners whose games were counted."""
        counted.clear()
        shown = [table.standings(owner) for owner in leases for _ in range(2)]
        assert shown[::2] == shown[1::2]
        return [[row.wins for row in rows] for rows in shown[::2]], counted.copy()

    assert ask() == ([[1, 0], [1, 0]], ["carol", "dave"])
    assert ask() == ([[1, 0], [1, 0]], [])
    play(sessions, "carol", TEAMS[1:], (2, 0), (3, 1))
    assert ask() == ([[1, 2, 0], [1, 0]], ["carol"])
    play(sessions, "dave", TEAMS)
    with sessions.begin() as session:
        session.execute(text("UPDATE matches SET updated_at = updated_at + interval '1 day' WHERE owner = 'dave'"))
    assert ask() == ([[1, 2, 0], [1, 0]], ["dave"])
    store(sessions, leases["dave"], 2, 3, 2)
    assert ask() == ([[1, 2, 0], [2, 0]], ["dave"])
    outcomes.transition(sessions, leases["carol"], WorkState.CANCELLED)
    requests.delete_match(sessions, leases["carol"].id)
    assert ask() == ([[2, 0], [2, 0]], ["carol"])


def test_standings_are_kept_of_some_owners_only(sessions: Sessions, monkeypatch: pytest.MonkeyPatch) -> None:
    """A token of an administrator may ask for any name."""
    monkeypatch.setattr(league, "_MOST_KEPT", 3)
    table = League(sessions)
    for owner in ("a", "b", "c", "a", "d"):
        table.standings(owner)
    assert list(table._kept) == ["c", "a", "d"]
