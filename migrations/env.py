"""Alembic's environment: database and models."""

from __future__ import annotations

import os

from alembic import context
from naojobs.connections import bounds
from naojobs.models import Base
from sqlalchemy import Connection, create_engine, pool


def database_url() -> str:
    """Return the URL that the caller configured, else that of the environment."""
    url = context.config.get_main_option("sqlalchemy.url") or os.environ.get("NAOSPRINT_DATABASE_URL", "")
    if not url:
        raise SystemExit("NAOSPRINT_DATABASE_URL: not set; e.g. postgresql://user:password@host:5432/naosprint")
    return "postgresql+psycopg://" + url.split("://", 1)[1]


def run(connection: Connection) -> None:
    """Run the migrations; the transaction of a connection that has begun one is left to its caller."""
    context.configure(connection=connection, target_metadata=Base.metadata, compare_server_default=True)
    with context.begin_transaction():
        context.run_migrations()


if context.is_offline_mode():
    context.configure(url=database_url(), target_metadata=Base.metadata, literal_binds=True)
    with context.begin_transaction():
        context.run_migrations()
elif "connection" in context.config.attributes:
    run(context.config.attributes["connection"])  # that of naojobs.database.Migration
else:
    engine = create_engine(database_url(), poolclass=pool.NullPool, connect_args=bounds(database_url()))
    with engine.connect() as connection:
        run(connection)
    engine.dispose()
