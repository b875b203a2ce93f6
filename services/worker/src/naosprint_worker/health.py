"""Health check of this host's worker."""

from __future__ import annotations

import socket
import sys

import psycopg
from naojobs.health import has_live_worker
from naojobs.settings import ServiceSettings


def check(settings: ServiceSettings) -> int:
    """Return 0 if a worker of this host has a heartbeat younger than its lease; else write the reason and return 1.

    All other services use the registry, so a worker that runs but cannot reach the database is not healthy.
    """
    host = socket.gethostname()
    try:
        healthy = has_live_worker(settings, host)
    except psycopg.Error as error:
        sys.stderr.write(f"the database does not answer: {error}\n")
        return 1
    if not healthy:
        sys.stderr.write(f"no heartbeat of a worker on {host} within {settings.lease_s:g} s\n")
    return 0 if healthy else 1
