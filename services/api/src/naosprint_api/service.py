"""What every route works with: settings, database, store, doorbell, news and figures."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from naojobs.database import make_engine, make_sessions
from naojobs.doorbell import Doorbell, make_celery
from naojobs.errors import JobError
from naojobs.lifecycle import Sessions, mark_rung
from naojobs.store import ArtifactStore, StoreError, job_prefix
from sqlalchemy import Engine
from sqlalchemy.exc import SQLAlchemyError

from naosprint_api.broadcast import Broadcaster
from naosprint_api.feed import Feed
from naosprint_api.limits import RateLimiter
from naosprint_api.settings import ApiSettings
from naosprint_api.telemetry import Telemetry

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Service:
    """Bundles what one API process holds open."""

    settings: ApiSettings
    engine: Engine
    sessions: Sessions
    #: For requests that only look.
    reads: Sessions
    store: ArtifactStore
    doorbell: Doorbell
    broadcaster: Broadcaster
    limiter: RateLimiter
    telemetry: Telemetry
    feed: Feed

    @classmethod
    def build(cls, settings: ApiSettings) -> Service:
        """Make everything; connects to nothing yet, but makes the folder of a local store."""
        engine = make_engine(
            settings.sqlalchemy_url, pool_size=settings.database_pool_size, application_name="naosprint-api"
        )
        sessions, reads = make_sessions(engine), make_sessions(engine, read_only=True)
        return cls(
            settings=settings,
            engine=engine,
            sessions=sessions,
            reads=reads,
            store=ArtifactStore.from_settings(settings),
            doorbell=Doorbell(make_celery(settings.broker_url.get_secret_value(), "naosprint_api")),
            broadcaster=Broadcaster(settings.libpq_url),
            limiter=RateLimiter(settings.api_rate_per_s, settings.api_rate_burst),
            telemetry=Telemetry(reads),
            feed=Feed(reads),
        )

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Listen to the database for as long as the context lasts, then let go of everything."""
        await self.broadcaster.start()
        try:
            yield
        finally:
            await self.broadcaster.stop()
            self.doorbell.close()
            self.engine.dispose()

    def announce(self, job_id: str, queue: str, priority: int) -> None:
        """Ring for a queued job; a broker that is down is noted in the job's events, not raised."""
        error = self.doorbell.ring_job(job_id, queue, priority)
        if error is not None:
            self.telemetry.doorbell_failures.inc()
        try:
            mark_rung(self.sessions, job_id, error)
        except (SQLAlchemyError, JobError) as failure:
            _log.warning("could not note the doorbell of %s: %s", job_id, failure)

    def announce_evaluation(self, evaluation_id: str, queue: str) -> None:
        """Ring for a queued evaluation; who sweeps rings again if the broker is down."""
        if self.doorbell.ring_evaluation(evaluation_id, queue) is not None:
            self.telemetry.doorbell_failures.inc()

    def discard_artifacts(self, job_id: str) -> None:
        """Delete the files of a deleted job; a store that fails keeps them until a worker sweeps."""
        try:
            count = self.store.delete_prefix(job_prefix(job_id))
        except StoreError as error:
            _log.error("the files of the deleted job %s are still in the store: %s", job_id, error)
        else:
            _log.info("deleted job %s with %d files", job_id, count)
