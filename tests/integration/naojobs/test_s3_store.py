"""The artifact store on a real S3 server."""

from __future__ import annotations

import hashlib
import os
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx
import pytest
from naojobs.__main__ import STORE_PATIENCE_S
from naojobs.settings import ServiceSettings
from naojobs.store import ArtifactStore, CorruptArtifactError, MissingArtifactError, StoreError
from obstore.store import S3Store

from tests.integration.conftest import S3Server


def open_store(server: S3Server, patience_s: float | None = None, **changed: str) -> ArtifactStore:
    fields = {name.removeprefix("NAOSPRINT_").lower(): value for name, value in server.environment.items()}
    settings = {"mode": "local", "database_url": "postgresql:///x", "broker_url": "redis://h", **fields, **changed}
    return ArtifactStore.from_settings(ServiceSettings.model_validate(settings), patience_s=patience_s)


@pytest.fixture
def store(s3_server: S3Server) -> ArtifactStore:
    return open_store(s3_server)


def test_a_folder_comes_back_as_it_was(store: ArtifactStore, tmp_path: Path) -> None:
    folder = tmp_path / "in"
    (folder / "sub").mkdir(parents=True)
    (folder / "policy.npz").write_bytes(bytes(range(256)) * 30_000)  # more than one part of an upload
    (folder / "sub" / "empty").touch()
    manifest = store.put_directory("jobs/j/checkpoints/1-1", folder)
    assert store.get_directory("jobs/j/checkpoints/1-1", tmp_path / "out") == manifest
    assert (tmp_path / "out" / "policy.npz").read_bytes() == (folder / "policy.npz").read_bytes()
    # This server sends the range, but with the status of a full response.
    whole = bytes(range(256)) * 30_000
    for start, stop in ((0, 1), (300, 310), (1 << 20, 5 << 20), (7_000_000, None), (7_679_999, 7_680_000)):
        assert b"".join(store.stream("jobs/j/checkpoints/1-1/policy.npz", start, stop)) == whole[start:stop]
    assert [(file.key, file.size) for file in store.files("jobs/j")][:2] == [
        ("jobs/j/checkpoints/1-1/manifest.json", len(manifest.model_dump_json())),
        ("jobs/j/checkpoints/1-1/policy.npz", 7_680_000),
    ]
    store.put_bytes("jobs/j/checkpoints/1-1/policy.npz", b"changed")
    with pytest.raises(CorruptArtifactError):
        store.get_directory("jobs/j/checkpoints/1-1", tmp_path / "again")
    assert store.delete_prefix("jobs/j") == 3
    assert store.list("jobs/j") == []


def test_large_file_goes_in_one_request_that_may_take_longer_than_a_silent_store(tmp_path: Path) -> None:
    """An interrupted multipart upload leaves parts that no listing shows and nobody deletes."""
    deadline_s = 1.0
    requests: list[tuple[str, str, int]] = []

    class Recorder(BaseHTTPRequestHandler):
        def do_PUT(self) -> None:
            left = size = int(self.headers["Content-Length"])
            if size > 1 << 20:
                time.sleep(1.5 * deadline_s)  # a slow connection
            while left:
                left -= len(self.rfile.read(min(left, 1 << 20)))
            requests.append((self.command, self.path, size))
            self.send_response(200)
            self.send_header("ETag", '"1"')
            self.send_header("Content-Length", "0")
            self.end_headers()

        do_POST = do_PUT

        def log_message(self, format: str, *args: object) -> None:
            pass

    (tmp_path / "large.npz").touch()
    os.truncate(tmp_path / "large.npz", 80 << 20)
    with ThreadingHTTPServer(("127.0.0.1", 0), Recorder) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        settings = {
            "mode": "local",
            "database_url": "postgresql:///x",
            "broker_url": "redis://h",
            "artifact_url": "s3://bucket",
            "s3_endpoint": f"http://127.0.0.1:{server.server_port}",
            "s3_access_key_id": "key",
            "s3_secret_access_key": "secret",
        }
        store = ArtifactStore.from_settings(ServiceSettings.model_validate(settings), deadline_s=deadline_s)
        store.put_directory("jobs/j/x", tmp_path)
        server.shutdown()
    assert requests[0] == ("PUT", "/bucket/jobs/j/x/large.npz", 80 << 20)
    assert [path for _, path, _ in requests[1:]] == ["/bucket/jobs/j/x/manifest.json"]


def test_commands_repeat_what_a_full_store_refuses(s3_server: S3Server) -> None:
    """A worker and the API have a patience of their own; they get an error of one line soon."""
    refusals = 0

    class Full(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            nonlocal refusals
            refusals -= 1
            body = b"content" if refusals < 0 else b"<Error><Code>XMinioStorageFull</Code></Error>"
            self.send_response(200 if refusals < 0 else 507)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Last-Modified", "Thu, 01 Jan 2026 00:00:00 GMT")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Full) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        endpoint = f"http://127.0.0.1:{server.server_port}"
        try:
            refusals = 7
            assert open_store(s3_server, STORE_PATIENCE_S, s3_endpoint=endpoint).get_bytes("jobs/j/x") == b"content"
            refusals = 7
            with pytest.raises(StoreError, match=r"^get jobs/j/x: .* 507 .*XMinioStorageFull[^\n]*$"):
                open_store(s3_server, s3_endpoint=endpoint).get_bytes("jobs/j/x")
        finally:
            server.shutdown()
            thread.join()


def test_a_download_has_no_deadline_as_long_as_the_store_answers(store: ArtifactStore) -> None:
    client = store._store
    assert isinstance(client, S3Store) and client.client_options is not None
    assert client.client_options["timeout"] == "1day", "a slow client was cut after ten minutes"


def test_a_signed_address_opens_one_file_and_only_that(store: ArtifactStore) -> None:
    store.put_bytes("jobs/s/a", b"for everybody")
    store.put_bytes("jobs/s/b", b"for nobody")
    url = store.url_for("jobs/s/a")
    assert url is not None
    answer = httpx.get(url)
    assert (answer.status_code, hashlib.sha256(answer.content).digest()) == (
        200,
        hashlib.sha256(b"for everybody").digest(),
    )
    assert httpx.get(url, headers={"Range": "bytes=4-7"}).content == b"ever"
    assert httpx.get(url.replace("jobs/s/a", "jobs/s/b")).status_code == 403
    assert httpx.get(url.split("?")[0]).status_code in (400, 403)


def test_it_can_be_tried_out_by_many_and_leaves_nothing(store: ArtifactStore, s3_server: S3Server) -> None:
    before = s3_server.stored("probes")  # left by processes that other tests killed; a sweep deletes them after a day
    store.put_bytes("probes-of-another/a", b"a")
    for _ in range(3):
        store.check()
    s3_server.until_gone("probes", before)
    assert s3_server.stored("probes-of-another") == ["probes-of-another/a"], "files are found where they are looked for"
    store.delete_prefix("probes-of-another")


def test_what_is_missing_is_missing(store: ArtifactStore) -> None:
    with pytest.raises(MissingArtifactError):
        store.get_bytes("nothing")


def test_wrong_keys_open_nothing(s3_server: S3Server) -> None:
    with pytest.raises(StoreError):
        open_store(s3_server, s3_secret_access_key="wrong-secret-of-the-same-kind").check()
