"""Streams of server-sent events."""

from __future__ import annotations

import json
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Header, Query
from fastapi.responses import StreamingResponse
from fastapi.sse import KEEPALIVE_COMMENT, format_sse_event
from naojobs.ids import PATTERN
from naojobs.models import Job
from naojobs.states import ENDED, WorkState
from naojobs.tokens import Principal, is_valid

from naosprint_api import queries
from naosprint_api.dependencies import MAX_BIGINT, CountedRoute, Follower, JobId, ServiceDep
from naosprint_api.patterns import PLAIN
from naosprint_api.problems import FieldError, ProblemError, responses
from naosprint_api.queries import Position, Snapshot
from naosprint_api.routes.jobs import job_filter
from naosprint_api.service import Service

router = APIRouter(tags=["streams"], route_class=CountedRoute)

Kind = Literal["metrics", "log", "event", "state"]
LastEventId = Annotated[
    str | None,
    Header(
        alias="Last-Event-ID",
        max_length=100,
        description="Id of the last message received; the stream continues after it.",
    ),
]

_EVENT = {
    "type": "object",
    "properties": {"event": {"type": "string"}, "data": {"type": "string"}, "id": {"type": "string"}},
    "required": ["event", "data"],
}
_STREAM: dict[int | str, dict[str, Any]] = {
    200: {"description": "Events, one after the other", "content": {"text/event-stream": {"itemSchema": _EVENT}}},
    **responses(401, 403, 404, 422, 429, 503),
}


def _message(event: str, content: object, identifier: str | None = None) -> bytes:
    return format_sse_event(event=event, data_str=json.dumps(content), id=identifier)


class EventStream(StreamingResponse):
    """Response in chunks of whole events.

    The framework passes each event through two queues, which with many followers takes most of the service's time.
    """

    media_type = "text/event-stream"

    def __init__(self, chunks: AsyncIterator[bytes], status_code: int = 200) -> None:
        # The second is for proxies, which would otherwise buffer events.
        super().__init__(chunks, status_code, {"Cache-Control": "no-cache", "X-Accel-Buffering": "no"})


@contextmanager
def _follower(service: Service) -> Iterator[None]:
    with service.telemetry.followers.track_inprogress():
        yield


class Pass:
    """Permission to follow; it ends when the token is revoked or expires."""

    def __init__(self, service: Service, principal: Principal) -> None:
        self.owner = principal.owner
        self._service = service
        self._token_id = principal.token_id
        self._check_at = time.monotonic() + service.settings.api_recheck_s

    async def valid(self) -> bool:
        """Return whether the stream may continue."""
        if self._service.broadcaster.closing:
            return False
        if time.monotonic() < self._check_at:
            return True
        self._check_at = time.monotonic() + self._service.settings.api_recheck_s
        return await self._service.feed.in_thread(partial(is_valid, self._service.reads, self._token_id))


async def place(principal: Follower, service: ServiceDep) -> AsyncIterator[Pass]:
    """Take a place for a stream until it has ended; refuse a follower when there are too many."""
    settings = service.settings
    with service.broadcaster.place(
        principal.owner,
        link=principal.job_id is not None,
        most=settings.api_max_followers,
        most_of_owner=settings.api_max_followers_per_owner,
    ) as free:
        if not free:
            service.telemetry.refused.labels("followers").inc()
            raise ProblemError(503, "too many streams are open; try again soon", headers={"Retry-After": "10"})
        yield Pass(service, principal)


Place = Annotated[Pass, Depends(place)]


async def start_position(
    metrics_after: Annotated[int, Query(ge=0, le=MAX_BIGINT, description="`last_seq` of a metrics answer.")] = 0,
    logs_after: Annotated[int, Query(ge=0, le=MAX_BIGINT, description="Id of a log line.")] = 0,
    events_after: Annotated[int, Query(ge=0, le=MAX_BIGINT, description="Id of an event.")] = 0,
    last_event_id: LastEventId = None,
) -> Position:
    """Return where a follower continues: after the last id that it has received, else as in the query."""
    if not last_event_id:
        return Position(metrics_after, logs_after, events_after)
    position = Position.parse(last_event_id)
    if position is None:
        message = "is not an id of this stream; send the last `id:` received, or omit the header"
        raise ProblemError(422, f"Last-Event-ID {message}", [FieldError(field="Last-Event-ID", message=message)])
    return position


async def followed_job(job_id: JobId, principal: Follower, service: ServiceDep) -> Job:
    """Return the job to follow. Raises NotFoundError."""
    return await service.feed.in_thread(partial(queries.visible_job, service.reads, principal, job_id))


async def start_of_all(service: ServiceDep, last_event_id: LastEventId = None) -> tuple[Snapshot, bool]:
    """Return the snapshot from which changes of jobs are sent, and whether earlier ones are missing."""
    return await service.feed.in_thread(partial(queries.resume, service.reads, last_event_id))


async def stream_filter(
    principal: Follower,
    state: Annotated[list[WorkState], Query(description="Any of these states.")] = [],  # noqa: B006
    tag: Annotated[list[str], Query(max_length=20, description="All of these tags.")] = [],  # noqa: B006
    owner: Annotated[
        str | None, Query(max_length=200, pattern=PLAIN, description="Jobs of this owner; others' need scope admin.")
    ] = None,
    group: Annotated[str | None, Query(pattern=PATTERN, description="Jobs of this group.")] = None,
) -> queries.JobFilter:
    """Return the filter of a stream of jobs."""
    return job_filter(principal, state, tag, owner, group)


@router.get(
    "/jobs/stream",
    response_class=EventStream,
    responses=_STREAM,
)
async def stream_jobs(
    service: ServiceDep,
    allowed: Place,
    wanted: Annotated[queries.JobFilter, Depends(stream_filter)],
    start: Annotated[tuple[Snapshot, bool], Depends(start_of_all)],
) -> EventStream:
    """Follow all jobs: `job` with the whole job whenever one changes, `gone` with the id of one that was deleted.

    `ready` means that all later changes are sent. `reset` means that changes or deletions are missing: read the list of
    jobs again. It comes, among others, before `ready` when `Last-Event-ID` is not known or too many jobs have changed
    since; jobs that were deleted between two connections are not named. A change may be sent twice.
    """
    return EventStream(_news_of_all(service, allowed, wanted, *start))


def _read_page(
    service: Service, wanted: queries.JobFilter, seen: Snapshot, now: Snapshot, after: tuple[int, str]
) -> tuple[bytes, tuple[int, str] | None]:
    """Return changed jobs as events, and where the next page begins if there is one."""
    jobs = queries.changed_jobs(service.reads, wanted, seen=seen, now=now, after=after)
    shown = [view.model_dump_json() for view in service.show_jobs(jobs)] if jobs else []
    news = b"".join(format_sse_event(event="job", data_str=text, id=str(seen)) for text in shown)
    return news, (jobs[-1].changed_in, jobs[-1].id) if len(jobs) == queries.PAGE else None


async def _news_of_all(
    service: Service, allowed: Pass, wanted: queries.JobFilter, seen: Snapshot, missing: bool
) -> AsyncIterator[bytes]:
    with _follower(service), service.broadcaster.subscribe() as subscription:
        if missing:
            yield _message("reset", {})
        yield _message("ready", {}, str(seen))
        while await allowed.valid():
            now = await service.feed.in_thread(partial(queries.snapshot, service.reads))
            if now.generation != seen.generation:  # what was seen may have been undone
                seen = now
                yield _message("reset", {}, str(seen))
            place: tuple[int, str] | None = (seen.oldest, "") if now != seen else None
            while place is not None:
                if service.broadcaster.closing:
                    return
                read = partial(_read_page, service, wanted, seen, now, place)
                news, place = await service.feed.read(allowed.owner, read)
                if news:
                    yield news
            seen = now
            if not await service.broadcaster.wait(subscription):
                yield KEEPALIVE_COMMENT
            deleted, missing = subscription.take_deleted()
            if missing:
                yield _message("reset", {}, str(seen))
            for job_id, owner in deleted.items():
                if wanted.owner in (None, owner) and wanted.job_id in (None, job_id):
                    yield _message("gone", {"id": job_id}, str(seen))


@router.get(
    "/jobs/{job_id}/stream",
    response_class=EventStream,
    responses=_STREAM,
)
async def stream_job(
    service: ServiceDep,
    allowed: Place,
    job: Annotated[Job, Depends(followed_job)],
    seen: Annotated[Position, Depends(start_position)],
    only: Annotated[list[Kind], Query(description="Only these kinds; left out, all.")] = [],  # noqa: B006
) -> EventStream:
    """Follow one job: `metrics`, `log`, `event` and `state` messages, then `end` when it has ended.

    Everything from the start is sent unless `Last-Event-ID` or the query sets where to continue. When a job resumes
    from a checkpoint its steps go back: a `metrics` row whose step is not beyond the last one replaces all rows from
    its step on.
    """
    kinds = frozenset(only) or frozenset({"metrics", "log", "event", "state"})
    return EventStream(_news_of_one(service, allowed, job, seen, kinds))


async def _news_of_one(
    service: Service, allowed: Pass, job: Job, seen: Position, kinds: frozenset[str]
) -> AsyncIterator[bytes]:
    told = ""
    behind = True
    with _follower(service), service.broadcaster.subscribe(job.id) as subscription:
        while await allowed.valid():
            batch = await service.feed.news(job, seen, kinds, hurried=behind)
            if batch.state is None:
                yield _message("gone", {"id": job.id})
                return
            seen, behind = batch.position, batch.more
            if behind:
                yield batch.news
                continue
            news = batch.news
            if "state" in kinds and batch.shown != told:
                news += batch.job
            told = batch.shown
            if batch.state in ENDED:
                yield news + _message("end", {"state": batch.state, "error": batch.error}, str(seen))
                return
            if news:
                yield news
            if not await service.broadcaster.wait(subscription):
                yield KEEPALIVE_COMMENT
