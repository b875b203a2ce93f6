"""The doorbell: Celery messages that tell workers that something waits.

The row in the database is the truth. A message may be lost, doubled or late without harm, so sending one may fail
without failing what it was sent for.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

# Celery is imported where it is used: trainers need the names of the queues, and no broker.
if TYPE_CHECKING:
    from celery import Celery

#: The tasks of the worker, by name: who sends them imports nothing of the worker.
RUN_JOB = "naosprint_worker.run_job"
RUN_EVALUATION = "naosprint_worker.run_evaluation"

#: The queues, one for each simulator that a worker may have.
QUEUES = ("embedded", "rcssserver3d")

_log = logging.getLogger(__name__)


def make_celery(broker_url: str, name: str = "naosprint") -> Celery:
    """Return a Celery application with all that sender and receiver must agree on.

    Results live in the database, not in Celery. Priorities are those of the Redis transport: 0 goes first.
    """
    from celery import Celery

    app = Celery(name, broker=broker_url, set_as_current=False)
    app.conf.update(
        task_ignore_result=True,
        task_store_errors_even_if_ignored=False,
        task_serializer="json",
        accept_content=["json"],
        task_default_queue=QUEUES[0],
        task_create_missing_queues=True,
        task_track_started=False,
        broker_connection_retry_on_startup=True,
        broker_transport_options={
            # Longer than any job, so that a live job is not delivered twice; a dead one is the reaper's to find.
            "visibility_timeout": 30 * 86_400,
            "queue_order_strategy": "priority",
            "priority_steps": list(range(10)),
            "sep": ":",
            "socket_connect_timeout": 2,
            "socket_timeout": 5,
        },
        enable_utc=True,
    )
    return app


class Doorbell:
    """Sends the messages; never waits long for a broker that is down."""

    def __init__(self, app: Celery) -> None:
        # A consumer does well to wait for its broker; a sender gives up at once, for somebody rings again.
        self._app = make_celery(app.conf.broker_url, f"{app.main}-doorbell")
        options = {"max_retries": 0, "interval_start": 0, "interval_step": 0, "interval_max": 0}
        self._app.conf.broker_transport_options |= options

    def ring_job(self, job_id: str, queue: str, priority: int = 5) -> str | None:
        """Announce a queued job; return none, or what went wrong."""
        return self._send(RUN_JOB, job_id, queue, priority)

    def ring_evaluation(self, evaluation_id: str, queue: str) -> str | None:
        """Announce a queued evaluation; return none, or what went wrong."""
        return self._send(RUN_EVALUATION, evaluation_id, queue, 5)

    def reachable(self) -> bool:
        """Tell whether the broker answers, within a few seconds."""
        try:
            with self._app.connection_for_write() as connection:
                connection.default_channel.client.ping()
        except Exception:
            return False
        return True

    def close(self) -> None:
        """Let go of the connections to the broker."""
        self._app.close()

    def _send(self, task: str, identifier: str, queue: str, priority: int) -> str | None:
        options: dict[str, Any] = {"queue": queue, "priority": 9 - priority, "retry": False, "ignore_result": True}
        try:
            self._app.send_task(task, args=[identifier], **options)
        except Exception as error:  # whatever a broker does, it must not fail a submit
            _log.warning("the broker did not take the message for %s: %s", identifier, error)
            return f"{type(error).__name__}: {error}"
        return None
