"""Matches: their submission, and what workers record of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any

from naospec.teams import ROBOT
from sqlalchemy import func, select, update

from naojobs.capabilities import MATCH_QUEUE, MATCH_VERSION, Requirements, match_task
from naojobs.changes import add_event, add_line
from naojobs.database import Sessions, notify
from naojobs.idempotency import earlier, hold_names
from naojobs.ids import new_id
from naojobs.leases import Lease, held_by, hold_as, lost
from naojobs.models import Match, MatchEvent, MatchGame
from naojobs.quotas import NO_LIMITS, SPACE, Limits, Quota, require_room, wait_for_turn
from naojobs.states import WorkState
from naojobs.store import StoreManifest
from naojobs.submission import digest_of
from naojobs.teams import Film, MatchSpec, find_team

MAX_GAMES = 1000


@dataclass(frozen=True, slots=True)
class MatchRequest:
    """Match to play."""

    teams: tuple[str, str]
    games: int
    players: int
    half_s: float
    gate: bool = False
    film: Film = "goals"
    tags: Sequence[str] = ()
    priority: int = 5
    not_before: datetime | None = None
    max_attempts: int = 3

    def digest(self) -> str:
        """Return the SHA-256 that equal requests share."""
        return digest_of(self)


def submit_match(
    sessions: Sessions,
    request: MatchRequest,
    *,
    owner: str,
    idempotency_key: str | None = None,
    limits: Limits = NO_LIMITS,
) -> tuple[Match, bool]:
    """Queue a match; return it and whether it is new: the same key with the same request returns the existing one.

    Raises:
        ConflictError: the key was used for another request.
        InvalidError: there is no such team or policy.
        QuotaError: ``owner`` has as many open jobs and matches, or jobs and matches, as ``limits`` allow.
    """
    digest = request.digest() if idempotency_key is not None else None
    with sessions.begin() as session:
        quotas = (Quota.OPEN_JOBS, Quota.JOBS, *SPACE)
        wait_for_turn(session, owner, limits, *quotas)
        hold_names(session, owner)
        if (made := earlier(session, Match, Match.owner == owner, idempotency_key, digest)) is not None:
            return made, False
        require_room(session, owner, limits, *quotas)
        first, second = (find_team(session, owner, text, f"teams.{i}") for i, text in enumerate(request.teams))
        spec = MatchSpec(
            teams=(first, second),
            games=request.games,
            players=request.players,
            half_s=request.half_s,
            gate=request.gate,
            film=request.film,
        )
        task = match_task(
            confined=any(team.team_id is not None and team.image is None for team in spec.teams),
            contained=any(team.image is not None for team in spec.teams),
        )
        match = Match(
            id=new_id("match"),
            owner=owner,
            spec=spec.model_dump(mode="json"),
            **asdict(Requirements(task, MATCH_VERSION, ROBOT, MATCH_QUEUE, "")),
            tags=list(dict.fromkeys(request.tags)),
            priority=request.priority,
            not_before=request.not_before,
            max_attempts=request.max_attempts,
            state=WorkState.QUEUED,
            queued_at=func.now(),
            idempotency_key=idempotency_key,
            idempotency_digest=digest,
        )
        session.add(match)
        session.flush()
        add_event(session, match, "queued", "submitted")
        session.flush()
        session.refresh(match)
    return match, True


@dataclass(frozen=True, slots=True)
class StoredGame:
    """Game that is over, with its log in the store."""

    number: int
    goals: tuple[int, int]
    lost: Sequence[Mapping[str, Any]]
    key: str
    manifest: StoreManifest


def record_game(
    sessions: Sessions,
    lease: Lease,
    game: StoredGame,
    summary: Mapping[str, Any],
    lines: Iterable[tuple[str, str]] = (),
) -> None:
    """Write a game of a leased match, the results of all games so far and `lines` of the match's log; once.

    Raises LeaseLostError.
    """
    with sessions.begin() as session:
        match = hold_as(session, lease, Match)
        match.summary, match.live = dict(summary), None
        match.failures = match.postponed = 0  # the attempts so far have made progress
        match.updated_at = func.now()
        if session.get(MatchGame, (match.id, game.number)) is None:
            row = {"goals": list(game.goals), "lost": [dict(each) for each in game.lost]}
            manifest = game.manifest.model_dump(mode="json")
            session.add(MatchGame(match_id=match.id, number=game.number, key=game.key, manifest=manifest, **row))
            match.size += game.manifest.size
            for level, text in lines:
                add_line(session, match, level, text)
        notify(session, match.id)


def append_lines(sessions: Sessions, lease: Lease, lines: Iterable[tuple[str, str]]) -> None:
    """Add lines to the log of a leased match, each with its level. Raises LeaseLostError."""
    with sessions.begin() as session:
        match = hold_as(session, lease, Match)
        for level, text in lines:
            add_line(session, match, level, text)
        notify(session, match.id)


def events_of(sessions: Sessions, match_id: str, *, limit: int, after: int | None) -> list[MatchEvent]:
    """Return up to `limit` events and lines of a match's log after the one with the id `after`, oldest first."""
    wanted = select(MatchEvent).where(MatchEvent.match_id == match_id).order_by(MatchEvent.id).limit(limit)
    if after is not None:
        wanted = wanted.where(MatchEvent.id > after)
    with sessions() as session:
        return list(session.scalars(wanted))


def record_moment(sessions: Sessions, lease: Lease, moment: Mapping[str, Any]) -> None:
    """Write where robots and ball of a running game are. Raises LeaseLostError."""
    with sessions.begin() as session:
        seen = update(Match).where(held_by(lease)).values(live=dict(moment)).returning(Match.id)
        if session.scalar(seen) is None:
            raise lost(lease)


def games_of(sessions: Sessions, match_id: str) -> list[MatchGame]:
    """Return the games of a match that are over, by number."""
    with sessions() as session:
        return list(session.scalars(select(MatchGame).where(MatchGame.match_id == match_id).order_by(MatchGame.number)))
