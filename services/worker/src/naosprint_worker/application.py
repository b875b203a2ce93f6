"""The Celery side of a worker: which messages it takes and how."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from typing import Any

from celery import Celery
from celery.signals import setup_logging, worker_ready, worker_shutting_down
from naojobs.doorbell import RUN_EVALUATION, RUN_JOB, make_celery

from naosprint_worker.database import DATABASE_TROUBLE
from naosprint_worker.retry import describe
from naosprint_worker.settings import WorkerSettings
from naosprint_worker.worker import Worker

logger = logging.getLogger(__name__)


def make_application(settings: WorkerSettings) -> Celery:
    """Return the Celery application of a worker, without its tasks.

    A message is acknowledged when its job has ended, so the broker hands it on when a worker vanishes; the claim in
    the database makes a second delivery harmless. One message is taken for each free slot, so that jobs do not wait
    behind a busy worker. Losing the broker's connection cancels nothing.
    """
    app = make_celery(settings.broker_url.get_secret_value(), name="naosprint_worker")
    app.conf.update(
        task_acks_late=True,
        task_reject_on_worker_lost=False,
        worker_prefetch_multiplier=1,
        worker_cancel_long_running_tasks_on_connection_loss=False,
        worker_soft_shutdown_timeout=settings.worker_stop_grace_s + 10,
        worker_enable_remote_control=False,
        worker_hijack_root_logger=False,
        worker_redirect_stdouts=False,
        worker_send_task_events=False,
        broker_connection_max_retries=None,
    )
    return app


def register_tasks(app: Celery, worker: Worker) -> None:
    """Let messages reach ``worker``."""

    @app.task(name=RUN_JOB)  # type: ignore[untyped-decorator]
    def run_job(job_id: str) -> None:
        with _database_may_fail(job_id):
            worker.run_job(job_id)

    @app.task(name=RUN_EVALUATION)  # type: ignore[untyped-decorator]
    def run_evaluation(evaluation_id: str) -> None:
        with _database_may_fail(evaluation_id):
            worker.run_evaluation(evaluation_id)


@contextlib.contextmanager
def _database_may_fail(what: str) -> Iterator[None]:
    """Drop a message that came while the database was away: what it announced is announced again."""
    try:
        yield
    except DATABASE_TROUBLE as error:
        logger.warning("%s waits: the database did not answer: %s", what, describe(error, 200))


def serve(app: Celery, worker: Worker, settings: WorkerSettings) -> int:
    """Take messages until SIGTERM, then save what runs and return the exit status."""

    def on_ready(**_: Any) -> None:
        logger.info("worker %s is ready for %s", worker.id, ", ".join(settings.worker_queues))

    def on_shutting_down(**_: Any) -> None:
        worker.shut_down()

    def on_setup_logging(**_: Any) -> None:
        """Leave logging as it is: a receiver of this signal keeps Celery from setting it up its own way."""

    setup_logging.connect(on_setup_logging, weak=False)
    worker_ready.connect(on_ready, weak=False)
    worker_shutting_down.connect(on_shutting_down, weak=False)
    controller = app.Worker(
        # Jobs run in child processes of their own, so a thread that waits for one is all a slot needs.
        pool="threads",
        concurrency=settings.worker_concurrency,
        queues=list(settings.worker_queues),
        hostname=f"naosprint@{worker.id}",
        without_mingle=True,
        without_gossip=True,
        quiet=True,
    )
    controller.start()
    return int(controller.exitcode or 0)
