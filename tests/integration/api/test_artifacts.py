"""Checkpoints and evaluations over HTTP: complete, in parts, as an archive, and no other files."""

from __future__ import annotations

import hashlib
import io
import os
import tarfile
import time
from collections.abc import Callable
from contextlib import closing
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import httpx
import pytest
from naojobs import leases, outcomes, records
from naojobs.leases import Lease
from naojobs.models import Evaluation
from naojobs.states import WorkState
from naojobs.store import ArtifactStore, checkpoint_key
from naospec import EvaluationSpec
from naospec.metrics import Metric, Result
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work
from tests.integration.conftest import S3Server, StoreProxy
from tests.integration.writes import append_metrics, record_checkpoint, request_evaluation

CONTENT = {
    "checkpoint.json": b'{"format": 1}',
    "policy.npz": os.urandom(3 << 20),
    "sub/notes.txt": b"",
    "odd": b"x" * 513,
}


@pytest.fixture
def lease(run_job: Callable[..., Lease]) -> Lease:
    return run_job()


@pytest.fixture
def checkpoint(lease: Lease, save_checkpoint: Callable[..., str]) -> str:
    return save_checkpoint(lease, 100, CONTENT)


def test_a_checkpoint_is_listed_and_downloaded_as_it_is(client: httpx.Client, lease: Lease, checkpoint: str) -> None:
    (listed,) = client.get(f"/jobs/{lease.job_id}/checkpoints").json()["items"]
    assert client.get(f"/checkpoints/{checkpoint}").json() == listed
    assert (listed["id"], listed["step"], listed["attempt"]) == (checkpoint, 100, 1)
    assert listed["size"] == sum(map(len, CONTENT.values()))
    assert {file["name"] for file in listed["files"]} == set(CONTENT)
    for file in listed["files"]:
        answer = client.get(file["url"])
        assert answer.status_code == 200
        assert answer.content == CONTENT[file["name"]]
        assert int(answer.headers["content-length"]) == file["size"]
        assert hashlib.sha256(answer.content).hexdigest() == file["sha256"]
        assert answer.headers["etag"] == f'"{file["sha256"]}"'
        assert answer.headers["vary"] == "Authorization", "no other token gets it from a browser's cache"
        assert answer.headers["content-disposition"].startswith("attachment")
        assert answer.headers["x-content-type-options"] == "nosniff"


def test_the_newest_checkpoint_comes_first(
    client: httpx.Client, lease: Lease, save_checkpoint: Callable[..., str]
) -> None:
    for step in (5, 50, 10):
        save_checkpoint(lease, step, {"a": b"a"})
    steps = [item["step"] for item in client.get(f"/jobs/{lease.job_id}/checkpoints").json()["items"]]
    assert steps == [50, 10, 5]


@pytest.mark.parametrize(
    ("header", "start", "stop"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=0-99", 0, 100),
        ("bytes=1000-", 1000, None),
        ("bytes=-10", -10, None),
        ("bytes=-99999999", 0, None),
        ("bytes=2000000-99999999", 2_000_000, None),
    ],
)
def test_a_range_gets_just_that(
    client: httpx.Client, checkpoint: str, header: str, start: int, stop: int | None
) -> None:
    whole = CONTENT["policy.npz"]
    answer = client.get(f"/checkpoints/{checkpoint}/files/policy.npz", headers={"Range": header})
    part = whole[start:stop]
    first = start if start >= 0 else len(whole) + start
    assert answer.status_code == 206
    assert answer.content == part
    assert answer.headers["content-range"] == f"bytes {first}-{first + len(part) - 1}/{len(whole)}"


def test_an_interrupted_download_goes_on_where_it_stopped(client: httpx.Client, checkpoint: str) -> None:
    path = f"/checkpoints/{checkpoint}/files/policy.npz"
    first = client.get(path, headers={"Range": "bytes=0-999999"})
    headers = {"Range": f"bytes={len(first.content)}-", "If-Range": first.headers["etag"]}
    second = client.get(path, headers=headers)
    assert first.content + second.content == CONTENT["policy.npz"]
    changed = client.get(path, headers={**headers, "If-Range": '"another"'})
    assert (changed.status_code, changed.content) == (200, CONTENT["policy.npz"])


def test_what_is_no_range_is_ignored_and_what_lies_outside_is_refused(client: httpx.Client, checkpoint: str) -> None:
    path = f"/checkpoints/{checkpoint}/files/odd"
    for header in ("bytes=5-2", "bytes=a-b", "bytes=-", "bytes=0-1,3-4", "lines=0-1"):
        assert client.get(path, headers={"Range": header}).status_code == 200
    for header in ("bytes=513-", "bytes=513-600", "bytes=-0"):
        answer = client.get(path, headers={"Range": header})
        assert answer.status_code == 416
        assert answer.headers["content-range"] == "bytes */513"
        assert answer.json()["errors"][0]["field"] == "Range"
    assert client.get(f"/checkpoints/{checkpoint}/files/sub/notes.txt").content == b""


def test_a_copy_that_is_still_good_is_not_sent_again(client: httpx.Client, checkpoint: str) -> None:
    path = f"/checkpoints/{checkpoint}/files/odd"
    tag = client.get(path).headers["etag"]
    assert client.get(path, headers={"If-None-Match": tag}).status_code == 304


def test_an_archive_holds_all_files(client: httpx.Client, lease: Lease, checkpoint: str) -> None:
    answer = client.get(f"/checkpoints/{checkpoint}/archive")
    assert int(answer.headers["content-length"]) == len(answer.content)
    with tarfile.open(fileobj=io.BytesIO(answer.content)) as archive:
        found = {}
        for member in archive.getmembers():
            file = archive.extractfile(member)
            assert file is not None
            found[member.name] = file.read()
    assert found == {f"{lease.job_id}-100/{name}": content for name, content in CONTENT.items()}


@pytest.mark.parametrize(
    "name",
    [
        "../../../../../../etc/passwd",
        "..%2f..%2f..%2fetc%2fpasswd",
        "%2e%2e/%2e%2e/etc/passwd",
        "/etc/passwd",
        "%2Fetc%2Fpasswd",
        "manifest.json",
        "policy.npz%00",
        "sub",
        "sub/",
        "sub/../policy.npz",
        "..%5c..%5cpolicy.npz",
        "a" * 1000,
    ],
)
def test_no_name_leads_anywhere_else(
    client: httpx.Client, checkpoint: str, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    # httpx would normalize the path; other clients may not.
    connection = HTTPConnection(client.base_url.host, client.base_url.port, timeout=20)
    with closing(connection):
        for root in (f"/checkpoints/{checkpoint}/files/", "/ui/"):
            headers = {"Authorization": client.headers["authorization"]}
            connection.request("GET", root + name, headers=headers)
            answer = connection.getresponse()
            assert answer.status in (404, 422), root
            content = answer.read()
            assert b"root:" not in content
            if b"there is no file" in content:
                assert "refused a file name that is not in the list" in caplog.text


def test_an_archive_whose_files_are_gone_is_a_problem(
    client: httpx.Client, lease: Lease, checkpoint: str, store: ArtifactStore
) -> None:
    store.delete_prefix(f"jobs/{lease.job_id}")
    answer = client.get(f"/checkpoints/{checkpoint}/archive")
    assert (answer.status_code, answer.headers["content-type"]) == (404, "application/problem+json")
    assert "no longer in the store" in answer.json()["detail"]


def test_a_file_that_a_proxy_does_not_find_for_a_moment_is_not_gone(
    start_api: Callable[..., Any],
    make_token: Callable[..., str],
    s3_server: S3Server,
    store_proxy: StoreProxy,
    sessions: sessionmaker[Session],
    lease: Lease,
    tmp_path: Path,
) -> None:
    environment = {**s3_server.environment, "NAOSPRINT_S3_ENDPOINT": store_proxy.url}
    api = start_api(**{name.removeprefix("NAOSPRINT_").lower(): value for name, value in environment.items()})
    store: ArtifactStore = api.server._service.store
    (tmp_path / "a.json").write_bytes(b"content")
    key = checkpoint_key(lease.job_id, 100, 1)
    manifest = store.put_directory(key, tmp_path).model_dump()
    checkpoint = record_checkpoint(sessions, lease, step=100, key=key, manifest=manifest)
    headers = {"Authorization": f"Bearer {make_token('alice', 'read')}"}
    with httpx.Client(base_url=f"{api.url}/checkpoints/{checkpoint}/", headers=headers, timeout=20) as client:
        for path in ("files/a.json", "archive"):
            store_proxy.wrong.append("missing")
            answer = client.get(path)
            assert (answer.status_code, answer.headers["content-type"]) == (503, "application/problem+json")
            assert "retry-after" in answer.headers
            assert client.get(path).status_code == 200
        store.delete_prefix(key)
        assert [client.get(path).status_code for path in ("files/a.json", "archive")] == [404, 404]


def test_a_deletion_during_a_download_cuts_it_and_is_one_line_of_the_log(
    client: httpx.Client,
    lease: Lease,
    save_checkpoint: Callable[..., str],
    store: ArtifactStore,
    caplog: pytest.LogCaptureFixture,
) -> None:
    checkpoint = save_checkpoint(lease, 200, {"a": os.urandom(64 << 20), "b": b"b"})
    with (
        pytest.raises(httpx.RemoteProtocolError),
        client.stream("GET", f"/checkpoints/{checkpoint}/archive") as answer,
    ):
        for number, _ in enumerate(answer.iter_raw()):
            if number == 0:
                store.delete_prefix(f"jobs/{lease.job_id}")
    (line,) = [record for record in caplog.records if "/archive" in record.getMessage() and record.levelname == "ERROR"]
    assert "no such file" in line.getMessage()
    assert not [record for record in caplog.records if record.exc_info]


def test_files_of_others_do_not_exist(
    make_client: Callable[..., httpx.Client], lease: Lease, checkpoint: str, sessions: sessionmaker[Session]
) -> None:
    evaluation = request_evaluation(sessions, lease.job_id)
    mallory = make_client("mallory", "submit")
    for path in (
        f"/checkpoints/{checkpoint}",
        f"/checkpoints/{checkpoint}/archive",
        f"/checkpoints/{checkpoint}/files/odd",
        f"/evaluations/{evaluation.id}",
        f"/evaluations/{evaluation.id}/archive",
        f"/evaluations/{evaluation.id}/files/odd",
    ):
        answer = mallory.get(path)
        assert answer.status_code == 404
        assert "that this token may see" in answer.json()["detail"]


def test_an_evaluation_from_request_to_report(
    client: httpx.Client,
    lease: Lease,
    checkpoint: str,
    sessions: sessionmaker[Session],
    store: ArtifactStore,
    tmp_path: object,
) -> None:
    asked = client.post(f"/jobs/{lease.job_id}/evaluations", json={"spec": {"episodes": 10}})
    assert asked.status_code == 202
    evaluation = asked.json()
    assert (evaluation["state"], evaluation["checkpoint_id"], evaluation["files"]) == ("queued", checkpoint, [])
    assert client.get(f"/evaluations/{evaluation['id']}/archive").status_code == 404

    claim = claim_work(sessions, Evaluation, evaluation["id"], "w")
    assert claim is not None
    assert claim.spec == EvaluationSpec(episodes=10)
    outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
    key = f"jobs/{lease.job_id}/evaluations/{evaluation['id']}-1"
    entry = store.put_bytes(f"{key}/report.html", b"<html>")
    records.record_result(
        sessions, claim.lease, summary={"speed_mps": {"mean": 1.5}}, key=key, manifest={"files": [entry.model_dump()]}
    )
    unsettled = client.get(f"/evaluations/{evaluation['id']}").json()
    assert (unsettled["state"], unsettled["summary"], unsettled["files"]) == ("running", None, [])
    assert client.get(f"/evaluations/{evaluation['id']}/archive").status_code == 404
    outcomes.transition(sessions, claim.lease, WorkState.SUCCEEDED)
    done = client.get(f"/evaluations/{evaluation['id']}").json()
    assert (done["state"], done["summary"]) == ("succeeded", {"speed_mps": {"mean": 1.5}})
    report = client.get(done["files"][0]["url"])
    assert report.content == b"<html>"
    assert report.headers["content-type"] == "application/octet-stream", "no page of a user may run here"
    assert client.get(done["archive_url"]).status_code == 200
    assert [item["id"] for item in client.get(f"/jobs/{lease.job_id}/evaluations").json()["items"]] == [
        evaluation["id"]
    ]


def test_a_jobs_result_is_its_newest_evaluation_with_the_most_episodes(
    client: httpx.Client,
    lease: Lease,
    save_checkpoint: Callable[..., str],
    sessions: sessionmaker[Session],
    follow: Callable[..., Any],
) -> None:
    def evaluate(step: int, episodes: int, height: float) -> str:
        results = [Result(Metric(name, name.upper(), "m"), height, interval=(0.0, 9.0)) for name in ("b", "a", "c")]
        return records.record_evaluation(
            sessions,
            lease,
            checkpoint_id=save_checkpoint(lease, step, {"policy.npz": b"x"}),
            spec=EvaluationSpec(episodes=episodes),
            summary={
                "episodes": episodes,
                "checkpoint": {"step": step},
                "results": [result.to_json() for result in results],
                "headline": ["a"],
                "tables": ["not for lists"],
            },
            key=f"jobs/{lease.job_id}/evaluations/{step}",
            manifest={"files": []},
        )

    path = f"/jobs/{lease.job_id}"
    first = client.get(path)
    assert first.status_code == 200, first.text
    assert first.json()["result"] is None
    evaluate(100, 500, 1.0)
    chosen = [evaluate(step, 1000, height) for step, height in ((200, 2.0), (300, 3.0))][-1]
    evaluate(400, 10, 4.0)
    append_metrics(sessions, lease, [{"step": 400, "c": 0.5}])
    result = client.get(path).json()["result"]
    assert (result["evaluation_id"], result["step"], result["episodes"]) == (chosen, 300, 1000)
    assert [item["name"] for item in result["results"]] == ["a", "c"], "the headline, then training results"
    assert result["results"][0] == {
        "name": "a", "title": "A", "unit": "m", "digits": 2, "value": 3.0, "interval": [0.0, 9.0], "sd": None
    }  # fmt: skip
    (listed,) = client.get("/jobs", params={"q": lease.job_id}).json()["items"]
    assert listed["result"] == result
    outcomes.transition(sessions, lease, WorkState.SUCCEEDED)
    with follow(client, f"{path}/stream", only=["state"]) as messages:
        assert next(message.data for message in messages if message.event == "state")["result"] == result


def test_an_evaluation_of_what_is_not_there_is_refused(
    client: httpx.Client, checkpoint: str, run_job: Callable[..., Lease]
) -> None:
    other = run_job().job_id
    answer = client.post(f"/jobs/{other}/evaluations")
    assert answer.status_code == 409
    assert answer.json()["errors"][0]["field"] == "checkpoint_id"
    assert client.post(f"/jobs/{other}/evaluations", json={"checkpoint_id": checkpoint}).status_code == 404
    answer = client.post(f"/jobs/{other}/evaluations", json={"spec": {"episodes": 0}})
    assert answer.json()["errors"][0]["field"] == "spec.episodes"


def test_an_evaluation_that_cannot_run_is_refused(client: httpx.Client, lease: Lease, checkpoint: str) -> None:
    assert checkpoint
    body = {"spec": {"task": {"name": "sprint1", "push_mps": 0.5}}}
    answer = client.post(f"/jobs/{lease.job_id}/evaluations", json=body)
    (error,) = answer.json()["errors"]
    assert (answer.status_code, error["field"]) == (422, "spec.task.push_mps")
    assert "0.5 needs pushes" in error["message"]


def test_deleting_a_job_deletes_its_files(
    client: httpx.Client, lease: Lease, checkpoint: str, store: ArtifactStore, sessions: sessionmaker[Session]
) -> None:
    assert store.list(f"jobs/{lease.job_id}")
    outcomes.transition(sessions, lease, WorkState.CANCELLED)
    assert client.delete(f"/jobs/{lease.job_id}").status_code == 204
    # Files are deleted after the answer.
    deadline = time.monotonic() + 10
    while store.list(f"jobs/{lease.job_id}"):
        assert client.get(f"/checkpoints/{checkpoint}").status_code == 404
        assert time.monotonic() < deadline, "the files are still there"


def test_an_evaluation_is_cancelled_by_its_owner(
    client: httpx.Client,
    make_client: Callable[..., httpx.Client],
    lease: Lease,
    checkpoint: str,
    sessions: sessionmaker[Session],
) -> None:
    body = {"checkpoint_id": checkpoint, "time_limit_s": 60}
    waiting, running = (client.post(f"/jobs/{lease.job_id}/evaluations", json=body).json() for _ in range(2))
    assert waiting["time_limit_s"] == 60
    assert make_client("mallory", "submit").post(f"/evaluations/{waiting['id']}/cancel").status_code == 404
    assert client.post(f"/evaluations/{waiting['id']}/cancel").json()["state"] == "cancelled"
    claim = claim_work(sessions, Evaluation, running["id"], "worker-1")
    assert claim is not None
    asked = client.post(f"/evaluations/{running['id']}/cancel").json()
    assert (asked["state"], asked["cancel_requested"], asked["worker"]) == ("starting", True, "worker-1")
    assert leases.heartbeat(sessions, claim.lease).cancel
    outcomes.transition(sessions, claim.lease, WorkState.FAILED, error="too late")
    assert client.get(f"/evaluations/{running['id']}").json()["state"] == "cancelled"
    failing = client.post(f"/jobs/{lease.job_id}/evaluations", json=body).json()
    claim = claim_work(sessions, Evaluation, failing["id"], "worker-1")
    assert claim is not None
    outcomes.transition(sessions, claim.lease, WorkState.FAILED, error="broken")
    refused = client.post(f"/evaluations/{failing['id']}/cancel")
    assert refused.status_code == 409
    assert "has already failed" in refused.json()["detail"]
