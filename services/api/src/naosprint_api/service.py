"""Services that every route uses: settings, database, store, wake-up messages, streams and telemetry."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial

from anyio import CapacityLimiter, to_thread
from naojobs.capabilities import live_workers, waiting_reasons
from naojobs.database import Sessions, make_engine, make_sessions, schema_mismatch
from naojobs.errors import JobError
from naojobs.league import League
from naojobs.models import AnyWork, Evaluation, Job, Match, Worker
from naojobs.notifications import Notifier, make_celery
from naojobs.outcomes import record_notification_failure
from naojobs.retention import delete_files
from naojobs.store import ArtifactStore, StoreError, job_prefix
from naojobs.tokens import Principal, verify
from sqlalchemy import Engine, text
from sqlalchemy.exc import SQLAlchemyError

from naosprint_api.broadcast import Broadcaster
from naosprint_api.deliveries import Deliverer
from naosprint_api.feed import Feed
from naosprint_api.limits import RateLimiter
from naosprint_api.probes import Probe, Probes
from naosprint_api.recent import Recent
from naosprint_api.results import results_of
from naosprint_api.schemas.artifacts import EvaluationPublic
from naosprint_api.schemas.jobs import JobPublic
from naosprint_api.schemas.matches import MatchPublic
from naosprint_api.settings import ApiSettings
from naosprint_api.telemetry import Telemetry
from naosprint_api.views import evaluation_view, job_view, match_view

STORE_DEADLINE_S = 5.0
"""Seconds for which the store may be silent."""
STORE_THREADS, BROKER_THREADS = 16, 4
"""Number of threads for the store, and for the broker."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Service:
    """Settings and connections of one API process."""

    settings: ApiSettings
    engine: Engine
    sessions: Sessions
    reads: Sessions
    """For requests that only read."""
    store: ArtifactStore
    notifier: Notifier
    broadcaster: Broadcaster
    limiter: RateLimiter
    telemetry: Telemetry
    principals: Recent[str, Principal]
    """Principals by the secret of their token: other processes revoke a token within a second."""
    workers: Callable[[], Sequence[Worker]]
    """The workers that are alive, for the reasons why a job waits."""
    feed: Feed
    probes: Probes
    deliverer: Deliverer
    league: League
    store_threads: CapacityLimiter
    """Threads for the store and for the broker: one that does not answer blocks these, but not those of requests."""
    broker_threads: CapacityLimiter
    league_thread: CapacityLimiter
    """The one thread of the league: requests that wait for a ranking hold none of the others up."""

    @classmethod
    def build(cls, settings: ApiSettings) -> Service:
        """Create all services without connecting; create the folder of a local store."""
        engine = make_engine(
            settings.sqlalchemy_url, pool_size=settings.database_pool_size, application_name="naosprint-api"
        )
        sessions, reads = make_sessions(engine), make_sessions(engine, read_only=True)
        store = ArtifactStore.from_settings(settings, deadline_s=STORE_DEADLINE_S)
        notifier = Notifier(make_celery(settings.broker_url.get_secret_value(), "naosprint_api"))
        seen = Recent(partial(_live_workers, reads))

        def workers() -> Sequence[Worker]:
            return seen.get(settings.lease_s) or ()

        probes = (
            Probe(("database", "schema_revision"), partial(_database_in_order, sessions)),
            Probe(("store",), partial(_store_in_order, store)),
            Probe(("broker",), lambda: {"broker"} if notifier.reachable() else set()),
        )
        return cls(
            settings=settings,
            engine=engine,
            sessions=sessions,
            reads=reads,
            store=store,
            notifier=notifier,
            broadcaster=Broadcaster(settings.libpq_url),
            limiter=RateLimiter(settings.api_rate_per_s, settings.api_rate_burst),
            telemetry=Telemetry(reads),
            principals=Recent(partial(verify, reads)),
            workers=workers,
            feed=Feed(reads, workers),
            probes=Probes(probes),
            deliverer=Deliverer(sessions, networks=settings.api_webhook_networks, poll_s=settings.api_webhook_poll_s),
            league=League(reads),
            store_threads=CapacityLimiter(STORE_THREADS),
            broker_threads=CapacityLimiter(BROKER_THREADS),
            league_thread=CapacityLimiter(1),
        )

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Listen to the database and deliver messages for as long as the context lasts, then close everything."""
        await self.broadcaster.start()
        self.deliverer.start()
        try:
            yield
        finally:
            await self.deliverer.stop()
            await self.broadcaster.stop()
            self.notifier.close()
            self.engine.dispose()

    async def wake_up(self, *work: AnyWork) -> None:
        """Send wake-up messages for queued work; a broker that is down is recorded with the first job, not raised."""
        await to_thread.run_sync(partial(self._wake_up, *work), limiter=self.broker_threads)

    def _wake_up(self, *work: AnyWork) -> None:
        for item in work:
            error = self.notifier.wake_up(item.id, item.simulator)
            if error is None:
                continue
            self.telemetry.notification_failures.inc()
            try:
                record_notification_failure(self.sessions, item.job_id, error)
            except (SQLAlchemyError, JobError) as failure:
                _log.warning("could not record that the wake-up message of %s failed: %s", item.id, failure)
            return  # workers poll, so the other messages need not be tried

    def show_jobs(self, jobs: Sequence[Job]) -> list[JobPublic]:
        """Return jobs with the reasons why no worker can take them, and their evaluations."""
        workers = self.workers()
        with self.reads.begin() as session:
            reasons = waiting_reasons(session, jobs, workers)
            results = results_of(session, jobs)
        return [job_view(job, reasons.get(job.id), results.get(job.id)) for job in jobs]

    def show_job(self, job: Job) -> JobPublic:
        """Return a job with the reason why no worker can take it."""
        return self.show_jobs([job])[0]

    def show_evaluations(self, evaluations: Sequence[Evaluation]) -> list[EvaluationPublic]:
        """Return evaluations with the reasons why no worker can take them."""
        workers = self.workers()
        with self.reads.begin() as session:
            reasons = waiting_reasons(session, evaluations, workers)
        return [evaluation_view(evaluation, reasons.get(evaluation.id)) for evaluation in evaluations]

    def show_evaluation(self, evaluation: Evaluation) -> EvaluationPublic:
        """Return an evaluation with the reason why no worker can take it."""
        return self.show_evaluations([evaluation])[0]

    def show_matches(self, matches: Sequence[Match]) -> list[MatchPublic]:
        """Return matches with the reasons why no worker can take them."""
        workers = self.workers()
        with self.reads.begin() as session:
            reasons = waiting_reasons(session, matches, workers)
        return [match_view(match, reasons.get(match.id)) for match in matches]

    async def discard_artifacts(self, job_id: str) -> None:
        """Delete the files of a deleted job, match or team; if the store fails, a worker's sweep deletes them later."""
        await to_thread.run_sync(partial(self._discard_artifacts, job_id), limiter=self.store_threads)

    def _discard_artifacts(self, job_id: str) -> None:
        try:
            count = delete_files(self.sessions, self.store, job_prefix(job_id))
        except StoreError as error:
            _log.error("the files of the deleted %s are still in the store: %s", job_id, error)
        else:
            _log.info("deleted %s with %d files", job_id, count)


def _live_workers(sessions: Sessions, stale_s: float) -> Sequence[Worker]:
    with sessions.begin() as session:
        return live_workers(session, stale_s=stale_s)


def _database_in_order(sessions: Sessions) -> set[str]:
    try:
        with sessions.begin() as session:
            if session.scalar(text("SHOW transaction_read_only")) == "on":
                return set()  # another server has taken over
            try:
                return {"database"} if schema_mismatch(session) else {"database", "schema_revision"}
            except SQLAlchemyError:
                return {"database"}
    except SQLAlchemyError:
        return set()


def _store_in_order(store: ArtifactStore) -> set[str]:
    try:
        store.check()
    except StoreError:
        return set()
    return {"store"}
