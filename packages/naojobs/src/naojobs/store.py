"""The artifact store: immutable files under keys, on a local disk or in S3."""

from __future__ import annotations

import hashlib
import json
import re
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import unquote, urlsplit

import obstore
from naospec.files import replacing, sync
from obstore.exceptions import BaseError
from obstore.store import LocalStore, S3Store
from pydantic import BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    from obstore import GetOptions
    from typing_extensions import Buffer

    from naojobs.settings import ServiceSettings

MANIFEST_NAME = "manifest.json"
ARTIFACTS = "jobs"
"""Prefix of all files that rows of the database refer to."""
OWNER = "service/owner.json"
"""File that says whose store it is, see `naojobs.retention`."""
PROBES = "probes"
"""Prefix of the files with which a store is tested."""
DEFAULT_DEADLINE_S = 60.0
"""Seconds for which a store may not answer."""
SLOWEST_UPLOAD_BYTES_S = 256 << 10
"""Bytes per second of the slowest connection over which files of any size can be uploaded."""
_CHUNK_BYTES = 1 << 20
_DEBUG = "\n\nDebug source:"
"""What begins the part of an error that repeats it for developers of the client."""
_ENDLESS = 1_000_000
"""Repetitions that a time ends, not their number."""
_UNFINISHED = re.compile(r".*#[0-9]+")
"""Names under which a local store writes files before they get their own."""
_SEGMENT = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._+=@-]{0,199}")


class StoreError(Exception):
    """Store that refused a request or could not be reached; the operation may be retried."""


class MissingArtifactError(StoreError):
    """Key without an artifact."""


class CorruptArtifactError(StoreError):
    """Artifact that does not match its manifest."""


class ManifestEntry(BaseModel):
    """Describes one file of a manifest."""

    model_config = ConfigDict(frozen=True)

    name: str = Field(description="Path below the manifest's key.")
    size: int = Field(ge=0, description="Bytes.")
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$", description="SHA-256 of the content, in hexadecimal.")


class StoreManifest(BaseModel):
    """Lists the files of one artifact; it is written after all of them, so an artifact with a manifest is complete."""

    model_config = ConfigDict(frozen=True)

    files: tuple[ManifestEntry, ...]

    @property
    def size(self) -> int:
        """Return the size of all files, in bytes."""
        return sum(entry.size for entry in self.files)

    def entry(self, name: str) -> ManifestEntry | None:
        """Return the entry of the file called `name`, or none."""
        return next((entry for entry in self.files if entry.name == name), None)


@dataclass(frozen=True, slots=True)
class StoredFile:
    """File in a listing of the store."""

    key: str
    size: int
    """Bytes."""
    modified: datetime


def check_key(key: str) -> str:
    """Return `key`, or raise ValueError if it could lead out of the store or is ambiguous.

    A key is one or more segments joined by `/`; each starts with a letter, a digit or `_`.
    """
    if len(key) > 900 or not all(_SEGMENT.fullmatch(segment) for segment in key.split("/")):
        raise ValueError(f"key {key[:100]!r}: use letters, digits and ._+=@- in segments joined by single slashes")
    return key


def new_nonce() -> str:
    """Return a random part for the keys of one attempt.

    A database that lost its last seconds reuses an attempt's number, whose files must not replace earlier ones.
    """
    return secrets.token_hex(4)


def checkpoint_key(job_id: str, step: int, attempt: int, nonce: str = "") -> str:
    """Return the key of a checkpoint's files; keys sort by step, then by attempt."""
    return check_key("-".join(filter(None, (f"{ARTIFACTS}/{job_id}/checkpoints/{step:012d}", str(attempt), nonce))))


def job_prefix(job_id: str) -> str:
    """Return the prefix of all artifacts of a job."""
    return check_key(f"{ARTIFACTS}/{job_id}")


def evaluation_key(job_id: str, evaluation_id: str, attempt: int, nonce: str = "") -> str:
    """Return the key of an evaluation's files."""
    return check_key("-".join(filter(None, (f"{ARTIFACTS}/{job_id}/evaluations/{evaluation_id}", str(attempt), nonce))))


def game_key(match_id: str, number: int, attempt: int, nonce: str) -> str:
    """Return the key of the log of a game."""
    return check_key(f"{ARTIFACTS}/{match_id}/games/{number:04d}-{attempt}-{nonce}")


def team_key(team_id: str) -> str:
    """Return the key of an uploaded team."""
    return check_key(f"{ARTIFACTS}/{team_id}/teams/{new_nonce()}")


def artifact_of(key: str) -> str:
    """Return the prefix of the artifact that a file belongs to: jobs/ID/checkpoints/NAME, or the like."""
    return "/".join(key.split("/")[:4])


@contextmanager
def _store_errors(action: str) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError as error:
        raise MissingArtifactError(f"{action}: no such file") from error
    except (BaseError, OSError) as error:
        raise StoreError(f"{action}: {str(error).partition(_DEBUG)[0]}") from error


def _range_options(start: int, stop: int | None) -> GetOptions:
    if stop is not None:
        return {"range": (start, stop)}
    return {"range": {"offset": start}} if start else {}


def _cut(pieces: Iterable[Buffer], skip: int, left: int | None) -> Iterator[memoryview]:
    """Skip the first `skip` bytes and end after `left` more; none for all."""
    for piece in pieces:
        view = memoryview(piece)
        skipped = min(skip, len(view))
        skip -= skipped
        view = view[skipped:] if left is None else view[skipped : skipped + left]
        if left is not None:
            left -= len(view)
        if view:
            yield view
        if left == 0:
            return


class ArtifactStore:
    """Store of artifacts under immutable keys; thread-safe."""

    def __init__(
        self, store: LocalStore | S3Store, *, connect: Callable[[float], S3Store] | None = None, deadline_s: float = 0.0
    ) -> None:
        self._store, self._connect, self._deadline_s = store, connect, deadline_s

    @classmethod
    def from_settings(
        cls, settings: ServiceSettings, *, deadline_s: float = DEFAULT_DEADLINE_S, patience_s: float | None = None
    ) -> Self:
        """Open the store that the settings name; makes the folder of a local one.

        A store that is silent for ``deadline_s`` seconds fails. A file that takes longer to upload has the time that it
        takes at ``SLOWEST_UPLOAD_BYTES_S``. Requests that fail are repeated for ``patience_s`` seconds; None: five
        times within about a second, for callers that have a patience of their own.
        """
        parts = urlsplit(settings.artifact_url)
        if parts.scheme == "file":
            return cls(LocalStore(unquote(parts.path), mkdir=True, automatic_cleanup=True))
        options: dict[str, Any] = {"region": settings.s3_region}
        tries, retry_s = (5, min(30.0, deadline_s)) if patience_s is None else (_ENDLESS, patience_s)
        if settings.s3_endpoint is not None:
            options["endpoint"] = settings.s3_endpoint
            options["virtual_hosted_style_request"] = False
        if settings.s3_access_key_id is not None and settings.s3_secret_access_key is not None:
            options["access_key_id"] = settings.s3_access_key_id.get_secret_value()
            options["secret_access_key"] = settings.s3_secret_access_key.get_secret_value()

        def connect(silent_s: float) -> S3Store:
            return S3Store(
                parts.netloc,
                prefix=parts.path.strip("/") or None,
                client_options={
                    "allow_http": (settings.s3_endpoint or "").startswith("http://"),
                    "timeout": timedelta(days=1),  # of a whole download, which a client may take slowly
                    "connect_timeout": timedelta(seconds=min(5.0, deadline_s)),
                    "read_timeout": timedelta(seconds=silent_s),
                },
                retry_config={"max_retries": tries, "retry_timeout": timedelta(seconds=retry_s)},
                **options,
            )

        return cls(connect(deadline_s), connect=connect, deadline_s=deadline_s)

    @property
    def local_root(self) -> Path | None:
        """Return the folder of a local store, none for S3."""
        return self._store.prefix if isinstance(self._store, LocalStore) else None

    def _uploader(self, size: int) -> LocalStore | S3Store:
        """Return a client that awaits the answer to `size` bytes; the time until they are sent counts as silence."""
        needed_s = size / SLOWEST_UPLOAD_BYTES_S
        return self._store if self._connect is None or needed_s <= self._deadline_s else self._connect(needed_s)

    def put_bytes(self, key: str, data: bytes) -> ManifestEntry:
        """Write `data` under `key`, atomically. Raises StoreError."""
        check_key(key)
        with _store_errors(f"put {key}"):
            obstore.put(self._uploader(len(data)), key, data)
            self._settle(key)
        return ManifestEntry(name=key.rsplit("/", 1)[-1], size=len(data), sha256=hashlib.sha256(data).hexdigest())

    def put_directory(self, key: str, directory: Path) -> StoreManifest:
        """Write every file below `directory` under `key/`, its manifest last; return the manifest.

        Raises:
            ValueError: a file's name is not fit for a key.
            FileNotFoundError: `directory` is gone or has no file, which is no artifact.
            StoreError: the store refused; nothing under `key` counts as an artifact then.
        """
        check_key(key)
        entries = []
        paths = sorted(path for path in directory.rglob("*") if path.is_file() and path != directory / MANIFEST_NAME)
        if not paths:
            raise FileNotFoundError(f"{directory}: there is no file to store under {key}")
        for path in paths:
            name = path.relative_to(directory).as_posix()
            target = check_key(f"{key}/{name}")
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
                size = file.tell()
            with _store_errors(f"put {target}"):
                # A single request is atomic; an upload in parts may leave some that no listing shows, and that cost.
                obstore.put(self._uploader(size), target, path, use_multipart=False)
                self._settle(target)
            entries.append(ManifestEntry(name=name, size=size, sha256=digest))
        manifest = StoreManifest(files=tuple(entries))
        self.put_bytes(f"{key}/{MANIFEST_NAME}", manifest.model_dump_json().encode())
        return manifest

    def manifest(self, key: str) -> StoreManifest:
        """Read the manifest under `key`. Raises MissingArtifactError, StoreError, CorruptArtifactError."""
        data = self.get_bytes(f"{key}/{MANIFEST_NAME}")
        try:
            return StoreManifest.model_validate(json.loads(data))
        except ValueError as error:
            raise CorruptArtifactError(f"{key}/{MANIFEST_NAME}: not a manifest: {error}") from error

    def get_bytes(self, key: str) -> bytes:
        """Read all of a small file. Raises MissingArtifactError, StoreError."""
        check_key(key)
        with _store_errors(f"get {key}"):
            return bytes(obstore.get(self._store, key).bytes())

    def stream(self, key: str, start: int = 0, stop: int | None = None) -> Iterator[bytes]:
        """Read bytes `start` (inclusive) to `stop` (exclusive, none for the end) piece by piece.

        The file is opened before this returns, so that a missing one is reported at once.
        Raises MissingArtifactError, StoreError.
        """
        check_key(key)
        skip, left = 0, None
        with _store_errors(f"get {key}"):
            try:
                result = obstore.get(self._store, key, options=_range_options(start, stop))
            except BaseError as error:
                # A server may ignore the range, which its status shows; then the part is selected here.
                if "non-partial response" not in str(error):
                    raise
                result = obstore.get(self._store, key)
                skip, left = start, None if stop is None else stop - start

        def pieces() -> Iterator[bytes]:
            with _store_errors(f"get {key}"):
                for piece in _cut(result.stream(min_chunk_size=_CHUNK_BYTES), skip, left):
                    yield bytes(piece)

        return pieces()

    def get_directory(self, key: str, directory: Path, manifest: StoreManifest | None = None) -> StoreManifest:
        """Read an artifact into `directory` (made if need be) and verify every file.

        Raises:
            MissingArtifactError: there is no manifest, or a file is gone.
            CorruptArtifactError: a file's size or SHA-256 does not match the manifest, or a name leads out of
                `directory`.
        """
        manifest = manifest or self.manifest(key)
        directory.mkdir(parents=True, exist_ok=True)
        for entry in manifest.files:
            try:
                check_key(entry.name)
            except ValueError as error:
                raise CorruptArtifactError(f"{key}: {error}") from error
            target = directory / entry.name
            target.parent.mkdir(parents=True, exist_ok=True)
            digest = hashlib.sha256()
            with replacing(target) as file:
                for piece in self.stream(f"{key}/{entry.name}"):
                    digest.update(piece)
                    file.write(piece)
                size = file.tell()
                if size != entry.size or digest.hexdigest() != entry.sha256:
                    raise CorruptArtifactError(
                        f"{key}/{entry.name}: {size} bytes with SHA-256 {digest.hexdigest()}, "
                        f"but the manifest has {entry.size} bytes with {entry.sha256}",
                    )
        return manifest

    def list(self, prefix: str) -> list[str]:
        """Return the keys of all files below `prefix`, sorted. Raises StoreError."""
        return [file.key for file in self.files(prefix)]

    def files(self, prefix: str) -> Sequence[StoredFile]:
        """Return all files below `prefix`, sorted by key. Raises StoreError."""
        check_key(prefix)
        with _store_errors(f"list {prefix}"):
            found = [
                StoredFile(meta["path"], meta["size"], meta["last_modified"])
                for chunk in obstore.list(self._store, prefix)
                for meta in chunk
            ]
        return sorted(found, key=lambda file: file.key)

    def has(self, key: str) -> bool:
        """Return whether a file is there.

        Only a listing says so: a proxy may answer that there is no such file while the store behind it does not answer.

        Raises:
            StoreError: it is unknown.
        """
        try:
            return key in self.list(artifact_of(key))
        except MissingArtifactError as error:
            raise StoreError(str(error)) from error

    def delete_prefix(self, prefix: str) -> int:
        """Delete all files below `prefix`; return how many. Raises StoreError."""
        keys = self.list(prefix)
        if keys:
            with _store_errors(f"delete {prefix}"):
                obstore.delete(self._store, keys)
        return len(keys)

    def delete_file(self, key: str) -> int:
        """Delete one file; return 1. Raises MissingArtifactError, StoreError."""
        check_key(key)
        with _store_errors(f"delete {key}"):
            obstore.delete(self._store, key)
        return 1

    def remove_unfinished(self, age_s: float) -> int:
        """Delete files of a local store whose writing was interrupted at least `age_s` ago; return how many.

        No listing shows them. An S3 server has none, since every file is uploaded in one request.
        """
        count = 0
        root = self.local_root
        before = time.time() - age_s
        for path in root.rglob("*#*") if root is not None else ():
            with suppress(FileNotFoundError):
                if _UNFINISHED.fullmatch(path.name) and path.stat().st_mtime < before:
                    path.unlink()
                    count += 1
        return count

    def url_for(self, key: str) -> str | None:
        """Return a signed URL from which anybody may read `key` for 15 minutes, or none for a local store."""
        check_key(key)
        if not isinstance(self._store, S3Store):
            return None
        with _store_errors(f"sign {key}"):
            return obstore.sign(self._store, "GET", key, timedelta(minutes=15))

    def check(self) -> None:
        """Write, read and delete one small file; any number of processes may do so at once. Raises StoreError."""
        key = f"{PROBES}/{secrets.token_hex(16)}"
        content = secrets.token_bytes(16)
        self.put_bytes(key, content)
        try:
            read = self.get_bytes(key)
            self.delete_file(key)
        except MissingArtifactError as error:
            raise StoreError(f"{PROBES}: what was written is missing: {error}") from None
        if read != content:
            raise StoreError(f"{PROBES}: what was read is not what was written")

    def _settle(self, key: str) -> None:
        """Force a local file and its folder to the disk: a power cut must not lose a recorded checkpoint."""
        root = self.local_root
        if root is None:
            return
        for path in (root / key, (root / key).parent):
            sync(path)
