"""Reads news for followers: those who stand at the same place share one read."""

from __future__ import annotations

import asyncio
import itertools
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from typing import Any, TypeVar

import anyio
from naojobs.lifecycle import Sessions
from naojobs.states import JobState

from naosprint_api.queries import Position, news_of
from naosprint_api.views import event_view, job_view, log_view

Result = TypeVar("Result")

#: How long a read waits for more followers, and thereby how often at most each is told news.
GATHER_S = 0.25
#: Followers who share a read are told one after the other, so far apart: all at once would hold up every request.
APART_S, LONGEST_S = 0.002, 0.25
#: Threads that followers may use at a time, so that many of them never starve requests.
THREADS = 4


@dataclass(frozen=True, slots=True)
class Item:
    """Is one message, ready to be sent."""

    event: str
    text: str
    position: Position


@dataclass(frozen=True, slots=True)
class Batch:
    """Is what has happened to a job since a position; `state` none means that there is no such job any more."""

    items: tuple[Item, ...]
    #: Whether there is more than fits into one batch.
    more: bool = False
    state: JobState | None = None
    error: str | None = None
    updated_at: datetime | None = None
    #: The job itself, as JSON.
    job: str = ""


class Feed:
    """Reads and encodes news once for all followers that want the same."""

    def __init__(self, sessions: Sessions) -> None:
        self._sessions = sessions
        self._limiter = anyio.CapacityLimiter(THREADS)
        #: Reads that have not begun yet, and the turns of those who wait for them. Only these may be joined, for they
        #: will see all that is committed by now.
        self._gathering: dict[tuple[str, Position, frozenset[str]], tuple[asyncio.Task[Batch], Iterator[int]]] = {}

    async def in_thread(self, function: Callable[[], Result]) -> Result:
        """Run a read in one of the threads for followers."""
        return await anyio.to_thread.run_sync(function, limiter=self._limiter)

    async def news(self, job_id: str, seen: Position, kinds: frozenset[str], *, at_once: bool = False) -> Batch:
        """Return what is new about a job; `at_once` for a follower that is known to be behind."""
        if at_once:
            return await self.in_thread(partial(self._read, job_id, seen, kinds))
        key = (job_id, seen, kinds)
        if key not in self._gathering:
            self._gathering[key] = asyncio.create_task(self._gather(key)), itertools.count()
        task, turns = self._gathering[key]
        turn = next(turns)
        # A follower that leaves must not take the read away from the others.
        batch = await asyncio.shield(task)
        await asyncio.sleep(turn * APART_S % LONGEST_S)
        return batch

    async def _gather(self, key: tuple[str, Position, frozenset[str]]) -> Batch:
        try:
            await asyncio.sleep(GATHER_S)
        finally:
            del self._gathering[key]
        return await self.in_thread(partial(self._read, *key))

    def _read(self, job_id: str, seen: Position, kinds: frozenset[str]) -> Batch:
        news = news_of(self._sessions, job_id, seen, kinds)
        if news.job is None:
            return Batch(())
        items: list[Item] = []

        def add(event: str, text: str, **moved: int) -> None:
            last = items[-1].position if items else seen
            position = Position(
                moved.get("metrics", last.metrics), moved.get("logs", last.logs), moved.get("events", last.events)
            )
            items.append(Item(event, text, position))

        for row in news.metrics:
            values: dict[str, Any] = {**row.values, "step": row.step, "attempt": row.attempt}
            add("metrics", json.dumps(values), metrics=row.seq)
        for line in news.logs:
            add("log", log_view(line).model_dump_json(), logs=line.id)
        for event in news.events:
            add("event", event_view(event).model_dump_json(), events=event.id)
        job = news.job
        return Batch(tuple(items), news.more, job.state, job.error, job.updated_at, job_view(job).model_dump_json())
