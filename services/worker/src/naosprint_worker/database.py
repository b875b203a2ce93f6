"""A worker's access to the database."""

from __future__ import annotations

from naojobs.database import limit_transactions, make_engine
from sqlalchemy import Engine
from sqlalchemy.exc import InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from naosprint_worker.settings import WorkerSettings

DATABASE_ERRORS: tuple[type[Exception], ...] = (OperationalError, InterfaceError, PoolTimeoutError)
"""Errors of a database that is restarting, overloaded or unreachable."""


def open_engine(settings: WorkerSettings, *, pool_size: int, application_name: str) -> Engine:
    """Return an engine whose transactions end with the lease, even if this process is frozen in the middle of one."""
    engine = make_engine(settings.sqlalchemy_url, pool_size=pool_size, application_name=application_name)
    limit_transactions(engine, settings.lease_s)
    return engine
