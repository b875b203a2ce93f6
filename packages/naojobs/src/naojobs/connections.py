"""Bounds of connections to the database: one that has gone silent is given up, instead of waited for.

Health checks import this module, so it uses the driver alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from psycopg import ProgrammingError
from psycopg.conninfo import conninfo_to_dict

BOUNDS: Mapping[str, int] = {
    "connect_timeout": 5,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    # Keepalives act on a connection that waits for an answer. What was sent and is not acknowledged is repeated
    # instead, without this for a quarter of an hour; it is the only one in milliseconds.
    "tcp_user_timeout": 20_000,
}
"""Options of libpq for every connection of the service; those of TCP do nothing on a socket of this machine."""


def bounds(url: str) -> dict[str, Any]:
    """Return `BOUNDS` for connections to `url`, with any driver in its scheme, less what the URL sets itself."""
    try:
        own = conninfo_to_dict(f"postgresql://{url.split('://', 1)[1]}")
    except ProgrammingError:  # connecting says what is wrong with it
        own = {}
    return {name: value for name, value in BOUNDS.items() if name not in own}
