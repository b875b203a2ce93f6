"""Names, notes, links to one job, reports that open without a token, and compressed answers."""

from __future__ import annotations

import hashlib
import hmac
import time
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest
from naojobs import outcomes, records
from naojobs.leases import Lease
from naojobs.models import Evaluation, Log, Token
from naojobs.states import WorkState
from naojobs.store import ArtifactStore
from sqlalchemy import select, update
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work
from tests.integration.writes import request_evaluation


def submit(client: httpx.Client, **body: Any) -> str:
    job_id: str = client.post("/jobs", json={"evaluation": None, **body}).json()["id"]
    return job_id


@pytest.fixture
def with_token(api: Any) -> Iterator[Callable[[str], httpx.Client]]:
    """Make a client of a token's secret."""
    clients: list[httpx.Client] = []

    def make(secret: str) -> httpx.Client:
        clients.append(httpx.Client(base_url=api.url, headers={"Authorization": f"Bearer {secret}"}, timeout=20))
        return clients[-1]

    yield make
    for client in clients:
        client.close()


def test_name_tags_and_notes_can_be_changed(client: httpx.Client) -> None:
    first, second = submit(client, name="to-rename"), submit(client, name="taken")
    path = f"/jobs/{first}"
    before = client.get(path).json()
    assert before["notes"] == ""
    changed = client.patch(path, json={"name": "renamed", "notes": "Slips on\nthe left foot."}).json()
    assert (changed["name"], changed["notes"], changed["tags"]) == ("renamed", "Slips on\nthe left foot.", [])
    assert changed["updated_at"] > before["updated_at"]
    assert client.patch(path, json={"tags": ["good"]}).json()["name"] == "renamed"
    assert client.patch(path, json={"tags": []}).json()["tags"] == []
    taken = client.patch(path, json={"name": "taken"})
    assert (taken.status_code, taken.json()["errors"][0]["field"]) == (409, "name")
    assert client.patch(path, json={"name": "renamed"}).status_code == 200, "its own name is not taken"
    for body, field in (({"name": ""}, "name"), ({"notes": "\x00"}, "notes"), ({"state": "failed"}, "state")):
        refused = client.patch(path, json=body)
        assert (refused.status_code, [e["field"] for e in refused.json()["errors"]]) == (422, [field])
    assert client.get(f"/jobs/{second}").json()["name"] == "taken"


def test_only_the_owner_changes_or_shares_a_job(client: httpx.Client, make_client: Callable[..., httpx.Client]) -> None:
    job_id = submit(client)
    mallory, reader = make_client("mallory", "submit"), make_client("alice", "read")
    for method, path in (("PATCH", ""), ("POST", "/share"), ("DELETE", "/share")):
        assert mallory.request(method, f"/jobs/{job_id}{path}", json={}).status_code == 404
        assert reader.request(method, f"/jobs/{job_id}{path}", json={}).status_code == 403


def test_a_link_shows_one_job_and_changes_nothing(
    client: httpx.Client, with_token: Callable[[str], httpx.Client], run_job: Callable[..., Lease], sessions: Any
) -> None:
    shared, other = submit(client, name="shared"), submit(client, name="other")
    made = client.post(f"/jobs/{shared}/share", json={"expires_in_days": 7})
    assert made.status_code == 201
    guest = with_token(made.json()["token"])
    who = guest.get("/whoami").json()
    assert (who["owner"], who["scopes"], who["job_id"]) == ("alice", ["read"], shared)
    assert guest.get(f"/jobs/{shared}").json()["name"] == "shared"
    assert [job["id"] for job in guest.get("/jobs").json()["items"]] == [shared]
    assert guest.get(f"/jobs/{shared}/metrics").status_code == 200
    for path in ("", "/metrics", "/logs", "/events", "/checkpoints", "/evaluations", "/stream"):
        assert guest.get(f"/jobs/{other}{path}").status_code == 404, path
    lease = run_job()
    assert all(worker["jobs"] == [] for worker in guest.get("/workers").json()["items"]), lease.job_id
    assert guest.post(f"/jobs/{shared}/cancel").status_code == 403
    assert guest.post(f"/jobs/{shared}/share").status_code == 403
    assert client.delete(f"/jobs/{shared}/share").status_code == 204
    assert guest.get(f"/jobs/{shared}").status_code == 401


def test_a_link_ends_with_its_job(client: httpx.Client, with_token: Callable[[str], httpx.Client]) -> None:
    job_id = submit(client)
    guest = with_token(client.post(f"/jobs/{job_id}/share").json()["token"])
    client.post(f"/jobs/{job_id}/cancel")
    assert client.delete(f"/jobs/{job_id}").status_code == 204
    assert guest.get("/whoami").status_code == 401


@pytest.fixture
def finished_report(
    run_job: Callable[..., Lease],
    save_checkpoint: Callable[..., str],
    sessions: sessionmaker[Session],
    store: ArtifactStore,
) -> str:
    """The id of a finished evaluation with a report."""
    lease = run_job()
    save_checkpoint(lease, 512, {"checkpoint.json": b"{}"})
    row = request_evaluation(sessions, lease.job_id)
    claim = claim_work(sessions, Evaluation, row.id, "w")
    assert claim is not None
    outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
    key = f"jobs/{lease.job_id}/evaluations/{row.id}-1"
    files = [store.put_bytes(f"{key}/report.html", b"<p>results</p>").model_dump()]
    records.record_result(sessions, claim.lease, summary={}, key=key, manifest={"files": files})
    outcomes.transition(sessions, claim.lease, WorkState.SUCCEEDED)
    return row.id


def test_a_report_opens_without_a_token_and_runs_nothing(
    client: httpx.Client,
    make_client: Callable[..., httpx.Client],
    run_job: Callable[..., Lease],
    save_checkpoint: Callable[..., str],
    sessions: sessionmaker[Session],
    finished_report: str,
) -> None:
    lease = run_job()
    save_checkpoint(lease, 512, {"checkpoint.json": b"{}"})
    waiting = request_evaluation(sessions, lease.job_id)
    assert client.post(f"/evaluations/{waiting.id}/report").status_code == 404, "it has not finished"
    opens = f"/evaluations/{finished_report}/report"
    assert make_client("mallory", "read").post(opens).status_code == 404
    url = client.post(opens).json()["url"]
    page = httpx.get(client.base_url.join(url))
    assert (page.status_code, page.text) == (200, "<p>results</p>")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    assert page.headers["cache-control"] == "no-store", "no copy outlives the address"
    policy = page.headers["content-security-policy"]
    assert policy.startswith("sandbox")
    assert "allow-scripts" not in policy
    assert "default-src 'none'" in policy
    ticket = url.rpartition("/")[2]
    token_id, expires, signature = ticket.split(".")
    for forged in (
        f"{token_id}.{int(expires) + 1}.{signature}",
        f"{token_id}.1.{signature}",
        f"{token_id}.{expires}.{signature[::-1]}",
        f"{token_id}x.{expires}.{signature}",
    ):
        assert httpx.get(client.base_url.join(f"{opens}/{forged}")).status_code == 404


@pytest.mark.parametrize("ahead_s", [300, -700])
def test_a_ticket_opens_at_a_process_whose_clock_is_another(
    ahead_s: int, client: httpx.Client, finished_report: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = time.time
    with monkeypatch.context() as patch:
        patch.setattr(time, "time", lambda: now() + ahead_s)
        url = client.post(f"/evaluations/{finished_report}/report").json()["url"]
    assert httpx.get(client.base_url.join(url)).status_code == 200


def test_no_token_signs_a_ticket_by_itself(
    client: httpx.Client,
    make_client: Callable[..., httpx.Client],
    finished_report: str,
    sessions: sessionmaker[Session],
) -> None:
    """A caller can compute the hash of its own token, so the hash must not be the key."""
    mallory = make_client("mallory", "read")
    secret = mallory.headers["Authorization"].removeprefix("Bearer ")
    digest = hashlib.sha256(secret.encode()).hexdigest()
    with sessions() as session:
        token_id = session.scalars(select(Token.id).where(Token.sha256 == digest)).one()
    for lifetime in (60, 10**9):
        expires = str(int(time.time()) + lifetime)
        text = f"{finished_report} {token_id} {expires}".encode()
        for key in (digest, secret, token_id):
            signature = hmac.new(key.encode(), text, hashlib.sha256).hexdigest()
            path = f"/evaluations/{finished_report}/report/{token_id}.{expires}.{signature}"
            assert httpx.get(client.base_url.join(path)).status_code == 404


def test_a_ticket_ends_with_its_token_and_with_access_to_the_job(
    client: httpx.Client, finished_report: str, sessions: sessionmaker[Session], store: ArtifactStore
) -> None:
    with sessions() as session:
        job_id = session.get_one(Evaluation, finished_report).job_id
    # a link to the job is a token as well, so its holder may open the report as long as the link is valid
    shared = client.post(f"/jobs/{job_id}/share", json={}).json()["token"]
    opens = f"/evaluations/{finished_report}/report"
    with httpx.Client(base_url=client.base_url, headers={"Authorization": f"Bearer {shared}"}) as guest:
        url = guest.post(opens).json()["url"]
    page = str(client.base_url.join(url))
    assert httpx.get(page).status_code == 200
    token_id = url.rpartition("/")[2].partition(".")[0]
    with sessions.begin() as session:
        other = client.post("/jobs", json={"evaluation": None}).json()["id"]
        session.execute(update(Token).where(Token.id == token_id).values(job_id=other))
    assert httpx.get(page).status_code == 404, "the token no longer sees this job"
    with sessions.begin() as session:
        session.execute(update(Token).where(Token.id == token_id).values(job_id=job_id))
    assert httpx.get(page).status_code == 200
    client.delete(f"/jobs/{job_id}/share")
    assert httpx.get(page).status_code == 404, "the token was revoked"


def test_json_is_compressed_and_downloads_and_streams_are_not(
    client: httpx.Client, run_job: Callable[..., Lease], save_checkpoint: Callable[..., str], follow: Callable[..., Any]
) -> None:
    for _ in range(5):
        submit(client)
    answer = client.get("/jobs", headers={"Accept-Encoding": "gzip"})
    assert answer.headers["content-encoding"] == "gzip"
    assert answer.num_bytes_downloaded < len(answer.content) / 4
    plain = client.get("/jobs", headers={"Accept-Encoding": "identity"})
    assert "content-encoding" not in plain.headers
    assert plain.json() == answer.json()
    lease = run_job()
    checkpoint = save_checkpoint(lease, 1, {"weights.npz": b"0" * 5000})
    file = client.get(f"/checkpoints/{checkpoint}/files/weights.npz", headers={"Range": "bytes=0-3999"})
    assert (file.status_code, len(file.content), "content-encoding" in file.headers) == (206, 4000, False)
    with client.stream("GET", "/jobs/stream") as stream:
        assert "content-encoding" not in stream.headers


def test_earlier_log_lines_come_in_pages(
    client: httpx.Client, run_job: Callable[..., Lease], sessions: sessionmaker[Session]
) -> None:
    lease = run_job()
    with sessions.begin() as session:
        session.add_all(Log(job_id=lease.job_id, attempt=1, level="info", message=f"line {i}") for i in range(25))

    def page(**params: Any) -> list[dict[str, Any]]:
        items: list[dict[str, Any]] = client.get(f"/jobs/{lease.job_id}/logs", params=params).json()["items"]
        return items

    newest = page(tail=True, limit=10)
    before = page(before=newest[0]["id"], limit=10)
    assert [line["message"] for line in before + newest] == [f"line {i}" for i in range(5, 25)]
    assert [line["message"] for line in page(before=before[0]["id"], limit=10)] == [f"line {i}" for i in range(5)]
