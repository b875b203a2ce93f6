"""A worker's access to the database."""

from __future__ import annotations

from naojobs.database import limit_transactions, make_engine
from sqlalchemy import Engine
from sqlalchemy.exc import (
    DataError,
    DBAPIError,
    IntegrityError,
    InterfaceError,
    InternalError,
    OperationalError,
    SQLAlchemyError,
)
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from naosprint_worker.settings import WorkerSettings

DATABASE_ERRORS: tuple[type[Exception], ...] = (OperationalError, InterfaceError, InternalError, PoolTimeoutError)
"""Errors of a database that is restarting, overloaded, read-only or unreachable."""


def outage_of(error: Exception) -> Exception | None:
    """Return the database's error behind `error`; none if it is another one, or about the values that were written.

    Optuna raises an error of its own from the database's.
    """
    cause = error.__cause__ if isinstance(error.__cause__, SQLAlchemyError) else error
    about_values = isinstance(cause, (DataError, IntegrityError))
    return cause if isinstance(cause, (DBAPIError, PoolTimeoutError)) and not about_values else None


def open_engine(settings: WorkerSettings, *, pool_size: int, application_name: str) -> Engine:
    """Return an engine whose transactions end with the lease, even if this process is frozen in the middle of one."""
    engine = make_engine(settings.sqlalchemy_url, pool_size=pool_size, application_name=application_name)
    limit_transactions(engine, settings.lease_s)
    return engine
