"""Notifications from the database: followers of a job are woken up when it changes."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import psycopg
from naojobs.connections import bounds
from naojobs.database import CHANNEL

_log = logging.getLogger(__name__)

_IDLE_S, _BLIND_S = 10.0, 1.0
"""How often a follower polls: rarely while notifications arrive, often while they cannot."""

MOST_DELETED = 1_000
"""Most deletions that are kept for a follower that is busy."""


class Subscription:
    """Wake-up event of one follower, with the jobs that were deleted while it was busy."""

    def __init__(self) -> None:
        self.wake = asyncio.Event()
        self._deleted: dict[str, str] = {}
        self._missing = False

    def add_deleted(self, job_id: str, owner: str) -> None:
        """Keep a deletion until the follower takes it."""
        self._deleted[job_id] = owner
        if len(self._deleted) > MOST_DELETED:
            self.lose_deleted()

    def lose_deleted(self) -> None:
        """Note that deletions are missing."""
        self._deleted, self._missing = {}, True

    def take_deleted(self) -> tuple[dict[str, str], bool]:
        """Return the owners of deleted jobs by the jobs' ids, and whether some are missing."""
        taken = self._deleted, self._missing
        self._deleted, self._missing = {}, False
        return taken


class Broadcaster:
    """Listener to the database on one connection, which wakes up all followers of this process."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._subscriptions: dict[Subscription, str | None] = {}
        self._places: Counter[tuple[str, bool]] = Counter()
        """Places taken by each owner's tokens, which may be many, and by links to the owner's jobs."""
        self._task: asyncio.Task[None] | None = None
        self._listening = False
        self.closing = False

    async def start(self) -> None:
        """Start to listen; connecting to a database that is down is retried without limit."""
        self._task = asyncio.create_task(self._listen(), name="broadcast")

    async def stop(self) -> None:
        """Stop listening and end all followers."""
        self.close()
        if self._task is not None:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task

    def close(self) -> None:
        """End all followers, because the service stops."""
        self.closing = True
        self._wake_all()

    @property
    def followers(self) -> int:
        """Return the number of followers."""
        return len(self._subscriptions)

    @contextmanager
    def place(self, owner: str, *, link: bool, most: int, most_of_owner: int) -> Iterator[bool]:
        """Take a place for a stream; yield whether there was one.

        Links to an owner's jobs may be in many hands: together they get half of the owner's places, rounded up.
        """
        taken, key = self._places[owner, False] + self._places[owner, True], (owner, link)
        free = self._places.total() < most and taken < most_of_owner and not self.closing
        free = free and not (link and 2 * self._places[key] >= most_of_owner)
        self._places[key] += free
        try:
            yield free
        finally:
            self._places[key] -= free
            self._places += Counter()  # forget owners without a place

    @contextmanager
    def subscribe(self, job_id: str | None = None) -> Iterator[Subscription]:
        """Follow one job, or all; changes between two waits are not lost."""
        subscription = Subscription()
        self._subscriptions[subscription] = job_id
        try:
            yield subscription
        finally:
            del self._subscriptions[subscription]

    async def wait(self, subscription: Subscription) -> bool:
        """Wait for a change or until the next poll; return whether there was a change."""
        with suppress(TimeoutError):
            async with asyncio.timeout(_IDLE_S if self._listening else _BLIND_S):
                await subscription.wake.wait()
        woken = subscription.wake.is_set()
        subscription.wake.clear()
        return woken

    def _wake_all(self) -> None:
        for subscription in self._subscriptions:
            subscription.wake.set()

    async def _listen(self) -> None:
        while True:
            try:
                async with await psycopg.AsyncConnection.connect(
                    self._url, autocommit=True, application_name="naosprint-api-listen", **bounds(self._url)
                ) as connection:
                    await connection.execute(f"LISTEN {CHANNEL}")
                    self._listening = True
                    for subscription in self._subscriptions:
                        subscription.lose_deleted()  # unlike changes, they cannot be read later
                    self._wake_all()
                    async for notification in connection.notifies():
                        self._tell(notification.payload)
            except (psycopg.Error, OSError) as error:
                _log.warning("no notifications from the database (%s); followers poll every %g s", error, _BLIND_S)
            self._listening = False
            await asyncio.sleep(_BLIND_S)

    def _tell(self, payload: str) -> None:
        job_id, _, deleted_from = payload.partition(" ")
        for subscription, wanted in self._subscriptions.items():
            if wanted is None or wanted == job_id:
                if deleted_from:
                    subscription.add_deleted(job_id, deleted_from)
                subscription.wake.set()
