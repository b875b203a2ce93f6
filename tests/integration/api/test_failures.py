"""Failures of what the API depends on, and of the API itself."""

from __future__ import annotations

import http.client
import json
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest
from sqlalchemy import Engine, text


@pytest.fixture
def set_read_only(engine: Engine) -> Iterator[Callable[[bool], None]]:
    """Make the database read-only, as after a failover, or writable again."""

    def switch(on: bool) -> None:
        with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            name = connection.scalar(text("SELECT current_database()"))
            connection.execute(text("SET transaction_read_only = off"))
            change = "SET default_transaction_read_only = on" if on else "RESET default_transaction_read_only"
            connection.execute(text(f'ALTER DATABASE "{name}" {change}'))
            # The server that answers after a failover is another one.
            others = "pid <> pg_backend_pid() AND datname = current_database()"
            connection.execute(text(f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE {others}"))

    yield switch
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
    assert client.get(f"/jobs/{job}").status_code == 200, "it can be read"
    ready = client.get("/readyz")
    assert (ready.status_code, ready.json()["database"]) == (503, "failed")
    set_read_only(False)
    assert client.post(f"/jobs/{job}/cancel").status_code in (200, 503)
    assert client.post(f"/jobs/{job}/cancel").status_code == 200, "a new connection reaches the new server"


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
