"""Exit with 0 if the registry has heard of this container's worker lately, which is what everybody else goes by.

It speaks to the database directly: it runs every half minute, and loading the worker's own code costs seconds.
"""

from __future__ import annotations

import os
import socket
import sys

import psycopg

#: Seconds after which a worker counts as gone: the lease that its heartbeats renew.
STALE_S = float(os.environ.get("NAOSPRINT_LEASE_S", "30"))


def main() -> int:
    """Ask once; return the exit status."""
    url = "postgresql://" + os.environ["NAOSPRINT_DATABASE_URL"].split("://", 1)[1]
    with psycopg.connect(url, connect_timeout=5, application_name="naosprint-health") as connection:
        alive = connection.execute(
            "SELECT 1 FROM workers WHERE host = %s AND heartbeat_at > now() - make_interval(secs => %s)",
            (socket.gethostname(), STALE_S),
        ).fetchone()
    if alive is None:
        sys.stderr.write(f"no heartbeat of a worker on {socket.gethostname()} within {STALE_S:g} s\n")
        return 1
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except psycopg.Error as error:
        sys.exit(f"the database does not answer: {error}")
