"""Tell whether this host has a worker that is well: one that the registry has heard of lately.

A container asks every half minute, so this speaks to the database directly: loading the models alone takes a second.
"""

from __future__ import annotations

import socket
import sys

import psycopg
from naojobs.settings import ServiceSettings

_RECENT = "SELECT 1 FROM workers WHERE host = %s AND heartbeat_at > now() - make_interval(secs => %s) LIMIT 1"


def check(settings: ServiceSettings) -> int:
    """Return 0 if a worker of this host has a heartbeat younger than its lease; else say why not and return 1.

    The registry is what all others go by, so a worker that runs but cannot reach the database is not well.
    """
    host = socket.gethostname()
    try:
        with psycopg.connect(settings.libpq_url, connect_timeout=5, application_name="naosprint-health") as connection:
            well = connection.execute(_RECENT, (host, settings.lease_s)).fetchone() is not None
    except psycopg.Error as error:
        sys.stderr.write(f"the database does not answer: {error}\n")
        return 1
    if not well:
        sys.stderr.write(f"no heartbeat of a worker on {host} within {settings.lease_s:g} s\n")
    return 0 if well else 1
