"""Files and folders: which of those that others could have made are read or used, and how files are written."""

from __future__ import annotations

import atexit
import contextlib
import errno
import fcntl
import functools
import hashlib
import json
import os
import re
import secrets
import shutil
import stat
import tempfile
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any

from naospec.processes import ProcessIdentity, start_ticks

if TYPE_CHECKING:
    from collections.abc import Iterator
    from io import BufferedReader, BufferedWriter

_OF_DISKS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)
_PARTIAL = re.compile(r"\..+\.(\d+)-(\d+)-([0-9a-f]{8})-[0-9a-f]{8}\.partial")
"""Names of unfinished files and folders: what they become, the process that writes them, its host, and random
digits.
"""
_written: ContextVar[list[tuple[Path | None, Path]] | None] = ContextVar("written", default=None)
"""Files that are written together, each under the name of an unfinished file and the one that it gets; none for one
that is not written this time.
"""


def open_regular(path: Path) -> BufferedReader:
    """Open a file to read; a pipe or a device, which could block or never end, is refused.

    Raises:
        OSError: if it cannot be opened or is not a regular file.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a regular file but a directory, a pipe or a device", str(path))
    return os.fdopen(descriptor, "rb")


def private_folder(path: Path, account: int | None = None) -> Path:
    """Make a folder that only its owner can use, or check one that is there, and return it.

    Only below a folder that all users may write to, where somebody else may have taken its name or that of a folder
    above it, is it checked.

    Args:
        path: the folder.
        account: user id that it may belong to instead of this process's.

    Raises:
        OSError: if it, or a folder above it, is a link there, belongs to another user, or others may write to it.
    """
    owners = {os.getuid(), os.getuid() if account is None else account}
    for folder in reversed(path.absolute().parents):
        if _is_foreign(folder, owners | {0}, shared=True):
            raise _refusal(folder)
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    if _is_foreign(path.absolute(), owners, shared=False):
        raise _refusal(path)
    return path


def user_folder(name: str) -> Path:
    """Return a folder for temporary files that all processes of this user share.

    Where another user has taken its name it is a new one, of this process alone.
    """
    path = Path(tempfile.gettempdir()) / f"{name}-{os.getuid()}"
    try:
        return private_folder(path)
    except OSError:
        return _own_folder(path)


@functools.cache
def _own_folder(path: Path) -> Path:
    folder = tempfile.TemporaryDirectory(prefix=f"{path.name}-", dir=path.parent)
    atexit.register(folder.cleanup)
    return Path(folder.name)


def _is_foreign(folder: Path, owners: set[int], *, shared: bool) -> bool:
    """Return whether others could have made or can change a folder; none, and one that nobody else could make, is not.

    Args:
        folder: absolute path of the folder.
        owners: user ids that it may belong to.
        shared: whether others may write to it if they can delete only what is theirs, as in /tmp.
    """
    try:
        found = folder.lstat()
    except FileNotFoundError:
        return False
    if not folder.parent.stat().st_mode & stat.S_IWOTH:
        return False
    is_open = found.st_mode & 0o022 and not (shared and found.st_mode & stat.S_ISVTX)
    return not stat.S_ISDIR(found.st_mode) or found.st_uid not in owners or bool(is_open)


def _refusal(folder: Path) -> OSError:
    reason = "not a folder of this user alone; remove it, or choose another folder"
    return OSError(errno.EPERM, reason, str(folder))


def read_bounded(path: Path, max_bytes: int) -> bytes:
    """Return the content of a regular file.

    Raises:
        OSError: if it cannot be read or is not a regular file.
        ValueError: if it is longer than ``max_bytes``.
    """
    with open_regular(path) as stream:
        data = stream.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise ValueError(f"more than {max_bytes:,} bytes are too many")
    return data


@contextlib.contextmanager
def named_errors(path: Path) -> Iterator[None]:
    """Add a path to errors of a disk that have none, as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno in _OF_DISKS:
            error.filename = str(path)
        raise


@contextlib.contextmanager
def replacing(path: Path, *, mode: int = 0o666) -> Iterator[BufferedWriter]:
    """Yield a new file that replaces ``path`` at the end: whole and on the disk, or not at all.

    Args:
        path: the file.
        mode: its permissions, less those that the umask excludes.

    Raises:
        OSError: naming the file, if it cannot be written.
    """
    partial = partial_of(path)
    with named_errors(path):
        try:
            descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
            with os.fdopen(descriptor, "wb") as file:
                yield file
                file.flush()
                os.fsync(descriptor)
            publish(partial, path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise


@contextlib.contextmanager
def together() -> Iterator[None]:
    """Write several files: what this thread replaces within appears at the end, or after an error nothing of it.

    Until then none of them can be read. Files of different calls never lie side by side, also if a process is killed or
    two write at once: those from before are gone when the first appears. One that is killed just then leaves some of
    one kind.
    """
    if _written.get() is not None:
        yield
        return
    written: list[tuple[Path | None, Path]] = []
    token = _written.set(written)
    try:
        try:
            yield
        finally:
            _written.reset(token)
        if len({path for _, path in written}) > 1:
            _publish_all(written)
        else:
            for partial, path in written:
                drop(path) if partial is None else publish(partial, path)
    except BaseException:
        for partial, _ in written:
            if partial is not None:
                partial.unlink(missing_ok=True)
        raise


def _publish_all(written: list[tuple[Path | None, Path]]) -> None:
    """Move the files from before aside, then give the unfinished ones their names; undo all of it after an error."""
    folders = sorted({path.parent for _, path in written})
    before: list[tuple[Path, Path]] = []
    after: list[Path] = []
    with contextlib.ExitStack() as locks:
        for folder in folders:
            locks.enter_context(_alone(folder))
        try:
            for _, path in written:
                if path.is_dir() and not path.is_symlink():
                    raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
                aside = partial_of(path)
                with contextlib.suppress(FileNotFoundError):
                    path.rename(aside)
                    before.append((aside, path))
            for folder in folders:
                sync(folder)
            for partial, path in written:
                if partial is not None:
                    partial.replace(path)
                    after.append(path)
            for folder in folders:
                sync(folder)
        except BaseException:
            for path in after:
                path.unlink(missing_ok=True)
            for aside, path in before:
                aside.replace(path)
            raise
    for aside, _ in before:
        aside.unlink(missing_ok=True)


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Wait until no other process publishes several files in a folder; on a disk without locks, do not wait."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def publish(partial: Path, path: Path) -> Path:
    """Give an unfinished file the name ``path``, within ``together`` at its end; return the name that it has now."""
    written = _written.get()
    if written is not None:
        written.append((partial, path))
        return partial
    partial.replace(path)
    sync(path.parent)
    return path


def drop(path: Path) -> None:
    """Delete a file from before, if there is one, within ``together`` when the new ones appear."""
    written = _written.get()
    if written is None:
        path.unlink(missing_ok=True)
    else:
        written.append((None, path))


def write_whole(path: Path, data: str | bytes, *, mode: int = 0o666) -> None:
    """Replace the content of a file, as ``replacing`` does; text becomes UTF-8."""
    with replacing(path, mode=mode) as file:
        file.write(data.encode() if isinstance(data, str) else data)


def sync(path: Path) -> None:
    """Force a file, or the names in a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def partial_of(path: Path) -> Path:
    """Return a name for an unfinished file or folder beside ``path``; delete what processes that ended have left there.

    Those of other hosts and containers stay: whether they run cannot be seen from here.
    """
    own = ProcessIdentity.current()
    place = hashlib.sha256(own.place.encode()).hexdigest()[:8]
    for left in path.parent.iterdir() if path.parent.is_dir() else ():
        match = _PARTIAL.fullmatch(left.name)
        if match and match[3] == place and start_ticks(int(match[1])) != int(match[2]):
            with contextlib.suppress(OSError):
                shutil.rmtree(left) if left.is_dir() and not left.is_symlink() else left.unlink()
    return path.with_name(f".{path.name}.{own.pid}-{own.ticks}-{place}-{secrets.token_hex(4)}.partial")


def read_json(path: Path, max_bytes: int) -> Any:
    """Return the content of a JSON file.

    Raises:
        OSError: if it cannot be read or is not a regular file.
        ValueError: if it is too long, too deeply nested, or not JSON.
    """
    try:
        return json.loads(read_bounded(path, max_bytes))
    except RecursionError:
        raise ValueError("too deeply nested") from None
