"""Failures of what the API depends on, and of the API itself."""

from __future__ import annotations

import http.client
import json
import logging
import queue
import socket
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest
from naojobs.database import REVISION
from sqlalchemy import Engine, create_engine, text


@pytest.fixture
def set_read_only(engine: Engine) -> Iterator[Callable[[bool], None]]:
    """Make the database read-only, as after a failover, or writable again."""
    switched = [False]

    def switch(on: bool) -> None:
        switched.append(on)
        with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            name = connection.scalar(text("SELECT current_database()"))
            connection.execute(text("SET transaction_read_only = off"))
            change = "SET default_transaction_read_only = on" if on else "RESET default_transaction_read_only"
            connection.execute(text(f'ALTER DATABASE "{name}" {change}'))
            # The server that answers after a failover is another one.
            others = "pid <> pg_backend_pid() AND datname = current_database()"
            connection.execute(text(f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE {others}"))

    yield switch
    if switched[-1]:  # else the service has new connections already, which the next test uses
        switch(False)
    engine.dispose()


def test_a_database_that_became_read_only_is_one_that_is_away(
    client: httpx.Client, admin: httpx.Client, set_read_only: Callable[[bool], None]
) -> None:
    job = client.post("/jobs", json={}).json()["id"]
    set_read_only(True)
    for method, path, body in (
        ("POST", "/jobs", {}),
        ("PATCH", f"/jobs/{job}", {"notes": "x"}),
        ("POST", f"/jobs/{job}/cancel", None),
        ("POST", f"/jobs/{job}/share", None),
        ("POST", "/webhooks", {"url": "https://example.org/", "events": ["job.ended"]}),
    ):
        answer = client.request(method, path, json=body)
        assert (answer.status_code, "retry-after" in answer.headers) == (503, True), (path, answer.text)
        assert "it can be read" in answer.json()["detail"]
    assert client.get(f"/jobs/{job}").status_code == 200, "it can be read"
    ready = client.get("/readyz")
    assert (ready.status_code, ready.json()["database"]) == (503, "failed")
    set_read_only(False)
    assert client.post(f"/jobs/{job}/cancel").status_code in (200, 503)
    assert client.post(f"/jobs/{job}/cancel").status_code == 200, "a new connection reaches the new server"


@pytest.fixture
def migrate(engine: Engine) -> Iterator[Callable[[str], None]]:
    """Rename a column of jobs, as a migration of another version may, and record that version's revision."""

    def rename(revision: str, old: str, new: str) -> None:
        with engine.begin() as connection:
            connection.execute(text(f"ALTER TABLE jobs RENAME COLUMN {old} TO {new}"))
            connection.execute(text("UPDATE alembic_version SET version_num = :revision"), {"revision": revision})

    yield lambda revision: rename(revision, "notes", "remarks")
    rename(REVISION, "remarks", "notes")


@pytest.mark.parametrize(("revision", "status"), [("9999", 503), (REVISION, 500)])
def test_a_database_of_another_version_is_named(
    client: httpx.Client, migrate: Callable[[str], None], revision: str, status: int
) -> None:
    """After an upgrade of the database an API of the version before may still be asked; all else is a defect."""
    job = client.post("/jobs", json={}).json()["id"]
    migrate(revision)
    for method, path, body in (("GET", f"/jobs/{job}", None), ("POST", "/jobs", {}), ("GET", "/jobs", None)):
        answer = client.request(method, path, json=body)
        assert (answer.status_code, "retry-after" in answer.headers) == (status, status == 503), (path, answer.text)
        assert (f"revision 9999, this version needs {REVISION}" in answer.json()["detail"]) is (status == 503)


def test_a_full_disk_of_the_database_is_named(client: httpx.Client, engine: Engine) -> None:
    with engine.begin() as connection:
        body = "$$ BEGIN RAISE EXCEPTION USING ERRCODE = 'disk_full'; END $$"
        connection.execute(text(f"CREATE FUNCTION fill() RETURNS trigger LANGUAGE plpgsql AS {body}"))
        connection.execute(text("CREATE TRIGGER full_disk BEFORE INSERT ON jobs EXECUTE FUNCTION fill()"))
    try:
        answer = client.post("/jobs", json={})
        assert (answer.status_code, "retry-after" in answer.headers) == (503, True)
        assert "disk is full" in answer.json()["detail"]
        assert client.get("/jobs").status_code == 200
    finally:
        with engine.begin() as connection:
            connection.execute(text("DROP FUNCTION fill CASCADE"))


def test_an_outage_of_the_database_cuts_a_stream_and_is_one_line_of_the_log(
    client: httpx.Client, engine: Engine, caplog: pytest.LogCaptureFixture
) -> None:
    name = engine.url.database
    elsewhere = create_engine(engine.url.set(database="postgres"), isolation_level="AUTOCOMMIT")
    with elsewhere.connect() as server:
        try:
            with pytest.raises(httpx.RemoteProtocolError), client.stream("GET", "/jobs/stream") as answer:
                for number, _ in enumerate(answer.iter_lines()):
                    if number == 0:
                        server.execute(text(f'ALTER DATABASE "{name}" ALLOW_CONNECTIONS false'))
                        cut = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = :name"
                        server.execute(text(cut), {"name": name})
        finally:
            server.execute(text(f'ALTER DATABASE "{name}" ALLOW_CONNECTIONS true'))
    elsewhere.dispose()
    assert len([record for record in caplog.records if "/jobs/stream failed" in record.getMessage()]) == 1
    assert not [record for record in caplog.records if record.exc_info]


@pytest.mark.parametrize(("method", "body"), [("GET", None), ("POST", {"url": "https://example.org/"})])
def test_an_internal_error_leaves_the_connection_usable(
    api: Any, make_token: Callable[..., str], engine: Engine, method: str, body: dict[str, str] | None
) -> None:
    connection = http.client.HTTPConnection(api.url.removeprefix("http://"), timeout=20)
    connection.connect()
    connection.auto_open = 0
    headers = {"Authorization": f"Bearer {make_token('alice', 'submit')}", "Content-Type": "application/json"}
    with engine.begin() as session:
        session.execute(text("ALTER TABLE webhooks RENAME TO hidden"))
    try:
        for _ in range(2):
            content = json.dumps(body | {"events": ["job.ended"]}) if body else None
            connection.request(method, "/webhooks", content, headers)
            answer = connection.getresponse()
            problem = json.load(answer)
            assert (answer.status, problem["status"], "SELECT" in str(problem)) == (500, 500, False)
            assert answer.headers["x-request-id"]
        connection.request("GET", "/whoami", headers=headers)
        assert connection.getresponse().status == 200
    finally:
        connection.close()
        with engine.begin() as session:
            session.execute(text("ALTER TABLE hidden RENAME TO webhooks"))


@pytest.mark.parametrize("path", ["PUT /teams/x", "POST /jobs/job_x/cancel", "POST /jobs"])
@pytest.mark.parametrize("known", [True, False])
def test_a_client_that_leaves_in_the_middle_of_a_body_is_no_failure_of_the_service(
    api: Any, make_token: Callable[..., str], caplog: pytest.LogCaptureFixture, path: str, known: bool
) -> None:
    """Such answers would count as internal errors, of which operators are alerted, and need no token."""
    lines: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
    handler = logging.Handler()
    handler.emit = lines.put  # type: ignore[method-assign]
    access = logging.getLogger("naosprint_api.access")
    caplog.set_level(logging.INFO)
    head = f"{path} HTTP/1.1\r\nHost: x\r\nContent-Type: application/octet-stream\r\nContent-Length: 100000\r\n"
    token = f"Authorization: Bearer {make_token('root', 'admin')}\r\n" if known else ""
    host, port = api.url.removeprefix("http://").split(":")
    access.addHandler(handler)
    try:
        with socket.create_connection((host, int(port))) as connection:
            connection.sendall(f"{head}{token}\r\nabc".encode())
        line = lines.get(timeout=30)
    finally:
        access.removeHandler(handler)
    assert lines.empty()
    assert 400 <= int(line.args[2]) < 500  # type: ignore[index,arg-type]
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


def test_an_address_that_is_no_proxy_cannot_name_another(start_api: Callable[..., Any]) -> None:
    api = start_api(api_rate_per_s=0.01, api_rate_burst=2)
    headers = {"Authorization": "Bearer nao_unknown"}
    with httpx.Client(base_url=api.url, headers=headers) as stranger:
        answers = [
            stranger.get("/jobs", headers={name: f"203.0.113.{number}"}).status_code
            for number, name in enumerate(("X-Forwarded-For", "X-Forwarded-For", "X-Forwarded-For", "Forwarded"))
        ]
    assert answers == [401, 401, 429, 429]
    behind = start_api(api_rate_per_s=0.01, api_rate_burst=2, api_trusted_proxies="127.0.0.1")
    with httpx.Client(base_url=behind.url, headers=headers) as proxy:
        for number in range(4):
            assert proxy.get("/jobs", headers={"X-Forwarded-For": f"203.0.113.{number}"}).status_code == 401


def test_the_api_bounds_connections_and_heads(start_api: Callable[..., Any]) -> None:
    host, port = start_api(api_max_connections_per_address=2).url.removeprefix("http://").split(":")
    head = b"GET /healthz HTTP/1.1\r\nHost: x\r\n"
    held = [socket.create_connection((host, int(port)), timeout=20) for _ in range(2)]
    for connection in held:
        connection.sendall(head + b"\r\n")
        assert b" 200 " in connection.recv(4096)
    with socket.create_connection((host, int(port)), timeout=20) as one_more:
        assert b" 503 " in one_more.recv(4096)
    try:
        for piece in (head, *([b"a: " + b"b" * 1000 + b"\r\n"] * 1_000)):
            held[0].sendall(piece)
        refused = held[0].recv(4096)
    except ConnectionError:
        refused = b""
    assert refused[:12] in (b"", b"HTTP/1.1 400", b"HTTP/1.1 431")
    for connection in held:
        connection.close()
