"""Export and import of all artifacts as one tar archive, for any kind of store."""

from __future__ import annotations

import hashlib
import io
import tarfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from tarfile import EmptyHeaderError, InvalidHeaderError, ReadError, TruncatedHeaderError  # type: ignore[attr-defined]
from typing import BinaryIO, Self

from naojobs.errors import JobError
from naojobs.store import ARTIFACTS, MANIFEST_NAME, ArtifactStore, MissingArtifactError, StoreManifest, artifact_of

_PAUSES_S = tuple(min(0.1 * 2**number, 15.0) for number in range(15))
"""Pauses, of two minutes in all, between the tries to read a file that the store lists and does not find."""


class DamagedArchiveError(JobError):
    """Archive that does not match its manifests."""


class WholeTarInfo(tarfile.TarInfo):
    """Members of an archive up to its mark of the end; `tarfile` takes one that is cut within a header as ended."""

    @classmethod
    def fromtarfile(cls, tarfile: tarfile.TarFile) -> Self:  # the name is that of the standard library
        """Return the next member. Raises tarfile.ReadError if neither one nor the end's mark follows."""
        try:
            return super().fromtarfile(tarfile)
        except (EmptyHeaderError, InvalidHeaderError, TruncatedHeaderError) as error:
            raise ReadError(f"cut off or damaged ({error})") from None


def export_artifacts(store: ArtifactStore, target: BinaryIO, *, sleep: Callable[[float], None] = time.sleep) -> int:
    """Write everything in the store to `target`; return how many files that was. Raises StoreError.

    Artifacts may be added and deleted meanwhile. One whose files are deleted is written without a manifest, and so does
    not count as stored.
    """
    keys = sorted(store.list(ARTIFACTS), key=lambda key: (artifact_of(key), _is_manifest(key)))
    count = 0
    gone = ""
    with tarfile.open(fileobj=target, mode="w|", format=tarfile.PAX_FORMAT) as archive:
        for key in keys:
            if _is_manifest(key) and artifact_of(key) == gone:
                continue
            data = _content(store, key, sleep)
            if data is None:
                gone = artifact_of(key)
                continue
            entry = tarfile.TarInfo(key)
            entry.size, entry.mode = len(data), 0o600
            archive.addfile(entry, io.BytesIO(data))
            count += 1
    return count


def _content(store: ArtifactStore, key: str, sleep: Callable[[float], None]) -> bytes | None:
    """Return the content of a file, or nothing if it was deleted.

    Only a listing says so: a proxy may answer that there is no such file while the store behind it does not answer.

    Raises:
        MissingArtifactError: it is still listed, and was not found in two minutes.
        StoreError: the store refused.
    """
    for pause_s in _PAUSES_S:
        with suppress(MissingArtifactError):
            return store.get_bytes(key)
        with suppress(MissingArtifactError):
            if key not in store.list(artifact_of(key)):
                return None
        sleep(pause_s)
    return store.get_bytes(key)


def verify_artifacts(source: BinaryIO) -> int:
    """Check every file of an archive against its manifest; return how many there are. Raises DamagedArchiveError."""
    digests, manifests = _read(source, lambda _key, _data: None)
    _refuse_damaged([key for key, data in manifests.items() if not _fits(key, data, digests)])
    return len(digests)


def import_artifacts(store: ArtifactStore, source: BinaryIO) -> int:
    """Write everything in `source` to the store, manifests last, and return how many files that was.

    Raises:
        DamagedArchiveError: an artifact does not match its manifest; it is then stored without a manifest and so does
            not count, while all others do.
    """
    digests, manifests = _read(source, store.put_bytes)
    damaged = [key for key, data in manifests.items() if not _fits(key, data, digests)]
    for key in manifests.keys() - set(damaged):
        store.put_bytes(key, manifests[key])
    _refuse_damaged(damaged)
    return len(digests)


def _read(source: BinaryIO, put: Callable[[str, bytes], object]) -> tuple[dict[str, str], dict[str, bytes]]:
    """Pass every file of an archive but its manifests to `put`; return the SHA-256 of all by key, and the manifests."""
    digests: dict[str, str] = {}
    manifests: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=source, mode="r|", tarinfo=WholeTarInfo) as archive:
            for entry in archive:
                file = archive.extractfile(entry)
                if file is None or not entry.name.startswith(f"{ARTIFACTS}/"):
                    raise DamagedArchiveError(f"{entry.name}: no file below {ARTIFACTS}/")
                data = file.read()
                digests[entry.name] = hashlib.sha256(data).hexdigest()
                if _is_manifest(entry.name):
                    manifests[entry.name] = data
                else:
                    put(entry.name, data)
    except (tarfile.TarError, ValueError) as error:
        raise DamagedArchiveError(f"not an archive of artifacts, or truncated: {error}") from error
    return digests, manifests


def _refuse_damaged(damaged: Sequence[str]) -> None:
    if damaged:
        raise DamagedArchiveError(f"{len(damaged)} artifacts do not match their manifests: {', '.join(damaged)}")


def _is_manifest(key: str) -> bool:
    return key.endswith(f"/{MANIFEST_NAME}")


def _fits(key: str, manifest: bytes, digests: Mapping[str, str]) -> bool:
    """Return whether the SHA-256 of every file matches the manifest under `key`."""
    folder = key.removesuffix(MANIFEST_NAME)
    try:
        files = StoreManifest.model_validate_json(manifest).files
    except ValueError:
        return False
    return all(digests.get(folder + file.name) == file.sha256 for file in files)
