"""Matches of teams, the league, and uploaded teams."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, BackgroundTasks, Depends, Path, Query, Request, Response
from naojobs import matches, requests, teams
from naojobs.errors import NotFoundError
from naojobs.ids import PATTERN
from naojobs.models import Match
from naojobs.store import StoreManifest
from naojobs.tokens import Principal

from naosprint_api import queries
from naosprint_api.dependencies import (
    MAX_BIGINT,
    Admin,
    CountedRoute,
    Cursor,
    PageLimit,
    Reader,
    ServiceDep,
    Submitter,
)
from naosprint_api.downloads import send_file
from naosprint_api.patterns import PLAIN, POLICY
from naosprint_api.problems import responses
from naosprint_api.routes.artifacts import FILE, Presigned
from naosprint_api.schemas.matches import (
    MatchCreate,
    MatchDetails,
    MatchEventPage,
    MatchEventPublic,
    MatchPage,
    MatchPublic,
    StandingPublic,
    TeamPage,
    TeamPublic,
)
from naosprint_api.service import Service
from naosprint_api.submitted import SubmissionDep
from naosprint_api.views import match_details

router = APIRouter(tags=["matches"], route_class=CountedRoute)

_LIST = responses(401, 403, 404, 422, 429, 503)
_CONTROL: dict[int | str, dict[str, Any]] = {**_LIST, **responses(409)}
_ARCHIVE = {"schema": {"type": "string", "format": "binary"}}

MatchId = Annotated[str, Path(pattern=PATTERN, description="Id of the match.")]
GameNumber = Annotated[int, Path(ge=1, le=matches.MAX_GAMES, description="Number of the game.")]
Owner = Annotated[str | None, Query(max_length=200, pattern=PLAIN, description="Owner; others need scope admin.")]
TeamName = Annotated[str, Path(pattern=POLICY, description="Name of the team.")]


def _owner(principal: Principal, owner: str | None) -> str | None:
    """Return whose matches and teams are shown; none for all. Raises NotFoundError."""
    if principal.job_id is not None:
        return ""  # a link to a job shows no match
    if principal.is_admin:
        return owner
    if owner not in (None, principal.owner):
        raise NotFoundError(f"nothing of {owner} that this token may see; leave `owner` out")
    return principal.owner


async def _archive(request: Request) -> bytes:
    return await request.body()


@router.post(
    "/matches",
    status_code=201,
    responses={**_CONTROL, **responses(413), 200: {"model": MatchPublic, "description": "Exists already"}},
)
def submit_match(body: MatchCreate, principal: Submitter, service: ServiceDep, submitted: SubmissionDep) -> MatchPublic:
    """Queue a match. 201 for a new one; 200 if the idempotency key was used before with the same body."""
    owner, request = principal.owner, body.request()
    match, created = matches.submit_match(service.sessions, request, owner=owner, **submitted.options)
    submitted.made(f"/matches/{match.id}", match, created=created)
    return service.show_matches([match])[0]


@router.get("/matches", responses=_LIST)
def list_matches(
    principal: Reader,
    service: ServiceDep,
    owner: Owner = None,
    tag: Annotated[list[str], Query(max_length=20, description="All of these tags.")] = [],  # noqa: B006
    limit: PageLimit = 50,
    cursor: Cursor = None,
) -> MatchPage:
    """List matches, newest first."""
    wanted = _owner(principal, owner)
    rows = queries.list_matches(service.reads, owner=wanted, tags=tag, limit=limit + 1, before=cursor)
    return MatchPage.of(service.show_matches(rows), limit)


@router.get("/matches/{match_id}", responses=_LIST)
def get_match(match_id: MatchId, principal: Reader, service: ServiceDep) -> MatchDetails:
    """Look up one match with its results and the games that are over."""
    match = queries.visible_match(service.reads, principal, match_id)
    (shown,) = service.show_matches([match])
    return match_details(match, shown, matches.games_of(service.reads, match_id))


@router.get("/matches/{match_id}/games/{number}/log", response_class=Response, responses=FILE)
def get_game_log(
    request: Request,
    match_id: MatchId,
    number: GameNumber,
    principal: Reader,
    service: ServiceDep,
    presigned: Presigned = False,
) -> Response:
    """Download the log of a game; `naoctl match report` computes its results again."""
    return _send(request, service, principal, match_id, number, ".npz", presigned=presigned)


@router.get("/matches/{match_id}/games/{number}/film", response_class=Response, responses=FILE)
def get_game_film(
    request: Request,
    match_id: MatchId,
    number: GameNumber,
    principal: Reader,
    service: ServiceDep,
    presigned: Presigned = False,
) -> Response:
    """Download the film of a game (MP4)."""
    return _send(request, service, principal, match_id, number, ".mp4", presigned=presigned)


def _send(
    request: Request,
    service: Service,
    principal: Principal,
    match_id: str,
    number: int,
    suffix: str,
    *,
    presigned: bool,
) -> Response:
    """Return a game's file with this suffix."""
    queries.visible_match(service.reads, principal, match_id)
    game = queries.game(service.reads, match_id, number)
    manifest = StoreManifest.model_validate(game.manifest)
    name = next((file.name for file in manifest.files if file.name.endswith(suffix)), None)
    if name is None:
        raise NotFoundError(f"game {number} of match {match_id} has no {suffix[1:]} file")
    return send_file(request, service.store, service.store_threads, game.key, manifest, name, presigned=presigned)


@router.get("/matches/{match_id}/events", responses=_LIST)
def list_match_events(
    match_id: MatchId,
    principal: Reader,
    service: ServiceDep,
    limit: PageLimit = 200,
    after: Annotated[
        int | None, Query(ge=0, le=MAX_BIGINT, description="Id of an event; later ones are listed.")
    ] = None,
) -> MatchEventPage:
    """List the history of a match and the lines of its log, oldest first."""
    queries.visible_match(service.reads, principal, match_id)
    rows = matches.events_of(service.reads, match_id, limit=limit, after=after)
    items = [MatchEventPublic.model_validate(row) for row in rows]
    return MatchEventPage(items=items, next_after=items[-1].id if items else None)


@router.post("/matches/{match_id}/cancel", responses=_CONTROL)
def cancel_match(match_id: MatchId, principal: Submitter, service: ServiceDep) -> MatchPublic:
    """Cancel a match. A running one stops soon; the games that are over stay."""
    queries.visible_match(service.reads, principal, match_id)
    return service.show_matches([requests.request_cancel(service.sessions, Match, match_id)])[0]


@router.post("/matches/{match_id}/retry", responses=_CONTROL)
def retry_match(
    match_id: MatchId, principal: Submitter, service: ServiceDep, background: BackgroundTasks
) -> MatchPublic:
    """Queue a failed or cancelled match again; games that are over are not played again."""
    queries.visible_match(service.reads, principal, match_id)
    match = requests.retry(service.sessions, Match, match_id, limits=service.settings.limits)
    background.add_task(service.wake_up, match)
    return service.show_matches([match])[0]


@router.delete("/matches/{match_id}", status_code=204, responses=_CONTROL)
def delete_match(match_id: MatchId, principal: Submitter, service: ServiceDep, background: BackgroundTasks) -> None:
    """Delete a match that has ended, with its games and their logs."""
    queries.visible_match(service.reads, principal, match_id)
    requests.delete_match(service.sessions, match_id)
    background.add_task(service.discard_artifacts, match_id)


@router.get("/league", responses=_LIST)
async def get_league(principal: Reader, service: ServiceDep, owner: Owner = None) -> list[StandingPublic]:
    """Rank the teams by Elo over all games of one's own matches, or of all with scope admin."""
    rank = partial(service.league.standings, _owner(principal, owner))
    ranking = await to_thread.run_sync(rank, limiter=service.league_thread)
    return [StandingPublic.model_validate(team) for team in ranking]


@router.get("/teams", responses=_LIST)
def list_teams(
    principal: Reader, service: ServiceDep, owner: Owner = None, limit: PageLimit = 50, cursor: Cursor = None
) -> TeamPage:
    """List uploaded teams, oldest first."""
    rows = teams.list_teams(service.reads, _owner(principal, owner), limit=limit + 1, after=cursor)
    return TeamPage.of([TeamPublic.model_validate(row) for row in rows], limit)


@router.put(
    "/teams/{name}",
    status_code=201,
    responses={**_CONTROL, **responses(413)},
    openapi_extra={"requestBody": {"required": True, "content": {"application/octet-stream": _ARCHIVE}}},
)
async def upload_team(
    name: TeamName,
    principal: Admin,
    service: ServiceDep,
    data: Annotated[bytes, Depends(_archive)],
    owner: Owner = None,
) -> TeamPublic:
    """Upload a team, which `owner` may then let play: a tar archive of a folder with team.json.

    Its command runs on workers, so this needs scope admin.
    """
    owner, limits = owner or principal.owner, service.settings.limits
    upload = partial(
        teams.upload_team, service.sessions, service.store, owner=owner, name=name, data=data, limits=limits
    )
    return TeamPublic.model_validate(await to_thread.run_sync(upload, limiter=service.store_threads))


@router.delete("/teams/{name}", status_code=204, responses=_CONTROL)
def delete_team(
    name: TeamName, principal: Submitter, service: ServiceDep, background: BackgroundTasks, owner: Owner = None
) -> None:
    """Delete an uploaded team that no open match needs; its matches stay."""
    whose = _owner(principal, owner) or principal.owner
    background.add_task(service.discard_artifacts, teams.delete_team(service.sessions, whose, name))
