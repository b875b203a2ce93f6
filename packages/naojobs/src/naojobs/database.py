"""Access to the database: engine, sessions, migrations and notifications."""

from __future__ import annotations

import logging
import re
import select
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import psycopg
from pydantic_core import PydanticSerializationError, from_json, to_json
from sqlalchemy import ColumnElement, Connection, Engine, create_engine, event, func, or_, text
from sqlalchemy.exc import DBAPIError, InterfaceError, InvalidatePoolError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.orm import Session, SessionTransaction, sessionmaker
from sqlalchemy.pool import ConnectionPoolEntry, NullPool

from naojobs import ids
from naojobs.connections import bounds

# Alembic is imported where it is used: every trainer imports this module and none migrates.
if TYPE_CHECKING:
    from alembic.config import Config
    from sqlalchemy.engine import ExceptionContext

_log = logging.getLogger(__name__)

CHANNEL = "naosprint_jobs"
"""The channel on which every committed change of a job is notified; the payload is the job's id
(and behind a blank the owner, if the job was deleted).
"""
_CHANGED, _COMMITTED = "naojobs.changed", "naojobs.committed"
"""Keys of a session's notes: the jobs that its transaction, and its committed one, has changed."""
_NOTIFY = text(
    "SELECT set_config('synchronous_commit', 'off', true), pg_notify(:channel, job) "
    "FROM unnest(CAST(:changed AS text[])) AS job"
)

REVISION = "0031"
"""The revision of the schema that this code is written for."""

_MIGRATION_LOCK = 0x6E616F
"""Key of the lock against two migrations at once."""

_TRANSACTION_TIMEOUT_SINCE = 170_000
"""The first version of Postgres that can limit a transaction as a whole."""

_UNSTORABLE = re.compile("[\x00\ud800-\udfff]")

_TOO_LONG = (psycopg.errors.TransactionTimeout, psycopg.errors.IdleInTransactionSessionTimeout)

Sessions: TypeAlias = sessionmaker[Session]


def is_due(column: Any, longest_s: float) -> ColumnElement[bool]:
    """Return whether a time has come that was set at most ``longest_s`` seconds ahead.

    One that is further ahead was set before the database's clock was set back; it has come as well.
    """
    return or_(column <= func.now(), column > func.now() + timedelta(seconds=longest_s))


def is_outage(error: Exception) -> bool:
    """Return whether an error says that the database does not answer, or that its disk has no room for any change.

    Others are about one statement, as for a lock, or about one transaction, which took too long.
    """
    if isinstance(error, DBAPIError) and not isinstance(error.orig, _TOO_LONG):
        unsent = isinstance(error, OperationalError | InterfaceError) and getattr(error.orig, "sqlstate", None) is None
        return error.connection_invalidated or unsent or isinstance(error.orig, psycopg.errors.DiskFull)
    return isinstance(error, PoolTimeoutError)


def make_engine(url: str, *, pool_size: int = 5, application_name: str = "naosprint") -> Engine:
    """Return an engine for `url` (postgresql+psycopg://...).

    A statement may take 30 s and wait for a lock 10 s, so that a stuck transaction of one process cannot block the
    others; a connection that a restart of Postgres has cut is replaced when it is taken from the pool, and one to a
    host that does not acknowledge what it is sent fails after 20 s.
    """
    engine = create_engine(
        url,
        pool_size=pool_size,
        max_overflow=pool_size,
        pool_recycle=1800,
        pool_timeout=10,
        hide_parameters=True,  # errors are logged, and some parameters are secrets
        json_deserializer=from_json,
        json_serializer=_json,
        connect_args={
            "application_name": application_name,
            **bounds(url),
            "options": "-c statement_timeout=30000 -c lock_timeout=10000 "
            "-c idle_in_transaction_session_timeout=30000 -c timezone=UTC",
        },
    )

    @event.listens_for(engine, "checkout")
    def refuse_cut(connection: psycopg.Connection[Any], _record: object, _proxy: object) -> None:
        # An idle connection has nothing to read unless it has ended: checking its socket saves a query.
        if connection.closed or _has_input(connection.fileno()):
            raise InvalidatePoolError("the server has cut the connection")

    pools = [0]  # how often the engine was closed, which makes another pool

    @event.listens_for(engine, "engine_disposed")
    def count(_engine: Engine) -> None:
        pools[0] += 1

    @event.listens_for(engine, "connect")
    def begin(connection: psycopg.Connection[Any], record: ConnectionPoolEntry) -> None:
        record.info["pool"] = pools[0]
        connection.autocommit = True
        for (now_s,) in connection.execute("SELECT extract(epoch FROM clock_timestamp())"):
            ids.set_clock(float(now_s))  # lists are in the order of ids, and this host's clock may be wrong
        connection.autocommit = False

    @event.listens_for(engine, "checkin")
    def close_late(connection: psycopg.Connection[Any] | None, record: ConnectionPoolEntry) -> None:
        # A connection that a thread returns after the engine was closed ends up in a pool that is not closed again.
        if connection is not None and record.info.get("pool") != pools[0]:
            connection.close()

    @event.listens_for(engine, "before_cursor_execute", retval=True)
    def make_storable(
        _connection: object, _cursor: object, statement: str, parameters: Any, _context: object, _many: bool
    ) -> tuple[str, Any]:
        return statement, storable(parameters)

    @event.listens_for(engine, "handle_error", retval=True)
    def leave_read_only(context: ExceptionContext) -> Exception | None:
        # After a failover, a new connection reaches the new server.
        return _unavailable(context, psycopg.errors.ReadOnlySqlTransaction)

    return engine


def storable(value: Any) -> Any:
    """Return `value` with the characters replaced that the server cannot hold: NUL, and halves of surrogate pairs.

    Every text of every statement passes here, also those within lists and JSON: messages of foreign exceptions, output
    of programs and names of metrics may contain anything, and must not keep the rest from being recorded.
    """
    match value:
        case str():
            return _UNSTORABLE.sub("\N{REPLACEMENT CHARACTER}", value) if _UNSTORABLE.search(value) else value
        case dict():
            return {storable(key): storable(item) for key, item in value.items()}
        case list() | tuple():
            return type(value)([storable(item) for item in value])
    return value


def _json(value: object) -> str:
    # The server refuses NaN, with an error that says so.
    with suppress(PydanticSerializationError):
        if "\\u0000" not in (text := to_json(value, inf_nan_mode="constants").decode()):
            return text
    return to_json(storable(value), inf_nan_mode="constants").decode()


def _has_input(descriptor: int) -> bool:
    """Return whether a socket has something to read, or has ended; `select.select` refuses descriptors above 1,023."""
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return bool(poll.poll(0))


def limit_transactions(engine: Engine, seconds: float) -> None:
    """End every transaction of `engine` that lasts longer than `seconds`, even if this process is frozen.

    A frozen process keeps its connection, and with it the locks on rows: no other could take the work over. The ended
    transaction raises OperationalError.
    """
    limit = f"{seconds * 1000:.0f}"

    @event.listens_for(engine, "connect")
    def set_limits(connection: psycopg.Connection[Any], _record: object) -> None:
        names = ["idle_in_transaction_session_timeout"]
        if connection.info.server_version >= _TRANSACTION_TIMEOUT_SINCE:
            names.append("transaction_timeout")
        for name in names:
            connection.execute("SELECT set_config(%s, %s, false)", (name, limit))
        connection.commit()

    @event.listens_for(engine, "handle_error", retval=True)
    def distinguish_limit(context: ExceptionContext) -> Exception | None:
        # This process has only been suspended: the next attempt succeeds, or the lease is lost.
        return _unavailable(context, *_TOO_LONG)


def _unavailable(context: ExceptionContext, *kinds: type[psycopg.Error]) -> Exception | None:
    """Return errors of these kinds as those of an unavailable database; the driver counts them among internal ones."""
    error = context.original_exception
    if not isinstance(error, kinds):
        return None
    context.is_disconnect = True
    return OperationalError(
        context.statement, context.parameters, error, hide_parameters=True, connection_invalidated=True
    )


def schema_mismatch(session: Session) -> str:
    """Return in words how the database's schema differs from the one of this version; empty if it does not."""
    revision = session.scalar(text("SELECT version_num FROM alembic_version"))
    return "" if revision == REVISION else f"the database has revision {revision}, this version needs {REVISION}"


def make_sessions(engine: Engine, *, read_only: bool = False) -> Sessions:
    """Return a maker of sessions whose objects stay readable after the commit.

    With `read_only`, every statement sees what is committed when it begins, as in any transaction here, but none is
    wrapped in a transaction of its own: reading one row takes one round trip to the server instead of three.
    """
    if read_only:
        engine = engine.execution_options(isolation_level="AUTOCOMMIT")
    sessions = sessionmaker(engine, expire_on_commit=False)
    _notify_after_commits(sessions, engine)
    return sessions


@contextmanager
def one_statement(sessions: Sessions) -> Iterator[Session]:
    """Begin a session in which every statement is a transaction of its own: one round trip to the server, not three."""
    with sessions() as session:
        session.connection(execution_options={"isolation_level": "AUTOCOMMIT"})
        yield session


def _notify_after_commits(sessions: Sessions, engine: Engine) -> None:
    """Send what `notify` was called for when its transaction is committed and its connection is free again.

    Transactions with a notification commit one after the other in the whole database, and each would hold the others
    up while it waits for the disk. The notification is a transaction of its own, which does not wait for the disk. If
    it is lost, followers find the change when they next look by themselves.
    """
    at_once = engine.execution_options(isolation_level="AUTOCOMMIT")

    @event.listens_for(sessions, "after_commit")
    def keep(session: Session) -> None:
        if not session.in_nested_transaction():
            session.info[_COMMITTED] = session.info.pop(_CHANGED, {})

    @event.listens_for(sessions, "after_transaction_end")
    def send(session: Session, transaction: SessionTransaction) -> None:
        if transaction.parent is not None:
            return
        session.info.pop(_CHANGED, None)  # what was rolled back
        if changed := session.info.pop(_COMMITTED, None):
            try:
                with at_once.connect() as connection:
                    connection.execute(_NOTIFY, {"channel": CHANNEL, "changed": list(changed)})
            except SQLAlchemyError as error:
                _log.info("a notification was lost: %s", error)


def notify(session: Session, job_id: str, *, deleted_from: str | None = None) -> None:
    """Notify all listeners of a change of `job_id` once the transaction is committed.

    Nothing of a deleted job is left to look up, so its message also contains its former owner, and is part of the
    transaction: followers could not find the change by themselves.
    """
    if deleted_from is None:
        session.info.setdefault(_CHANGED, {})[job_id] = None
    else:
        payload = f"{job_id} {deleted_from}"
        session.execute(text("SELECT pg_notify(:channel, :payload)"), {"channel": CHANNEL, "payload": payload})


def alembic_config(url: str, migrations: Path) -> Config:
    """Return an Alembic configuration for the scripts in `migrations` and the database at `url`."""
    from alembic.config import Config

    config = Config()
    # "%" begins a reference in such a file
    config.set_main_option("script_location", str(migrations).replace("%", "%%"))
    config.set_main_option("sqlalchemy.url", url.replace("%", "%%"))
    return config


class Migration:
    """Migrations and what is done between them, in one transaction: all of it is kept, or nothing.

    Args:
        connection: where the transaction has begun.
        config: where the scripts are.
    """

    def __init__(self, connection: Connection, config: Config) -> None:
        self._connection = connection
        self._config = config
        config.attributes["connection"] = connection  # migrations/env.py takes it

    @property
    def driver(self) -> psycopg.Connection[Any]:
        """The transaction's connection."""
        driver = self._connection.connection.driver_connection
        assert isinstance(driver, psycopg.Connection)
        return driver

    def upgrade(self, revision: str = "head") -> None:
        """Upgrade the schema to `revision`."""
        from alembic import command

        command.upgrade(self._config, revision)

    def downgrade(self, revision: str) -> None:
        """Downgrade the schema to `revision`; `base` deletes all tables."""
        from alembic import command

        command.downgrade(self._config, revision)


@contextmanager
def migration(url: str, migrations: Path) -> Iterator[Migration]:
    """Begin a transaction with migrations, and end it; another one of the same database waits for it."""
    options = {**bounds(url), "prepare_threshold": None}  # plans do not outlive the tables that they are for
    engine = create_engine(url, poolclass=NullPool, connect_args=options)
    try:
        with engine.begin() as connection:
            connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _MIGRATION_LOCK})
            yield Migration(connection, alembic_config(url, migrations))
    finally:
        engine.dispose()


def upgrade(url: str, migrations: Path, revision: str = "head") -> None:
    """Migrate the database to `revision` and grant its roles their rights; several processes may call it at once."""
    from naojobs.roles import grant_rights

    with migration(url, migrations) as change:
        change.upgrade(revision)
        grant_rights(change.driver)


def downgrade(url: str, migrations: Path, revision: str) -> None:
    """Downgrade the database to `revision`; `base` empties it."""
    with migration(url, migrations) as change:
        change.downgrade(revision)
