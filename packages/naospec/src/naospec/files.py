"""Files and folders that others could have made: what is read of them, and which are used."""

from __future__ import annotations

import atexit
import errno
import functools
import json
import os
import stat
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from io import BufferedReader


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
