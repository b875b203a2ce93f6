"""All artifacts as one archive: an import restores what was exported, or nothing."""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace

import pytest
from naojobs.archive import DamagedArchiveError, export_artifacts, import_artifacts
from naojobs.store import ArtifactStore, MissingArtifactError

KEYS = ("jobs/j/checkpoints/1-1", "jobs/j/evaluations/e-1", "jobs/k/checkpoints/1-1")


def open_store(folder: Path) -> ArtifactStore:
    return ArtifactStore.from_settings(SimpleNamespace(artifact_url=folder.as_uri()))  # type: ignore[arg-type]


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    store = open_store(tmp_path / "store")
    for key in KEYS:
        folder = tmp_path / key.replace("/", "-")
        (folder / "sub").mkdir(parents=True)
        (folder / "a.npz").write_bytes(f"content of {key}".encode() * 100)
        (folder / "sub" / "z.json").write_bytes(b"{}")
        store.put_directory(key, folder)
    return store


@pytest.fixture
def other(tmp_path: Path) -> ArtifactStore:
    return open_store(tmp_path / "other")


def packed(store: ArtifactStore) -> bytes:
    target = io.BytesIO()
    export_artifacts(store, target)
    return target.getvalue()


def test_another_store_holds_the_same(store: ArtifactStore, other: ArtifactStore, tmp_path: Path) -> None:
    store.put_bytes("probes/x", b"not an artifact")
    assert import_artifacts(other, io.BytesIO(packed(store))) == 9
    assert other.list("jobs") == store.list("jobs")
    assert other.list("probes") == []
    for key in KEYS:
        other.get_directory(key, tmp_path / "out" / key)


def test_an_artifact_that_was_changed_is_named_and_is_not_there(
    store: ArtifactStore, other: ArtifactStore, tmp_path: Path
) -> None:
    data = packed(store).replace(b"content of jobs/k", b"CONTENT of jobs/k", 1)
    with pytest.raises(DamagedArchiveError, match="1 artifacts do not match their manifests: jobs/k/checkpoints"):
        import_artifacts(other, io.BytesIO(data))
    other.get_directory(KEYS[0], tmp_path / "out")
    with pytest.raises(MissingArtifactError):
        other.manifest(KEYS[2])


@pytest.mark.parametrize("cut", [0, 100, 3000])
def test_an_archive_that_was_cut_off_is_refused(store: ArtifactStore, other: ArtifactStore, cut: int) -> None:
    with pytest.raises(DamagedArchiveError, match="truncated"):
        import_artifacts(other, io.BytesIO(packed(store)[:cut]))


@pytest.mark.parametrize("rest", [0, 200])
def test_an_archive_that_was_cut_off_before_a_whole_artifact_is_refused(
    store: ArtifactStore, other: ArtifactStore, rest: int
) -> None:
    data = packed(store)
    end = data.index(b"jobs/k/") + rest
    with pytest.raises(DamagedArchiveError, match="truncated: cut off or damaged"):
        import_artifacts(other, io.BytesIO(data[:end]))


def test_no_name_leads_out_of_the_store(store: ArtifactStore, other: ArtifactStore) -> None:
    for name in (b"jobs/../../../etc/pass", b"/etc/passwd-of-a-machine", b"work/j/checkpoints/1-1/"):
        data = packed(store).replace(b"jobs/j/checkpoints/1-1/", name[:23].ljust(23, b"x"))
        with pytest.raises(DamagedArchiveError):
            import_artifacts(other, io.BytesIO(data))


def test_what_goes_away_meanwhile_is_left_out(
    store: ArtifactStore, other: ArtifactStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its manifest, too: an artifact with a file missing would seem complete otherwise."""
    read = store.get_bytes

    def remove_first(key: str) -> bytes:
        if key == f"{KEYS[1]}/sub/z.json":
            store.delete_file(key)
        return read(key)

    monkeypatch.setattr(store, "get_bytes", remove_first)
    assert import_artifacts(other, io.BytesIO(packed(store))) == 7
    other.get_directory(KEYS[2], tmp_path / "out")
    with pytest.raises(MissingArtifactError):
        other.manifest(KEYS[1])


def test_a_file_that_is_missing_for_a_moment_is_in_the_archive(
    store: ArtifactStore, other: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a proxy before a store that does not answer says; one that stays so is an error, not a smaller archive."""
    read, answers = store.get_bytes, [404, 404, 200]
    pauses: list[float] = []

    def find_later(key: str) -> bytes:
        if key == f"{KEYS[1]}/sub/z.json" and answers.pop(0) == 404:
            raise MissingArtifactError("no such file")
        return read(key)

    monkeypatch.setattr(store, "get_bytes", find_later)
    target = io.BytesIO()
    assert export_artifacts(store, target, sleep=pauses.append) == 9
    target.seek(0)
    assert import_artifacts(other, target) == 9
    assert len(pauses) == 2

    answers.extend([404] * 99)
    with pytest.raises(MissingArtifactError):
        export_artifacts(store, io.BytesIO(), sleep=pauses.append)
    assert sum(pauses) > 120
