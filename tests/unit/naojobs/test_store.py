"""The artifact store on a local disk."""

from __future__ import annotations

import hashlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from naojobs.settings import ServiceSettings
from naojobs.store import (
    ArtifactStore,
    CorruptArtifactError,
    ManifestEntry,
    MissingArtifactError,
    StoreError,
    StoreManifest,
    check_key,
    checkpoint_key,
    new_nonce,
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "with blank"


@pytest.fixture
def store(root: Path) -> ArtifactStore:
    settings = SimpleNamespace(artifact_url=root.as_uri())
    return ArtifactStore.from_settings(settings)  # type: ignore[arg-type]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "in"
    (folder / "sub").mkdir(parents=True)
    (folder / "a.npz").write_bytes(b"a" * 3_000_000)
    (folder / "sub" / "b.json").write_bytes(b"{}")
    (folder / "empty").touch()
    return folder


def test_a_folder_comes_back_as_it_was(store: ArtifactStore, folder: Path, tmp_path: Path) -> None:
    manifest = store.put_directory("jobs/j/checkpoints/1", folder)
    assert [entry.name for entry in manifest.files] == ["a.npz", "empty", "sub/b.json"]
    assert manifest.size == 3_000_002
    assert store.manifest("jobs/j/checkpoints/1") == manifest
    store.get_directory("jobs/j/checkpoints/1", tmp_path / "out")
    for entry in manifest.files:
        content = (tmp_path / "out" / entry.name).read_bytes()
        assert content == (folder / entry.name).read_bytes()
        assert hashlib.sha256(content).hexdigest() == entry.sha256


@pytest.mark.parametrize("name", ["gone", "in/sub/none"])
def test_no_files_are_no_artifact(store: ArtifactStore, folder: Path, name: str) -> None:
    """Otherwise a checkpoint whose folder somebody has deleted would count as stored."""
    (folder / "sub" / "none").mkdir()
    with pytest.raises(FileNotFoundError, match="there is no file to store"):
        store.put_directory("jobs/j/checkpoints/1", folder.parent / name)
    assert store.list("jobs") == []


def test_without_its_manifest_an_artifact_is_not_there(
    store: ArtifactStore, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put = store.put_bytes

    def fail(key: str, data: bytes) -> ManifestEntry:
        if key.endswith("manifest.json"):
            raise StoreError("disk full")
        return put(key, data)

    monkeypatch.setattr(store, "put_bytes", fail)
    with pytest.raises(StoreError):
        store.put_directory("a/b", folder)
    assert "a/b/a.npz" in store.list("a/b")
    with pytest.raises(MissingArtifactError):
        store.get_directory("a/b", tmp_path / "out")


@pytest.mark.parametrize("content", [b"b" * 3_000_000, b"a", b""])
def test_a_changed_file_is_found_out(
    store: ArtifactStore, root: Path, folder: Path, tmp_path: Path, content: bytes
) -> None:
    store.put_directory("a", folder)
    (root / "a" / "a.npz").write_bytes(content)
    with pytest.raises(CorruptArtifactError, match=r"a\.npz"):
        store.get_directory("a", tmp_path / "out")
    assert not (tmp_path / "out" / "a.npz").exists()


@pytest.mark.parametrize("name", ["../out", "/etc/x", "a/../../x", "a//b", "."])
def test_a_manifest_cannot_lead_out_of_the_folder(store: ArtifactStore, tmp_path: Path, name: str) -> None:
    entry = ManifestEntry(name=name, size=1, sha256="0" * 64)
    store.put_bytes("a/manifest.json", StoreManifest(files=(entry,)).model_dump_json().encode())
    with pytest.raises(CorruptArtifactError):
        store.get_directory("a", tmp_path / "out")
    with pytest.raises(CorruptArtifactError):
        store.put_bytes("b/manifest.json", b"[]")
        store.manifest("b")


def test_parts_of_a_file(store: ArtifactStore) -> None:
    data = bytes(range(256)) * 20_000
    store.put_bytes("x", data)
    for start, stop in ((0, None), (0, 1), (100, 5_000_000), (5_119_999, None), (7, 8)):
        assert b"".join(store.stream("x", start, stop)) == data[start:stop]


def test_what_is_missing_is_missing_at_once(store: ArtifactStore) -> None:
    for read in (store.get_bytes, store.stream, store.manifest):
        with pytest.raises(MissingArtifactError):
            read("nothing")


def test_deleting_takes_a_prefix_by_segments(store: ArtifactStore) -> None:
    for key in ("jobs/1/a", "jobs/1/b/c", "jobs/10/a"):
        store.put_bytes(key, b"x")
    assert store.delete_prefix("jobs/1") == 2
    assert store.list("jobs") == ["jobs/10/a"]
    assert store.delete_prefix("jobs/1") == 0


def test_a_store_that_cannot_be_written_says_so(store: ArtifactStore, root: Path) -> None:
    store.check()
    (root / "probes").touch()
    with pytest.raises(StoreError):
        store.check()


def test_a_local_store_signs_nothing(store: ArtifactStore) -> None:
    assert store.url_for("a") is None


def test_an_s3_store_signs(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = ServiceSettings(
        mode="local",
        database_url="postgresql:///x",
        broker_url="redis://h",
        artifact_url="s3://bucket/prefix",
        s3_endpoint="http://127.0.0.1:1",
        s3_access_key_id="id",
        s3_secret_access_key="secret",
    )
    store = ArtifactStore.from_settings(settings)
    assert store.local_root is None
    url = store.url_for("a/b")
    assert url is not None
    assert url.startswith("http://127.0.0.1:1/bucket/prefix/a/b?")
    assert "secret" not in url


@pytest.mark.parametrize(
    "key", ["", "/", "a/", "/a", "a//b", "..", "a/../b", "a/.", ".a", "a b", "a\n", "a\\b", "\u00e4"]
)
def test_strange_keys_are_refused(key: str) -> None:
    with pytest.raises(ValueError, match="key"):
        check_key(key)


@given(st.text(max_size=60))
def test_no_accepted_key_leads_out_of_the_store(key: str) -> None:
    try:
        check_key(key)
    except ValueError:
        return
    root = Path("/store")
    assert (root / key).resolve().is_relative_to(root)
    assert str(root / key) == f"/store/{key}"


def test_checkpoints_sort_by_step() -> None:
    keys = [checkpoint_key("job_x", step, attempt) for step, attempt in ((9, 1), (10, 1), (10, 2), (10**10, 1))]
    assert keys == sorted(keys)


def test_keys_of_the_same_attempt_number_differ(store: ArtifactStore) -> None:
    """A database that lost its last seconds reuses the number: the first attempt's files must not be replaced."""
    keys = {checkpoint_key("job_x", 10, 1, new_nonce()) for _ in range(2)}
    assert len(keys) == 2
    assert all(checkpoint_key("job_x", 9, 9, "f") < key < checkpoint_key("job_x", 11, 1, "0") for key in keys)


def test_what_a_killed_process_was_writing_is_removed(store: ArtifactStore, root: Path) -> None:
    """The store lists only complete files; others are found by their names."""
    store.put_bytes("jobs/x/policy.npz", b"whole")
    cut = root / "jobs" / "x" / "policy.npz#1"
    cut.write_bytes(b"par")
    assert store.list("jobs") == ["jobs/x/policy.npz"]
    assert store.remove_unfinished(age_s=3600) == 0
    assert store.remove_unfinished(age_s=-1) == 1
    assert not cut.exists()
    assert store.get_bytes("jobs/x/policy.npz") == b"whole"


def test_a_file_is_uploaded_in_one_request(tmp_path: Path) -> None:
    """An upload in parts that is interrupted leaves parts in the bucket that no listing shows and that cost money."""
    requests: list[tuple[str, str, int]] = []

    class Bucket(BaseHTTPRequestHandler):
        def answer(self) -> None:
            size = int(self.headers.get("Content-Length", "0"))
            self.rfile.read(size)
            requests.append((self.command, self.path, size))
            self.send_response(200)
            self.send_header("ETag", '"x"')
            self.send_header("Content-Length", "0")
            self.end_headers()

        do_PUT = do_POST = answer

        def log_message(self, *_: object) -> None:
            """Write nothing."""

    (tmp_path / "large").write_bytes(bytes(20 << 20))
    with ThreadingHTTPServer(("127.0.0.1", 0), Bucket) as server:
        threading.Thread(target=server.serve_forever).start()
        settings = {"mode": "local", "database_url": "postgresql:///x", "broker_url": "redis://h"}
        endpoint = f"http://127.0.0.1:{server.server_port}"
        keys = {"s3_access_key_id": "x", "s3_secret_access_key": "y"}
        given = {**settings, **keys, "artifact_url": "s3://bucket", "s3_endpoint": endpoint}
        ArtifactStore.from_settings(ServiceSettings.model_validate(given)).put_directory("a", tmp_path)
        server.shutdown()
    assert requests[0] == ("PUT", "/bucket/a/large", 20 << 20)
    assert [path for _, path, _ in requests] == ["/bucket/a/large", "/bucket/a/manifest.json"]
