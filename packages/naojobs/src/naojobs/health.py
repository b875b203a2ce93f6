"""Health of a host's worker, by its heartbeat in the registry.

A container runs this every half minute, so it uses the driver directly: loading the models alone takes a second.
"""

from __future__ import annotations

import psycopg

from naojobs.connections import bounds
from naojobs.settings import ServiceSettings

_RECENT = "SELECT 1 FROM workers WHERE host = %s AND abs(extract(epoch FROM now() - heartbeat_at)) < %s LIMIT 1"
"""As `Worker.heard_within`."""


def has_live_worker(settings: ServiceSettings, host: str) -> bool:
    """Return whether a worker of `host` has a heartbeat younger than its lease. Raises psycopg.Error."""
    url = settings.libpq_url
    with psycopg.connect(url, application_name="naosprint-health", **bounds(url)) as connection:
        return connection.execute(_RECENT, (host, settings.lease_s)).fetchone() is not None
