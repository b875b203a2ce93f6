"""Folders that workers leave on the disk."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from naospec.processes import ProcessIdentity
from naosprint_worker.worker import OWNER_FILE, _remove_left_folders

ALIVE = ProcessIdentity.current()


@pytest.mark.parametrize(
    ("owner", "stays"),
    [
        (str(ALIVE).encode(), True),
        (str(replace(ALIVE, pid=1, boot="earlier")).encode(), False),
        (b"", False),
        (b"\xff", False),
    ],
    ids=["alive", "gone", "emptied", "damaged"],
)
def test_a_worker_that_starts_removes_the_folders_of_those_that_are_gone(
    tmp_path: Path, owner: bytes, stays: bool
) -> None:
    """A power cut may have emptied or damaged the name of the owner."""
    folder = tmp_path / "host-1-2"
    folder.mkdir()
    (folder / OWNER_FILE).write_bytes(owner)
    (folder / "checkpoint.npz").write_bytes(b"weights")
    _remove_left_folders(tmp_path)
    assert folder.exists() is stays
