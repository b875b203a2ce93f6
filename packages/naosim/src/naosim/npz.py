"""``.npz`` files: whole when they are written, and read without trusting their content."""

from __future__ import annotations

import math
import os
import struct
import zipfile
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from naospec.files import open_regular, replacing

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

MAX_ARRAYS = 1000
"""Most arrays of a file."""

_MAX_DIRECTORY_BYTES = 1_000_000
_MAX_REASON = 500
_END = struct.Struct("<4s4H2IH")
_HEADER_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]], *, compressed: bool = True) -> None:
    """Write arrays to a file, which is replaced at the end or stays as it is.

    Raises:
        OSError: naming the file, if it cannot be written.
    """
    with replacing(path) as file:
        (np.savez_compressed if compressed else np.savez)(file, allow_pickle=False, **arrays)


def read_npz(
    path: Path, *, kinds: str = "fiub", max_bytes: int | None = None, skip: str | None = None
) -> dict[str, NDArray[Any]]:
    """Read the arrays of a ``.npz`` file by name.

    Args:
        path: a regular file.
        kinds: kinds of data types that it may contain; objects are never read.
        max_bytes: most bytes of all arrays together; None: of arrays that are not compressed, as many as the file has.
        skip: names that begin so are left out.

    Raises:
        OSError: if it cannot be read or is not a regular file.
        ValueError: if it is damaged, or contains or announces anything else.
    """
    try:
        with open_regular(path) as stream:
            size = os.fstat(stream.fileno()).st_size
            _check_directory(stream, size)
            with zipfile.ZipFile(stream) as archive:
                return _read_members(archive, kinds, size if max_bytes is None else max_bytes, max_bytes is None, skip)
    except OSError:
        raise
    except Exception as error:  # whatever the parsers of a damaged file raise: of zip, of headers, of their literals
        reason = "too deeply nested" if isinstance(error, RecursionError) else str(error) or type(error).__name__
        # names and headers of the file, which errors contain, may be long
        raise ValueError(reason if len(reason) <= _MAX_REASON else f"{reason[:_MAX_REASON]}...") from error


def _check_directory(stream: BinaryIO, size: int) -> None:
    """Check the size of the directory, which is otherwise read whole; NumPy's files end with its address."""
    stream.seek(max(0, size - _END.size))
    end = stream.read(_END.size)
    if len(end) < _END.size or not end.startswith(b"PK\x05\x06"):
        raise ValueError("not a .npz file")
    _, _, _, _, members, directory_bytes, _, comment = _END.unpack(end)
    if members > MAX_ARRAYS or directory_bytes > _MAX_DIRECTORY_BYTES or comment:
        raise ValueError(f"{members} arrays are too many" if members > MAX_ARRAYS else "not a .npz file")


def _read_members(
    archive: zipfile.ZipFile, kinds: str, most: int, stored: bool, skip: str | None
) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {}
    members = archive.infolist()
    if len(members) > MAX_ARRAYS:
        raise ValueError(f"{len(members)} arrays are too many")
    left = most
    for member in members:
        name = member.filename.removesuffix(".npy")
        if skip is not None and name.startswith(skip):
            continue
        if name == member.filename or name in arrays or (stored and member.compress_type != zipfile.ZIP_STORED):
            raise ValueError(f"{member.filename}: not an {'uncompressed ' if stored else ''}array, or there twice")
        left -= member.file_size  # members may share their bytes, so that each fits but all together do not
        if left < 0:
            raise ValueError(f"announces more than {most:,} bytes")
        with archive.open(member) as stream:
            version = np.lib.format.read_magic(stream)
            if version not in _HEADER_READERS:
                raise ValueError(f"{member.filename}: unknown array version {version}")
            shape, fortran, dtype = _HEADER_READERS[version](stream)
            if dtype.hasobject or dtype.kind not in kinds or (stored and fortran) or dtype.itemsize == 0:
                raise ValueError(f"{member.filename}: {dtype} is not a type of plain {'numbers' if stored else 'data'}")
            if not all(type(length) is int and 0 <= length < 2**48 for length in shape):
                raise ValueError(f"{member.filename}: {shape} is not a shape")
            wanted = math.prod(shape) * dtype.itemsize
            if wanted > member.file_size:
                raise ValueError(f"{member.filename}: announces {wanted} bytes but has fewer")
            data = stream.read(wanted)
            if len(data) < wanted:
                raise ValueError(f"{member.filename}: announces {wanted} bytes but has fewer")
            arrays[name] = np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C").copy()
    return arrays
