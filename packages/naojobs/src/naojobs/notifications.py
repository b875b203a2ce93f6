"""Wake-up messages through Celery, with which a free worker begins work at once, not at its next look at the table.

They are sent for work that is submitted and for work that its worker gives back or is lost with. A message may be lost,
duplicated or late without harm, and nothing waits or fails while the broker is down.
"""

from __future__ import annotations

import logging
import ssl
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

# Celery is imported where it is used: child processes need the names of the queues, and no broker.
if TYPE_CHECKING:
    from celery import Celery

WAKE_UP = "naosprint_worker.wake_up"
"""Name of the Celery task behind a wake-up message; its argument is the id of the work."""

DEFAULT_QUEUE = "embedded"
"""The queue of messages that name none; each simulator has a queue of its name."""

_log = logging.getLogger(__name__)


def make_celery(broker_url: str, name: str = "naosprint") -> Celery:
    """Return a Celery application with all settings that sender and receiver share.

    A broker at rediss://... must have a certificate for its host, by an authority of the system or of the file
    that the parameter `ssl_ca_certs` names; no other parameter changes that.
    """
    from celery import Celery

    parts = urlsplit(broker_url)
    tls: dict[str, Any] = {"ssl_cert_reqs": ssl.CERT_REQUIRED, "ssl_check_hostname": True}
    if authority := parse_qs(parts.query).get("ssl_ca_certs"):
        tls["ssl_ca_certs"] = authority[0]
    if parts.scheme == "rediss":
        broker_url = parts._replace(query="").geturl()
    app = Celery(name, broker=broker_url, set_as_current=False)
    app.conf.update(
        task_ignore_result=True,
        task_store_errors_even_if_ignored=False,
        task_serializer="json",
        accept_content=["json"],
        task_default_queue=DEFAULT_QUEUE,
        task_create_missing_queues=True,
        task_track_started=False,
        broker_connection_retry_on_startup=True,
        broker_transport_options={"socket_connect_timeout": 2, "socket_timeout": 5},
        broker_use_ssl=tls if parts.scheme == "rediss" else None,
        enable_utc=True,
    )
    return app


class Notifier:
    """Sender of wake-up messages that does not wait long for a broker that is down."""

    def __init__(self, app: Celery) -> None:
        # A consumer waits for its broker; a sender gives up at once, since workers poll anyway.
        self._app = make_celery(app.conf.broker_url, f"{app.main}-notifier")
        options = {"max_retries": 0, "interval_start": 0, "interval_step": 0, "interval_max": 0}
        self._app.conf.broker_transport_options |= options
        self._app.conf.broker_use_ssl = app.conf.broker_use_ssl

    def wake_up(self, work_id: str, queue: str) -> str | None:
        """Send a wake-up message for queued work; return none, or the error."""
        try:
            self._app.send_task(WAKE_UP, args=[work_id], queue=queue, retry=False, ignore_result=True)
        except Exception as error:  # a failing broker must not fail the caller's operation
            _log.warning("the broker did not accept the message for %s: %s", work_id, error)
            return f"{type(error).__name__}: {error}"
        return None

    def reachable(self) -> bool:
        """Return whether the broker answers within a few seconds."""
        try:
            with self._app.connection_for_write() as connection:
                connection.default_channel.client.ping()
        except Exception:
            return False
        return True

    def close(self) -> None:
        """Close the connections to the broker."""
        self._app.close()
