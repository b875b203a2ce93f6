"""A worker's way to the database."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import psycopg
from naojobs.database import make_engine
from sqlalchemy import Engine, event
from sqlalchemy.exc import InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from naosprint_worker.settings import WorkerSettings

if TYPE_CHECKING:
    from sqlalchemy.engine import ExceptionContext

#: What the database raises while it restarts, is overloaded or cannot be reached.
DATABASE_TROUBLE: tuple[type[Exception], ...] = (OperationalError, InterfaceError, PoolTimeoutError)

#: The first version of Postgres that can limit a transaction as a whole.
_TRANSACTION_TIMEOUT_SINCE = 170_000

_TOO_LONG = (psycopg.errors.TransactionTimeout, psycopg.errors.IdleInTransactionSessionTimeout)


def open_engine(settings: WorkerSettings, *, pool_size: int, application_name: str) -> Engine:
    """Return an engine whose transactions end with the lease, even if this process is frozen in the middle of one.

    A frozen process keeps its connection, and with it the lock on its job's row: nobody could take the job back.
    """
    engine = make_engine(settings.sqlalchemy_url, pool_size=pool_size, application_name=application_name)
    limit = f"{settings.lease_s * 1000:.0f}"

    @event.listens_for(engine, "connect")
    def limit_transactions(connection: psycopg.Connection[Any], _record: object) -> None:
        names = ["idle_in_transaction_session_timeout"]
        if connection.info.server_version >= _TRANSACTION_TIMEOUT_SINCE:
            names.append("transaction_timeout")
        for name in names:
            connection.execute("SELECT set_config(%s, %s, false)", (name, limit))
        connection.commit()

    @event.listens_for(engine, "handle_error", retval=True)
    def tell_the_limit_from_a_mistake(context: ExceptionContext) -> Exception | None:
        # The driver files a transaction that lasted too long under internal errors, as it does a wrong use of one. All
        # that happened is that this process slept: the next try succeeds, or says that the lease is lost.
        error = context.original_exception
        if not isinstance(error, _TOO_LONG):
            return None
        context.is_disconnect = True
        return OperationalError(context.statement, context.parameters, error, connection_invalidated=True)

    return engine
