"""Downloads that resume after an interruption and check the SHA-256 of every file."""

from __future__ import annotations

import hashlib
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import httpx
from naospec.files import named_errors, sync

from naoctl.client import ApiError, Client, raise_for_problem, unreachable
from naoctl.errors import CliError, ExitCode

ATTEMPTS = 7
"""Number of attempts to resume after a lost connection or a wrong answer: about 20 s."""

PAUSE_S = 0.5
"""Half of the first pause between two attempts; each is twice as long as the one before, and none longer than 5 s."""


class WrongAnswer(CliError):
    """Answer with other bytes than promised, which a store in trouble may give for a moment."""

    def __init__(self, message: str) -> None:
        fix = "Nothing was kept; run the same command again, and if it repeats, the store is damaged."
        super().__init__(message, fix=fix, code=ExitCode.CORRUPT)


@dataclass(frozen=True)
class RemoteFile:
    """File of the service: its address, its size in bytes and its SHA-256 in hexadecimal digits."""

    name: str
    url: str
    size: int
    sha256: str


def plain_name(text: object, default: str = "unnamed") -> str:
    """Return a plain file name made of text from outside: at most 60 letters, digits, ``.``, ``_`` and ``-``."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", str(text))[:60].strip(".-") or default


def safe_relative(name: str) -> Path:
    """Return the local relative path for a file name given by the service.

    Raises:
        CliError: when the name would leave the folder it is put in.
    """
    pure = PurePosixPath(name)
    odd = not name or pure.is_absolute() or "\\" in name or not name.isprintable()
    if odd or any(part in ("..", ".") or ":" in part for part in name.split("/")) or name.endswith("/"):
        raise CliError(
            f"The service named a file {name!r} that would lie outside the folder",
            fix="Nothing was written; do not trust this service.",
        )
    return Path(*pure.parts)


def fetch(
    client: Client,
    remote: RemoteFile,
    folder: Path,
    *,
    progress: Callable[[int], None] | None = None,
    sleep: Callable[[float], None] = time.sleep,
) -> Path:
    """Download one file into a folder and return its path.

    A complete file is not downloaded again. Bytes arrive in ``NAME.part``; a part that an interrupted
    download left behind is continued by a range request. The file takes its name only once its SHA-256 is right; other
    bytes, and a file that is missing or cannot be served, are asked for again.

    Args:
        client: the service.
        remote: the file.
        folder: where to put it; made if missing.
        progress: called with the number of bytes of this file so far.
        sleep: waits between attempts.

    Raises:
        CliError: with ``ExitCode.CORRUPT`` when the bytes are not those the service promised; the part is removed.
    """
    report = progress or (lambda _: None)
    target = folder / safe_relative(remote.name)
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.is_file() and target.stat().st_size == remote.size and file_sha256(target) == remote.sha256:
        report(remote.size)
        return target
    part = target.with_name(target.name + ".part")
    for attempt in range(1, ATTEMPTS + 1):
        try:
            _continue(client, remote, part, report)
            actual = file_sha256(part)
            if actual != remote.sha256:
                part.unlink()
                text = f"received with SHA-256 {actual[:12]}… instead of {remote.sha256[:12]}…"
                raise WrongAnswer(f"{remote.name} was {text}")
            break
        except (WrongAnswer, ApiError) as error:
            if attempt == ATTEMPTS or (isinstance(error, ApiError) and error.status != 404 and error.status < 500):
                raise
        except httpx.TransportError as error:
            if attempt == ATTEMPTS and isinstance(error, httpx.ConnectError | httpx.ConnectTimeout):
                raise unreachable(client.target.url, error) from None
            if attempt == ATTEMPTS:
                raise CliError(
                    f"{remote.name}: the connection broke {ATTEMPTS} times ({error or type(error).__name__})",
                    fix="Run the same command again, which resumes; if it repeats, the service's store is in trouble.",
                    code=ExitCode.UNREACHABLE,
                ) from None
        sleep(min(PAUSE_S * 2**attempt, 5.0))
    part.replace(target)
    sync(target.parent)
    return target


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file as hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _continue(client: Client, remote: RemoteFile, part: Path, report: Callable[[int], None]) -> None:
    have = part.stat().st_size if part.exists() else 0
    if have > remote.size:
        part.unlink()
        have = 0
    if have == remote.size and have > 0:
        return
    headers = {"Accept": "*/*", "Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
    with client.open_stream(remote.url, headers) as response:
        raise_for_problem(response)
        if response.status_code == 206:
            match = re.match(r"bytes (\d+)-", response.headers.get("content-range", ""))
            if not match or int(match[1]) != have:
                part.unlink(missing_ok=True)
                raise WrongAnswer(f"{remote.name} was answered with another range than requested")
        else:
            have = 0
        with named_errors(part), part.open("ab" if have else "wb") as file:
            for chunk in response.iter_raw():
                have += len(chunk)
                if have > remote.size:
                    part.unlink()
                    raise WrongAnswer(f"{remote.name} is longer than the {remote.size:,} bytes promised")
                file.write(chunk)
                report(have)
            file.flush()
            os.fsync(file.fileno())
