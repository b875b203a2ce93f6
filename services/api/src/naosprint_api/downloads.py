"""Downloads: single byte ranges of a file, and all files as one tar archive."""

from __future__ import annotations

import logging
import re
import tarfile
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from datetime import datetime
from functools import partial
from typing import TypeVar

from anyio import CapacityLimiter, to_thread
from fastapi import Request
from fastapi.responses import RedirectResponse, Response, StreamingResponse
from naojobs.errors import NotFoundError
from naojobs.store import ArtifactStore, ManifestEntry, MissingArtifactError, StoreError, StoreManifest
from starlette.types import Receive, Scope, Send

from naosprint_api.problems import FieldError, ProblemError

_log = logging.getLogger(__name__)

_RANGE = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")
_BLOCK = 512
_BINARY = "application/octet-stream"

T = TypeVar("T")


def parse_range(header: str, size: int) -> tuple[int, int] | None:
    """Return (start, stop) of a Range header for a file of `size` bytes; none to send all of it.

    A header that is not one byte range is ignored, as RFC 9110 allows. Raises ProblemError 416 if the range is outside
    the file.
    """
    match = _RANGE.fullmatch(header.strip())
    if match is None or match.group(0) == "bytes=-":
        return None
    first, last = match.groups()
    if first == "":
        start, stop = max(0, size - int(last)), size
    else:
        start, stop = int(first), min(size, int(last) + 1 if last else size)
        if last and int(last) < start:
            return None
    if start >= size or start >= stop:
        message = f"the file has {size} bytes"
        raise ProblemError(
            416, message, [FieldError(field="Range", message=message)], {"Content-Range": f"bytes */{size}"}
        )
    return start, stop


class StoredResponse(StreamingResponse):
    """Response whose content comes from the store, read in its own threads.

    The first piece is read before the response starts, so that a failure becomes a problem document.
    """

    def __init__(
        self,
        open_content: Callable[[], Iterator[bytes]],
        threads: CapacityLimiter,
        status_code: int = 200,
        *,
        headers: Mapping[str, str],
        media_type: str,
    ) -> None:
        super().__init__((), status_code, headers, media_type)
        self._open_content = open_content
        self._threads = threads

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Open the content and send it."""
        content = await self._in_thread(self._open_content)
        self.body_iterator = self._pieces(content, await self._in_thread(partial(next, content, None)))
        await super().__call__(scope, receive, send)

    async def _pieces(self, content: Iterator[bytes], piece: bytes | None) -> AsyncIterator[bytes]:
        while piece is not None:
            yield piece
            piece = await self._in_thread(partial(next, content, None))

    async def _in_thread(self, call: Callable[[], T]) -> T:
        return await to_thread.run_sync(call, limiter=self._threads, abandon_on_cancel=True)


def _stream(store: ArtifactStore, key: str, start: int = 0, stop: int | None = None) -> Iterator[bytes]:
    """Open a file as `ArtifactStore.stream` does; it is missing only if the store does not list it either."""
    try:
        return store.stream(key, start, stop)
    except MissingArtifactError as error:
        if store.has(key):
            raise StoreError(f"{error}, but it is listed") from error
        raise


def send_file(
    request: Request,
    store: ArtifactStore,
    threads: CapacityLimiter,
    key: str,
    manifest: StoreManifest,
    name: str,
    *,
    presigned: bool,
) -> Response:
    """Answer with a file of an artifact, or the requested range of it.

    Only names that the manifest lists are ever looked up, so none can lead elsewhere. With `presigned`, redirect to the
    store if it can sign. Raises NotFoundError, StoreError.
    """
    entry = manifest.entry(name)
    if entry is None:
        _log.warning("refused a file name that is not in the list of %s: %.200r", key, name)
        raise NotFoundError(f"there is no file {name[:200]!r}; use a name from the list")
    target = f"{key}/{entry.name}"
    if presigned and (url := store.url_for(target)) is not None:
        return RedirectResponse(url, status_code=307)
    tag = f'"{entry.sha256}"'
    headers = {
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, max-age=31536000, immutable",
        "Content-Disposition": f'attachment; filename="{entry.name.rsplit("/", 1)[-1]}"',
        "ETag": tag,
        "Vary": "Authorization",  # what one token has fetched is in no cache for another
        "X-SHA256": entry.sha256,
    }
    if tag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    part = None
    if (asked := request.headers.get("range")) and request.headers.get("if-range", tag) == tag:
        part = parse_range(asked, entry.size)
    if part is None:
        headers["Content-Length"] = str(entry.size)
        return StoredResponse(partial(_stream, store, target), threads, headers=headers, media_type=_BINARY)
    start, stop = part
    headers["Content-Length"] = str(stop - start)
    headers["Content-Range"] = f"bytes {start}-{stop - 1}/{entry.size}"
    return StoredResponse(
        partial(_stream, store, target, start, stop), threads, 206, headers=headers, media_type=_BINARY
    )


def send_archive(
    store: ArtifactStore, threads: CapacityLimiter, key: str, manifest: StoreManifest, folder: str, at: datetime
) -> Response:
    """Answer with all files of an artifact as one tar archive, its files below `folder`."""
    headers = {
        "Content-Disposition": f'attachment; filename="{folder}.tar"',
        "Content-Length": str(_archive_size(manifest, folder)),
    }
    content = partial(_archive, store, key, manifest, folder, at)
    return StoredResponse(content, threads, headers=headers, media_type="application/x-tar")


def _header(entry: ManifestEntry, folder: str, at: datetime | None = None) -> bytes:
    info = tarfile.TarInfo(f"{folder}/{entry.name}")
    info.size = entry.size
    info.mode = 0o644
    info.mtime = int(at.timestamp()) if at is not None else 0
    return info.tobuf(tarfile.PAX_FORMAT)


def _archive_size(manifest: StoreManifest, folder: str) -> int:
    files = sum(len(_header(entry, folder)) + -(-entry.size // _BLOCK) * _BLOCK for entry in manifest.files)
    return files + 2 * _BLOCK


def _archive(store: ArtifactStore, key: str, manifest: StoreManifest, folder: str, at: datetime) -> Iterator[bytes]:
    for entry in manifest.files:
        content = _stream(store, f"{key}/{entry.name}")
        yield _header(entry, folder, at)
        yield from content
        yield bytes(-entry.size % _BLOCK)
    yield bytes(2 * _BLOCK)
