"""Files from outside: only regular ones are read, and only up to a size."""

from __future__ import annotations

import errno
import json
import os
import stat
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from io import BufferedReader
    from pathlib import Path


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


def private_folder(path: Path) -> Path:
    """Make a folder that only its owner can use, or check one that is there, and return it.

    Only below a folder that all users may write to, where somebody else may have taken its name, is it checked.

    Raises:
        OSError: if it is a link there, belongs to another user, or others may write to it.
    """
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not path.parent.stat().st_mode & 0o002:
        return path
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        reason = "not a folder of this user alone; remove it, or choose another folder"
        raise OSError(errno.EPERM, reason, str(path))
    return path


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
