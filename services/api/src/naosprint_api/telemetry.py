"""Metrics of the service for Prometheus."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import timedelta
from typing import cast

from naojobs.database import Sessions
from naojobs.leases import waiting
from naojobs.models import WORK, AnyWork, Backup, Delivery, Job, Match, Worker
from naojobs.states import WorkState
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.platform_collector import PlatformCollector
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

_ROWS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("naosprint_jobs", "Jobs by state.", ("state",)),
    ("naosprint_matches", "Matches by state.", ("state",)),
    ("naosprint_workers_alive", "Workers with a heartbeat in the last 30 s.", ()),
    ("naosprint_queue_oldest_seconds", "Waiting time of the oldest job that a worker may begin now.", ()),
    ("naosprint_jobs_failed_recently", "Jobs that have failed in the last 15 minutes.", ()),
    ("naosprint_jobs_postponed", "Queued jobs whose last attempt ended because a service was unavailable.", ()),
    ("naosprint_stalled", "Trainings, evaluations and matches that are running without making steps.", ()),
    ("naosprint_worker_disk_free_bytes", "Free space on the disk of a worker that is alive.", ("worker",)),
    ("naosprint_webhook_messages_waiting", "Messages to webhooks that are not delivered yet.", ()),
    ("naosprint_backup_age_seconds", "Time since the last backup; missing if there has been none.", ()),
    ("naosprint_service_up", "Whether database, schema_revision, store and broker answer the API.", ("service",)),
)
"""Name, help and labels of the metrics from the database."""

_BUCKETS = (0.002, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)


class _Rows(Collector):
    """Collector of the numbers of jobs and workers in the database."""

    def __init__(self, sessions: Sessions) -> None:
        self._sessions = sessions
        self.services: Mapping[str, bool] = {}
        """Whether each service that the API needs answers, by name."""

    def describe(self) -> list[GaugeMetricFamily]:
        """Return the metrics' names without a database query."""
        return [GaugeMetricFamily(name, text, labels=labels) for name, text, labels in _ROWS]

    def collect(self) -> Iterator[GaugeMetricFamily]:
        """Count; without a database only the services that answer are reported."""
        families = {family.name: family for family in self.describe()}
        up = families["naosprint_service_up"]
        for service, answers in self.services.items():
            up.add_metric([service], answers)
        yield up
        with suppress(SQLAlchemyError), self._sessions.begin() as session:
            for name, value in _counts(session):
                families[name].add_metric([], value)
            models: tuple[tuple[str, type[AnyWork]], ...] = (("naosprint_jobs", Job), ("naosprint_matches", Match))
            for name, model in models:
                by_state = session.execute(select(model.state, func.count()).group_by(model.state))
                states = {state: count for state, count in by_state}  # mypy does not accept dict() of rows
                for state in WorkState:
                    families[name].add_metric([state], states.get(state, 0))
            for worker, free in session.execute(select(Worker.id, Worker.disk_free_bytes).where(_ALIVE)):
                if free is not None:
                    families["naosprint_worker_disk_free_bytes"].add_metric([worker], free)
            yield from (family for family in families.values() if family is not up)


_ALIVE = Worker.heard_within(30)
"""Condition of workers with a heartbeat in the last 30 s."""


def _counts(session: Session) -> Iterator[tuple[str, float]]:
    """Yield the metrics that are one number each; one without a value is left out.

    Each condition of work is such that an index serves: most rows are of work that has ended.
    """
    since = func.min(func.greatest(Job.queued_at, Job.not_before))  # null counts as no time
    oldest = waiting(Job).with_only_columns(func.greatest(func.extract("epoch", func.now() - since), 0))
    postponed = select(func.count()).where(Job.state == WorkState.QUEUED, Job.postponed > 0)
    recently = func.now() - timedelta(minutes=15)
    ended = (Job.finished_at > recently, Job.updated_at > recently)  # the end is a change, and others may follow it
    failed = select(func.count(Job.id)).where(Job.state == WorkState.FAILED, *ended)
    stalled = (
        select(func.count(model.id)).where(model.stalled_since.is_not(None), model.lease_owner.is_not(None))
        for model in WORK.values()
    )
    yield "naosprint_queue_oldest_seconds", float(session.scalar(oldest))
    yield "naosprint_jobs_failed_recently", session.scalar(failed) or 0
    yield "naosprint_jobs_postponed", session.scalar(postponed) or 0
    yield "naosprint_stalled", sum(session.scalar(query) or 0 for query in stalled)
    yield "naosprint_workers_alive", session.scalar(select(func.count()).select_from(Worker).where(_ALIVE)) or 0
    messages = select(func.count()).select_from(Delivery).where(Delivery.next_at.is_not(None))
    yield "naosprint_webhook_messages_waiting", session.scalar(messages) or 0
    age_s = session.scalar(select(func.extract("epoch", func.now() - func.max(Backup.finished_at))))
    if age_s is not None:
        yield "naosprint_backup_age_seconds", float(age_s)


class Telemetry:
    """Metrics of one API process."""

    def __init__(self, sessions: Sessions) -> None:
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        PlatformCollector(registry=self._registry)
        self._rows = _Rows(sessions)
        self._registry.register(self._rows)
        self._seconds = Histogram(
            "naosprint_http_request_seconds",
            "Time to the end of the answer.",
            ["method", "route", "status"],
            buckets=_BUCKETS,
            registry=self._registry,
        )
        self.followers = Gauge("naosprint_followers", "Open streams.", registry=self._registry)
        self.refused = Counter("naosprint_refused", "Requests refused.", ["reason"], registry=self._registry)
        self.notification_failures = Counter(
            "naosprint_notification_failures", "Wake-up messages not accepted by the broker.", registry=self._registry
        )

    def observe(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count one request."""
        known = method if method in {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"} else "(other)"
        self._seconds.labels(known, route, str(status)).observe(seconds)

    @classmethod
    def catalogue(cls) -> list[tuple[str, str, tuple[str, ...], str]]:
        """Return name, kind, labels and help of every metric of the service."""
        figures = [(name, "gauge", labels, text) for name, text, labels in _ROWS]
        unread = cls(cast("Sessions", None))  # it queries the database only when it renders
        for figure in (unread._seconds, unread.followers, unread.refused, unread.notification_failures):
            (family,) = figure.describe()
            name = f"{family.name}_total" if family.type == "counter" else family.name
            figures.append((name, family.type, tuple(figure._labelnames), family.documentation))
        return figures

    def render(self, services: Mapping[str, bool]) -> bytes:
        """Return all metrics in Prometheus's text format; `services` by name, whether each answers."""
        self._rows.services = services
        return generate_latest(self._registry)
