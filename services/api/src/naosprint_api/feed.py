"""Changes for followers; those at the same position share one read."""

from __future__ import annotations

import asyncio
import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias, TypeVar
from weakref import WeakValueDictionary

import anyio
from fastapi.sse import format_sse_event
from naojobs.database import Sessions
from naojobs.models import Job, Worker
from naojobs.states import WorkState

from naosprint_api.queries import Position, news_of
from naosprint_api.views import event_view, job_view, log_view

Result = TypeVar("Result")
_Wanted: TypeAlias = tuple[str, str, Position, frozenset[str], bool]
"""A job's owner, the job, a follower's position, the kinds of records it follows, and whether it is behind."""

GATHER_S = 0.25
"""How long a read waits for more followers, and so the shortest time between two updates of each."""
HURRIED_GATHER_S = 0.02
"""The same for followers that are known to be behind: just long enough for those that connect at once."""
APART_S, LONGEST_S = 0.002, 0.25
"""Time between the followers that share a read: to wake them up all at once would delay other requests."""
THREADS = 2
"""Threads for what followers read, and for the short queries beside that, so that many do not block requests."""


@dataclass(frozen=True, slots=True)
class FeedBatch:
    """News of a job since a position; `state` is None if the job was deleted."""

    news: bytes
    """The changes as server-sent events, encoded once for all followers."""
    position: Position
    """What has been seen behind them."""
    more: bool = False
    """Whether there is more than fits into one batch."""
    state: WorkState | None = None
    error: str | None = None
    shown: str = ""
    """The job itself, as JSON: why it waits changes with the workers, without a change of its row."""
    job: bytes = b""
    """The same as an event."""


class Feed:
    """Reader of changes, once for all followers that request the same."""

    def __init__(self, sessions: Sessions, workers: Callable[[], Sequence[Worker]]) -> None:
        self._sessions = sessions
        self._workers = workers
        self._limiter, self._readers = anyio.CapacityLimiter(THREADS), anyio.CapacityLimiter(THREADS)
        self._turns: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        self._gathering: dict[_Wanted, tuple[asyncio.Task[FeedBatch], Iterator[int]]] = {}
        """Reads that have not begun yet, and the followers waiting for them. Only these may be joined, since they
        include everything committed until now.
        """

    async def in_thread(self, function: Callable[[], Result]) -> Result:
        """Run a short query in one of the threads for followers."""
        return await anyio.to_thread.run_sync(function, limiter=self._limiter)

    async def read(self, owner: str, function: Callable[[], Result]) -> Result:
        """Run a read of what is sent: one at a time for each owner, so that many streams of one delay no other's."""
        async with self._turns.setdefault(owner, asyncio.Lock()):
            return await anyio.to_thread.run_sync(function, limiter=self._readers)

    async def news(self, job: Job, seen: Position, kinds: frozenset[str], *, hurried: bool = False) -> FeedBatch:
        """Return what is new about a job; `hurried` for a follower that is known to be behind."""
        wanted = job.owner, job.id, seen, kinds, hurried
        if wanted not in self._gathering:
            self._gathering[wanted] = asyncio.create_task(self._gather(wanted)), itertools.count()
        task, turns = self._gathering[wanted]
        turn = next(turns)
        # A follower that disconnects must not cancel the read of the others.
        batch = await asyncio.shield(task)
        await asyncio.sleep(turn * APART_S % LONGEST_S)
        return batch

    async def _gather(self, wanted: _Wanted) -> FeedBatch:
        owner, job_id, seen, kinds, hurried = wanted
        try:
            await asyncio.sleep(HURRIED_GATHER_S if hurried else GATHER_S)
        finally:
            del self._gathering[wanted]
        return await self.read(owner, partial(self._read, job_id, seen, kinds))

    def _read(self, job_id: str, seen: Position, kinds: frozenset[str]) -> FeedBatch:
        news = news_of(self._sessions, job_id, seen, kinds, workers=self._workers())
        if news.job is None:
            return FeedBatch(b"", seen)
        events: list[bytes] = []

        def add(event: str, text: str, **moved: int) -> None:
            nonlocal seen
            seen = replace(seen, **moved)
            events.append(format_sse_event(event=event, data_str=text, id=str(seen)))

        for row in news.metrics:
            values: dict[str, Any] = {**row.values, "step": row.step, "attempt": row.attempt}
            add("metrics", json.dumps(values), metrics=row.seq)
        for line in news.logs:
            add("log", log_view(line).model_dump_json(), logs=line.id)
        for event in news.events:
            add("event", event_view(event).model_dump_json(), events=event.id)
        job = news.job
        shown = job_view(job, news.waiting_reason, news.result).model_dump_json()
        state = format_sse_event(event="state", data_str=shown, id=str(seen))
        return FeedBatch(b"".join(events), seen, news.more, job.state, job.error, shown, state)
