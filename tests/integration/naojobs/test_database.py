"""Connections to a real Postgres."""

from __future__ import annotations

import asyncio
import ctypes
import os
import resource
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from urllib.parse import parse_qs, unquote, urlsplit

import psycopg
import pytest
from naojobs import connections
from naojobs.database import CHANNEL, is_outage, make_engine, make_sessions, notify
from naojobs.settings import ServiceSettings
from naojobs.tokens import Scope, create_token, list_tokens
from naosprint_api.broadcast import Broadcaster
from sqlalchemy import text
from sqlalchemy.exc import DataError, OperationalError
from sqlalchemy.orm import Session, sessionmaker

Sessions = sessionmaker[Session]

_SO_ATTACH_FILTER = 26
"""Option of a socket (asm-generic/socket.h): a classic BPF program, which returns the length to take of each packet."""


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


def test_errors_of_a_read_only_database_do_not_repeat_parameters_either(sessions: Sessions) -> None:
    with pytest.raises(OperationalError) as caught, sessions.begin() as session:
        session.execute(text("SET TRANSACTION READ ONLY"))
        session.execute(text("UPDATE services SET key = :secret"), {"secret": "whsec_aGlk"})
    assert is_outage(caught.value) and "read-only" in str(caught.value) and "whsec" not in str(caught.value)


def test_lists_stay_in_order_when_the_clock_of_a_host_is_wrong(database_url: str, sessions: Sessions) -> None:
    program = (
        "import sys, time; now = time.time_ns; time.time_ns = lambda: now() + 10**17\n"
        "from naojobs.database import make_engine, make_sessions\n"
        "from naojobs.tokens import Scope, create_token\n"
        "create_token(make_sessions(make_engine(sys.argv[1])), name='ahead', owner='order', scopes=[Scope.READ])\n"
    )
    url = database_url.replace("postgresql://", "postgresql+psycopg://", 1)
    subprocess.run([sys.executable, "-c", program, url], check=True)
    create_token(sessions, name="right", owner="order", scopes=[Scope.READ])
    assert [token.name for token in list_tokens(sessions, "order")] == ["ahead", "right"]


class Relay:
    """A relay to the database whose host can fall silent: it then acknowledges nothing that reaches it."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        self._socket = f"{unquote(parse_qs(parts.query)['host'][0])}/.s.PGSQL.5432"
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"postgresql://postgres@127.0.0.1:{self._listener.getsockname()[1]}{parts.path}"
        self._open: list[socket.socket] = [self._listener]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                server = socket.socket(socket.AF_UNIX)
                server.connect(self._socket)
                self._open += (client, server)
                for ends in ((client, server), (server, client)):
                    threading.Thread(target=self._carry, args=ends, daemon=True).start()

    @staticmethod
    def _carry(source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                target.sendall(data)

    def fall_silent(self) -> None:
        """Make the kernel drop all packets of clients before it takes note of them, as if a cable was pulled."""
        drop_all = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0))  # a filter that returns 0
        program = struct.pack("HP", 1, ctypes.addressof(drop_all))
        for end in self._open[1:]:
            if end.family == socket.AF_INET:
                end.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)

    def close(self) -> None:
        for end in self._open:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()


@pytest.fixture
def relay(database_url: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Relay]:
    """A relay, with bounds of a tenth."""
    short = {"keepalives_idle": 1, "keepalives_interval": 1, "keepalives_count": 2, "tcp_user_timeout": 2_000}
    monkeypatch.setattr(connections, "BOUNDS", {**connections.BOUNDS, **short})
    relay = Relay(database_url)
    yield relay
    relay.close()


@pytest.mark.skipif(sys.platform != "linux", reason="filters of sockets are Linux's")
def test_a_statement_to_a_silent_host_fails_soon(relay: Relay) -> None:
    engine = make_engine(relay.url.replace("postgresql://", "postgresql+psycopg://", 1), pool_size=1)
    try:
        with engine.connect() as connection:
            connection.execute(text("SELECT 1"))
            relay.fall_silent()
            began = time.monotonic()
            with pytest.raises(OperationalError) as caught:
                connection.execute(text("SELECT 2"))
            assert caught.value.connection_invalidated
            assert time.monotonic() - began < 15  # without the bound a quarter of an hour
    finally:
        engine.dispose()


@pytest.mark.skipif(sys.platform != "linux", reason="filters of sockets are Linux's")
def test_a_listener_to_a_silent_host_polls_soon(relay: Relay) -> None:
    """It sends nothing, so that only keepalives find out."""

    async def listens(broadcaster: Broadcaster, wanted: bool) -> None:
        async with asyncio.timeout(30):
            while broadcaster._listening is not wanted:
                await asyncio.sleep(0.05)

    async def run() -> None:
        broadcaster = Broadcaster(relay.url)
        await broadcaster.start()
        try:
            await listens(broadcaster, True)
            relay.fall_silent()
            await listens(broadcaster, False)
        finally:
            await broadcaster.stop()

    asyncio.run(run())
