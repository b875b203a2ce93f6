"""Tell whether this host has a worker that is well: one that the registry has heard of lately."""

from __future__ import annotations

import socket
import sys

from naojobs import registry
from naojobs.database import make_engine, make_sessions
from naojobs.settings import ServiceSettings
from sqlalchemy.exc import SQLAlchemyError


def check(settings: ServiceSettings) -> int:
    """Return 0 if a worker of this host has a heartbeat younger than its lease; else say why not and return 1.

    The registry is what all others go by, so a worker that runs but cannot reach the database is not well.
    """
    host = socket.gethostname()
    engine = make_engine(settings.sqlalchemy_url, pool_size=1, application_name="naosprint-health")
    try:
        well = registry.is_alive(make_sessions(engine), host, stale_s=settings.lease_s)
    except SQLAlchemyError as error:
        sys.stderr.write(f"the database does not answer: {getattr(error, 'orig', None) or error}\n")
        return 1
    finally:
        engine.dispose()
    if not well:
        sys.stderr.write(f"no heartbeat of a worker on {host} within {settings.lease_s:g} s\n")
    return 0 if well else 1
