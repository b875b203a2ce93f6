"""The way to the database: engine, sessions, migrations and notifications."""

from __future__ import annotations

import select
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psycopg
from sqlalchemy import Engine, create_engine, event, text
from sqlalchemy.exc import InvalidatePoolError
from sqlalchemy.orm import Session, sessionmaker

# Alembic is imported where it is used: every trainer imports this module and none migrates.
if TYPE_CHECKING:
    from alembic.config import Config

#: The channel on which every committed change of a job is told; the payload is the job's id
#: (and behind a blank the owner, if the job was deleted).
CHANNEL = "naosprint_jobs"

#: The revision of the schema that this code is written for.
REVISION = "0001"

#: What the lock against two migrations at once is keyed by.
_MIGRATION_LOCK = 0x6E616F


def make_engine(url: str, *, pool_size: int = 5, application_name: str = "naosprint") -> Engine:
    """Return an engine for `url` (postgresql+psycopg://...).

    A statement may take 30 s and wait for a lock 10 s, so that a stuck transaction of one process cannot
    silence the others; a connection that a restart of Postgres has cut is replaced when it is taken from the pool.
    """
    engine = create_engine(
        url,
        pool_size=pool_size,
        max_overflow=pool_size,
        pool_recycle=1800,
        pool_timeout=10,
        connect_args={
            "application_name": application_name,
            "connect_timeout": 5,
            "keepalives_idle": 10,
            "keepalives_interval": 5,
            "keepalives_count": 3,
            "options": "-c statement_timeout=30000 -c lock_timeout=10000 "
            "-c idle_in_transaction_session_timeout=30000 -c timezone=UTC",
        },
    )

    @event.listens_for(engine, "checkout")
    def refuse_cut(connection: psycopg.Connection[Any], _record: object, _proxy: object) -> None:
        # Nobody speaks on an idle connection unless it ends: a look at its socket saves asking the server each time.
        if connection.closed or select.select([connection.fileno()], [], [], 0)[0]:
            raise InvalidatePoolError("the server has cut the connection")

    return engine


def make_sessions(engine: Engine, *, read_only: bool = False) -> sessionmaker[Session]:
    """Return a maker of sessions whose objects stay readable after the commit.

    With `read_only`, every statement sees what is committed when it begins, as in any transaction here, but none is
    wrapped in a transaction of its own: a look at one row is one round trip to the server instead of three.
    """
    if read_only:
        engine = engine.execution_options(isolation_level="AUTOCOMMIT")
    return sessionmaker(engine, expire_on_commit=False)


def notify(session: Session, job_id: str, *, deleted_from: str | None = None) -> None:
    """Tell all listeners once the transaction is committed that `job_id` has changed.

    Of a deleted job nothing is left to look up, so its message also names the owner that it was deleted from.
    """
    payload = job_id if deleted_from is None else f"{job_id} {deleted_from}"
    session.execute(text("SELECT pg_notify(:channel, :payload)"), {"channel": CHANNEL, "payload": payload})


def alembic_config(url: str, migrations: Path) -> Config:
    """Return an Alembic configuration for the scripts in `migrations` and the database at `url`."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(migrations))
    config.set_main_option("sqlalchemy.url", url.replace("%", "%%"))
    return config


@contextmanager
def _migration_lock(url: str) -> Iterator[None]:
    engine = create_engine(url, connect_args={"connect_timeout": 5})
    try:
        with engine.connect() as connection:
            connection.execute(text("SELECT pg_advisory_lock(:key)"), {"key": _MIGRATION_LOCK})
            yield
    finally:
        engine.dispose()


def upgrade(url: str, migrations: Path, revision: str = "head") -> None:
    """Bring the database to `revision`; several processes may call it at once."""
    from alembic import command

    with _migration_lock(url):
        command.upgrade(alembic_config(url, migrations), revision)


def downgrade(url: str, migrations: Path, revision: str) -> None:
    """Take the database back to `revision`; `base` empties it."""
    from alembic import command

    with _migration_lock(url):
        command.downgrade(alembic_config(url, migrations), revision)
