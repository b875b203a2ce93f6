"""Celery's part of a worker: the wake-up messages."""

from __future__ import annotations

import logging
from typing import Any

from celery import Celery
from celery.signals import setup_logging, worker_ready, worker_shutting_down
from naojobs.notifications import WAKE_UP, make_celery

from naosprint_worker.settings import WorkerSettings
from naosprint_worker.worker import WorkLoop

logger = logging.getLogger(__name__)


def make_application(settings: WorkerSettings, worker: WorkLoop) -> Celery:
    """Return the Celery application of a worker.

    One message is taken at a time and only by a worker with a free slot, so that another worker receives the next.
    Connecting to a broker that is down is retried without limit; `worker` claims work without it.
    """
    app = make_celery(settings.broker_url.get_secret_value(), name="naosprint_worker")
    app.conf.update(
        task_acks_late=True,  # with early acknowledgement, a busy worker would prefetch a second message
        worker_prefetch_multiplier=1,
        worker_cancel_long_running_tasks_on_connection_loss=False,
        worker_enable_remote_control=False,
        worker_hijack_root_logger=False,
        worker_redirect_stdouts=False,
        worker_send_task_events=False,
        broker_connection_max_retries=None,
    )
    app.task(name=WAKE_UP)(worker.wake_up)
    return app


def serve(app: Celery, worker: WorkLoop) -> int:
    """Receive messages until SIGTERM and return the exit status."""

    def on_ready(**_: Any) -> None:
        logger.info("worker %s receives messages of %s", worker.id, ", ".join(worker.queues))

    def on_shutting_down(**_: Any) -> None:
        worker.shut_down()

    def on_setup_logging(**_: Any) -> None:
        """Leave logging as it is: a receiver of this signal keeps Celery from configuring it."""

    setup_logging.connect(on_setup_logging, weak=False)
    worker_ready.connect(on_ready, weak=False)
    worker_shutting_down.connect(on_shutting_down, weak=False)
    controller = app.Worker(
        pool="threads",
        concurrency=1,
        queues=list(worker.queues),
        hostname=f"naosprint@{worker.id}",
        without_mingle=True,
        without_gossip=True,
        # nothing reads these events, and the broker does not let workers publish
        without_heartbeat=True,
        quiet=True,
    )
    controller.start()
    return int(controller.exitcode or 0)
