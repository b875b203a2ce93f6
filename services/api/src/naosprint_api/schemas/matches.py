"""Matches, uploaded teams, and the league."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from naojobs.matches import MAX_GAMES, MatchRequest
from naojobs.teams import Film
from naospec.teams import MAX_HALF_S, MAX_PLAYERS
from pydantic import BaseModel, Field, StringConstraints

from naosprint_api.patterns import PLAIN
from naosprint_api.schemas.common import EvaluationState, FilePublic, Page, RowView, WorkCreate

TeamText = Annotated[str, StringConstraints(min_length=1, max_length=500, pattern=PLAIN)]


class MatchCreate(WorkCreate):
    """Match to play."""

    teams: tuple[TeamText, TeamText] = Field(
        description="Both teams: `example`, `example:walk=POLICY,kick=POLICY,keep=POLICY,getup=POLICY` with bundled or "
        "registered policies in place of some, or the name of an uploaded team."
    )
    games: int = Field(20, ge=1, le=MAX_GAMES, description="Games; the sides are swapped from game to game.")
    players: int = Field(3, ge=1, le=MAX_PLAYERS, description="Players of each team.")
    half_s: float = Field(300.0, ge=1.0, le=MAX_HALF_S, description="Seconds of play of a half.")
    gate: bool = Field(
        False, description="Whether to end as soon as a sequential test has decided if the first team does not lose."
    )
    film: Film = Field(
        "goals",
        description="What is filmed of each game: nothing (`off`), what led to goals, or all of it. Workers without "
        "imageio-ffmpeg make no film.",
    )

    def request(self) -> MatchRequest:
        """Return the match for `naojobs.matches`."""
        return MatchRequest(**self.model_dump())


class GamePublic(RowView):
    """Game of a match that is over."""

    number: int
    goals: tuple[int, int]
    lost: list[dict[str, Any]] = Field(description="Players that crashed, hung or never came, with the reasons.")
    finished_at: datetime
    log: FilePublic = Field(description="Its log: where all robots and the ball were, 25 times a second.")
    film: FilePublic | None = Field(None, description="Its film (MP4); null if none was made.")


class MatchEventPublic(RowView):
    """Event in the history of a match, or line of its log."""

    id: int
    at: datetime
    kind: str = Field(description="Kind of an event, as for jobs; of a line its level: info, warning or error.")
    attempt: int
    message: str


class MatchEventPage(BaseModel):
    """Page of a match's history, oldest first."""

    items: list[MatchEventPublic]
    next_after: int | None = Field(description="Value of `after` for the next page; null if the page is empty.")


class MatchPublic(BaseModel):
    """Match of two teams."""

    id: str
    owner: str
    state: EvaluationState
    teams: tuple[str, str]
    games: int = Field(description="Games to play.")
    players: int
    half_s: float
    gate: bool
    film: Film = Field(description="What is filmed of each game: nothing, what led to goals, or all of it.")
    played: int = Field(description="Games that are over.")
    wins: int = Field(description="Games that the first team has won.")
    draws: int
    losses: int
    tags: list[str]
    priority: int
    not_before: datetime | None = Field(description="When its next attempt may begin; null: at any time.")
    waiting_reason: str | None = Field(
        description="Why no worker can take the queued match; null if a worker can, and in all other states."
    )
    attempt: int = Field(description="Number of claims by workers.")
    failures: int = Field(description="Attempts lost in a row since the last game that is over.")
    max_attempts: int = Field(description="The match fails when failures reaches it.")
    worker: str | None = Field(description="Id of the worker that leases it.")
    stalled_since: datetime | None
    cancel_requested: bool
    error: str | None = Field(description="Why it failed, or why its last attempt was lost.")
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None


class MatchDetails(MatchPublic):
    """Match with its games and results."""

    summary: dict[str, Any] | None = Field(description="Results of the games so far; null before the first is over.")
    table: list[tuple[str, str, str]] = Field(description="The same in words: what, the first team's, the second's.")
    sums: list[str] = Field(description="Wins and goal difference with their intervals, in words.")
    live: dict[str, Any] | None = Field(
        description="A running game, about a second ago; null if none runs. `clip` is the log of its last two seconds "
        "in base64."
    )
    finished: list[GamePublic] = Field(description="The games that are over, by number.")


class MatchPage(Page[MatchPublic]):
    """Page of matches, newest first."""


class StandingPublic(RowView):
    """Place of a team in the league."""

    name: str
    rating: float = Field(description="Elo rating, fitted to all games; 1500 is average.")
    wins: int
    draws: int
    losses: int
    goals: tuple[int, int] = Field(description="Its own goals and those against it.")


class TeamPublic(RowView):
    """Uploaded team."""

    id: str
    owner: str
    name: str
    size: int = Field(description="Bytes of its archive.")
    created_at: datetime


class TeamPage(Page[TeamPublic]):
    """Page of uploaded teams, oldest first."""
