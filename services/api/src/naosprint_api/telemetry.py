"""Metrics of the service for Prometheus."""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

from naojobs.database import Sessions
from naojobs.models import Job, Worker
from naojobs.states import WorkState
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.platform_collector import PlatformCollector
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector
from sqlalchemy import func, select, text

#: Name, help and labels of what is counted in the database.
_ROWS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("naosprint_jobs", "Jobs by state.", ("state",)),
    ("naosprint_workers_alive", "Workers with a heartbeat in the last 30 s.", ()),
    ("naosprint_queue_oldest_seconds", "How long the oldest queued job has waited.", ()),
)

_BUCKETS = (0.002, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)


class _Rows(Collector):
    """Collector of the numbers of jobs and workers in the database."""

    def __init__(self, sessions: Sessions) -> None:
        self._sessions = sessions

    def describe(self) -> list[GaugeMetricFamily]:
        """Return the metrics' names without a database query."""
        return [GaugeMetricFamily(name, text, labels=labels) for name, text, labels in _ROWS]

    def collect(self) -> Iterator[GaugeMetricFamily]:
        """Count."""
        with self._sessions.begin() as session:
            counts = {
                state: count for state, count in session.execute(select(Job.state, func.count()).group_by(Job.state))
            }
            alive = session.scalar(
                select(func.count())
                .select_from(Worker)
                .where(Worker.heartbeat_at > func.now() - text("interval '30 seconds'")),
            )
            oldest = session.scalar(
                select(func.extract("epoch", func.now() - func.min(Job.queued_at))).where(
                    Job.state == WorkState.QUEUED
                ),
            )
        jobs, workers, longest = self.describe()
        for state in WorkState:
            jobs.add_metric([state], counts.get(state, 0))
        workers.add_metric([], alive or 0)
        longest.add_metric([], float(oldest or 0))
        yield from (jobs, workers, longest)


class Telemetry:
    """Metrics of one API process."""

    def __init__(self, sessions: Sessions) -> None:
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        PlatformCollector(registry=self._registry)
        self._registry.register(_Rows(sessions))
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
            "naosprint_notification_failures", "Wake-up messages that the broker did not take.", registry=self._registry
        )

    def observe(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count one request."""
        known = method if method in {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"} else "(other)"
        self._seconds.labels(known, route, str(status)).observe(seconds)

    @classmethod
    def catalogue(cls) -> list[tuple[str, str, tuple[str, ...], str]]:
        """Return name, kind, labels and help of every figure of the service's own."""
        figures = [(name, "gauge", labels, text) for name, text, labels in _ROWS]
        unread = cls(cast("Sessions", None))  # it asks the database only when it renders
        for figure in (unread._seconds, unread.followers, unread.refused, unread.notification_failures):
            (family,) = figure.describe()
            name = f"{family.name}_total" if family.type == "counter" else family.name
            figures.append((name, family.type, tuple(figure._labelnames), family.documentation))
        return figures

    def render(self) -> bytes:
        """Return all metrics in Prometheus's text format."""
        return generate_latest(self._registry)
