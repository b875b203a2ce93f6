"""Identity of processes: a number is given out again, and start times of the wall clock change when that is set."""

from __future__ import annotations

import contextlib
import os
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Self


@dataclass(frozen=True)
class ProcessStat:
    """State of a process, as Linux reports it.

    Attributes:
        state: its letter in `/proc/PID/stat`.
        session: process id of the leader of its session.
        cpu_ticks: processor time that it has used, clock ticks.
        start_ticks: its start, clock ticks since boot.
    """

    state: str
    session: int
    cpu_ticks: int
    start_ticks: int

    @classmethod
    def of(cls, pid: int) -> Self:
        """Return the state of a process; raise OSError if there is none of this number."""
        # The name in brackets may hold anything, so count from its end.
        fields = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].decode("ascii").split()
        return cls(fields[0], int(fields[3]), int(fields[11]) + int(fields[12]), int(fields[19]))

    @property
    def has_ended(self) -> bool:
        """Whether the process is a zombie."""
        return self.state in "ZXx"


@dataclass(frozen=True)
class ProcessIdentity:
    """Process id, start in clock ticks since boot, boot id, and host with namespaces: unique over all time (Linux)."""

    pid: int
    ticks: int
    boot: str
    place: str

    @classmethod
    def current(cls) -> Self:
        """Return the identity of this process."""
        return cls(os.getpid(), ProcessStat.of(os.getpid()).start_ticks, boot_id(), _place())

    @classmethod
    def of(cls, pid: int) -> Self | None:
        """Return the identity of a process; None if there is none of this number."""
        ticks = start_ticks(pid)
        return None if ticks is None else cls(pid, ticks, boot_id(), _place())

    @classmethod
    def parse(cls, text: str) -> Self | None:
        """Return the identity written by `str`, None for anything else."""
        pid, _, rest = text.partition(" ")
        ticks, _, rest = rest.partition(" ")
        boot, _, place = rest.partition(" ")
        try:
            return cls(int(pid), int(ticks), boot, place) if place else None
        except ValueError:
            return None

    def __str__(self) -> str:
        """Return the text form, one line."""
        return f"{self.pid} {self.ticks} {self.boot} {self.place}"

    def runs(self) -> bool:
        """Return whether this very process can be seen from here and is no zombie."""
        return self.place == _place() and not self._ended()

    def is_gone(self) -> bool:
        """Return whether this process has ended for certain; False for one of another host or namespace."""
        return self.place == _place() and self.pid != os.getpid() and self._ended()

    def _ended(self) -> bool:
        return self.boot != boot_id() or start_ticks(self.pid) != self.ticks


def start_ticks(pid: int) -> int | None:
    """Return the start of a process in clock ticks since boot; None if there is none, or only a zombie.

    Raises:
        OSError: the process cannot be examined.
    """
    try:
        stat = ProcessStat.of(pid)
    except (FileNotFoundError, ProcessLookupError):
        return None
    return None if stat.has_ended else stat.start_ticks


def boot_id() -> str:
    """Return the id of the present boot; empty where the kernel has none."""
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return ""


def _place() -> str:
    """Return the host and the namespaces in which a process id and a start have a meaning."""
    names = [socket.gethostname()]
    for kind in ("pid", "time"):
        with contextlib.suppress(OSError):
            names.append(os.readlink(f"/proc/self/ns/{kind}"))
    return " ".join(names)
