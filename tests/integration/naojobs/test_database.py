"""Connections to a real Postgres."""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator

import psycopg
import pytest
from naojobs.database import CHANNEL, make_engine, make_sessions, notify
from naojobs.settings import ServiceSettings
from sqlalchemy import text
from sqlalchemy.exc import DataError
from sqlalchemy.orm import Session, sessionmaker

Sessions = sessionmaker[Session]


@pytest.fixture
def many_descriptors() -> Iterator[None]:
    """Use every descriptor below 1,100, like a service with many followers."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < 2048:
        resource.setrlimit(resource.RLIMIT_NOFILE, (2048, hard))
    taken = [os.open(os.devnull, os.O_RDONLY)]
    while taken[-1] < 1100:
        taken.append(os.dup(taken[0]))
    yield
    for descriptor in taken:
        os.close(descriptor)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.usefixtures("many_descriptors")
def test_connections_with_large_descriptors_are_used_again(service_settings: ServiceSettings) -> None:
    engine = make_engine(service_settings.sqlalchemy_url, pool_size=1)
    try:
        for _ in range(2):
            with make_sessions(engine)() as session:
                assert session.connection().connection.driver_connection.fileno() > 1023  # type: ignore[union-attr]
                assert session.scalar(text("SELECT 1")) == 1
    finally:
        engine.dispose()


def test_a_connection_that_is_returned_after_the_engine_was_closed_is_closed(database_url: str) -> None:
    """A thread whose request was given up may still use one while the service stops."""
    engine = make_engine(database_url)
    with engine.connect() as first, engine.connect() as second:
        engine.dispose()
        late = [connection.connection.driver_connection for connection in (first, second)]
    assert [connection is not None and connection.closed for connection in late] == [True, True]
    with engine.connect() as again:  # an engine may be used after it was closed
        kept = again.connection.driver_connection
        assert kept is not None
    assert not kept.closed
    engine.dispose()
    assert kept.closed


def test_notifications_follow_commits_and_only_those(sessions: Sessions, database_url: str) -> None:
    with psycopg.connect(database_url, autocommit=True) as listener, sessions() as session:
        listener.execute(f"LISTEN {CHANNEL}")
        session.execute(text("SELECT 1"))
        notify(session, "rolled back")
        session.rollback()
        notify(session, "job_1")
        notify(session, "job_1")
        notify(session, "job_2")
        with session.begin_nested():
            notify(session, "job_3")
        assert list(listener.notifies(timeout=0, stop_after=1)) == []
        session.commit()
        notify(session, "job_4", deleted_from="alice")
        session.commit()
        received = [message.payload for message in listener.notifies(timeout=30, stop_after=4)]
    assert received == ["job_1", "job_2", "job_3", "job_4 alice"]


def test_a_notification_that_fails_leaves_the_commit(sessions: Sessions) -> None:
    with sessions.begin() as session:
        session.execute(text("CREATE TABLE kept (x integer)"))
        notify(session, "x" * 9_000)  # longer than the server takes
    with sessions.begin() as session:
        assert session.execute(text("SELECT count(*) FROM kept")).scalar_one() == 0
        session.execute(text("DROP TABLE kept"))


def test_errors_do_not_repeat_parameters(sessions: Sessions) -> None:
    """They are logged, and secrets of webhooks are parameters."""
    with pytest.raises(DataError) as caught, sessions.begin() as session:
        session.execute(text("SELECT 1 / 0, cast(:secret AS text)"), {"secret": "whsec_aGlk"})
    assert "division by zero" in str(caught.value) and "whsec" not in str(caught.value)
