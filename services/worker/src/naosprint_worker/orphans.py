"""Find and end training processes whose worker no longer exists."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from dataclasses import dataclass

import psutil

OWNER_VARIABLE = "NAOSPRINT_CHILD_OF"


@dataclass(frozen=True)
class Owner:
    """Identity of a worker process on one machine: its process id, which may be reused, and its start time."""

    namespace: str
    pid: int
    started: float

    @classmethod
    def current(cls) -> Owner:
        """Return this process's identity."""
        return cls(_pid_namespace(), os.getpid(), psutil.Process().create_time())

    @classmethod
    def parse(cls, text: str) -> Owner | None:
        """Return the identity written by `str`, None for anything else."""
        namespace, _, rest = text.rpartition(" ")
        pid, _, started = rest.partition("@")
        try:
            return cls(namespace, int(pid), float(started))
        except ValueError:
            return None

    def __str__(self) -> str:
        """Return the text form for a child's environment."""
        return f"{self.namespace} {self.pid}@{self.started!r}"

    def alive(self) -> bool:
        """Return whether the same process still runs; valid only in the owner's process-id namespace."""
        try:
            process = psutil.Process(self.pid)
            return bool(process.status() != psutil.STATUS_ZOMBIE) and abs(process.create_time() - self.started) < 0.05
        except psutil.NoSuchProcess:
            return False
        except psutil.Error:
            return True


class OrphanSweeper:
    """Kill processes whose environment names a worker that is gone.

    Only processes of this user whose environment names an owner in this process-id namespace are considered, and only
    once they have been seen orphaned for ``grace_s`` seconds: a child that notices by itself needs this time for a last
    checkpoint.
    """

    def __init__(self, *, grace_s: float) -> None:
        """Start without known orphans."""
        self._grace_s = grace_s
        self._first_seen: dict[tuple[int, float], float] = {}

    def sweep(self) -> list[int]:
        """Check once; return the ids of the killed processes."""
        now = time.monotonic()
        seen: dict[tuple[int, float], float] = {}
        ended = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                if not _is_orphan(process):
                    continue
                key = (process.pid, process.create_time())
                seen[key] = self._first_seen.get(key, now)
                if now - seen[key] >= self._grace_s:
                    process.send_signal(signal.SIGKILL)
                    ended.append(process.pid)
        self._first_seen = seen
        return ended


def _is_orphan(process: psutil.Process) -> bool:
    if process.uids().real != os.getuid() or process.status() == psutil.STATUS_ZOMBIE:
        return False
    owner = Owner.parse(process.environ().get(OWNER_VARIABLE, ""))
    return owner is not None and owner.namespace == _pid_namespace() and not owner.alive()


def _pid_namespace() -> str:
    with contextlib.suppress(OSError):
        return os.readlink("/proc/self/ns/pid")
    return "host"
