"""Find and end training processes whose worker no longer exists."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path

import psutil
from naospec.processes import ProcessIdentity

OWNER_VARIABLE = "NAOSPRINT_CHILD_OF"
"""Environment variable of a child that contains its worker's identity."""
FOLDER_VARIABLE = "NAOSPRINT_CHILD_IN"
"""Environment variable of a child that contains the folder of its service's workers on this host."""


def child_marks(folder: Path) -> dict[str, str]:
    """Return the environment variables that mark a child of this process, a worker on ``folder``."""
    return {OWNER_VARIABLE: str(ProcessIdentity.current()), FOLDER_VARIABLE: str(folder.resolve())}


class OrphanSweeper:
    """Kill processes whose environment names a worker that is gone.

    Only processes of this user that a worker on ``folder`` has started are considered, not those of other services on
    the host, and only once they have been seen orphaned for ``grace_s`` seconds: a child that notices by itself needs
    this time for a last checkpoint.
    """

    def __init__(self, folder: Path, *, grace_s: float) -> None:
        """Start without known orphans."""
        self._folder = str(folder.resolve())
        self._grace_s = grace_s
        self._first_seen: dict[ProcessIdentity, float] = {}

    def sweep(self) -> list[int]:
        """Check once; return the ids of the killed processes."""
        now = time.monotonic()
        seen: dict[ProcessIdentity, float] = {}
        ended = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                identity = ProcessIdentity.of(process.pid)
                if identity is None or process.uids().real != os.getuid() or not self._is_orphan(process.environ()):
                    continue
                seen[identity] = self._first_seen.get(identity, now)
                if now - seen[identity] >= self._grace_s:
                    process.send_signal(signal.SIGKILL)
                    ended.append(process.pid)
        self._first_seen = seen
        return ended

    def _is_orphan(self, environment: Mapping[str, str]) -> bool:
        owner = ProcessIdentity.parse(environment.get(OWNER_VARIABLE, ""))
        return owner is not None and environment.get(FOLDER_VARIABLE) == self._folder and owner.is_gone()
