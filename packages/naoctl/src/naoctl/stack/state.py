"""State of a stack on disk, with which other processes find and stop it."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import uuid
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import psutil
from naospec.files import write_whole
from naospec.processes import ProcessIdentity

from naoctl.config import PRIVATE
from naoctl.errors import StackError
from naoctl.stack.layout import Layout

MARK = "NAOSPRINT_STACK_ID"
"""Environment variable that marks every process of a stack, and its descendants, with the stack's id."""


@dataclass(frozen=True)
class ProcessRecord:
    """Process of the stack: its name, and its identity, since a pid alone is used again."""

    name: str
    identity: ProcessIdentity

    @classmethod
    def of(cls, name: str, pid: int) -> Self | None:
        """Return the record of a process; None if it has ended."""
        identity = ProcessIdentity.of(pid)
        return None if identity is None else cls(name, identity)

    @classmethod
    def load(cls, data: dict[str, Any]) -> Self | None:
        """Return the record made by ``asdict``; None for one with a start time, as versions up to 0.1 wrote."""
        if "identity" not in data:
            return None
        return cls(data["name"], ProcessIdentity(**data["identity"]))

    @property
    def pid(self) -> int:
        """Process id."""
        return self.identity.pid

    def process(self) -> psutil.Process | None:
        """Return the process if it is still the one recorded and no zombie."""
        with contextlib.suppress(psutil.Error, OSError):
            process = psutil.Process(self.pid)
            return process if self.identity.runs() else None
        return None


@dataclass
class StackState:
    """State of a stack: its permanent id, its ports, and the processes of the latest start."""

    stack_id: str = field(default_factory=lambda: uuid.uuid4().hex)
    api_port: int | None = None
    broker_port: int | None = None
    ready: bool = False
    supervisor: ProcessRecord | None = None
    processes: dict[str, ProcessRecord] = field(default_factory=dict)

    @property
    def url(self) -> str | None:
        """Address of the API; available once a port was chosen."""
        return f"http://127.0.0.1:{self.api_port}" if self.api_port else None

    @classmethod
    def load(cls, layout: Layout) -> StackState | None:
        """Read the state of a folder, or return None if no stack was ever started there.

        A copy of a data folder is a stack of its own: the processes in its file belong to the original.

        Raises:
            StackError: when the file is damaged.
        """
        try:
            data: dict[str, Any] = json.loads(layout.state.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise StackError(f"{layout.state} is damaged ({error})", fix="Remove that file; data stays.") from None
        try:
            supervisor, processes = data.pop("supervisor"), data.pop("processes")
            if data.pop("folder", str(layout.root)) != str(layout.root) and not is_locked(layout):
                return cls(api_port=data["api_port"], broker_port=data["broker_port"])
            records = {name: ProcessRecord.load(record) for name, record in processes.items()}
            return cls(
                **data,
                supervisor=ProcessRecord.load(supervisor) if supervisor else None,
                processes={name: record for name, record in records.items() if record is not None},
            )
        except (KeyError, TypeError, AttributeError):
            raise StackError(f"{layout.state} is damaged", fix="Remove that file; data stays.") from None

    def save(self, layout: Layout) -> None:
        """Write the state, whole or not at all."""
        text = json.dumps({**asdict(self), "folder": str(layout.root)}, indent=2)
        write_whole(layout.state, text + "\n", mode=PRIVATE)


class FolderLock:
    """Lock of a data folder by one supervisor; the kernel releases it when the supervisor dies."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: int | None = None

    def acquire(self) -> bool:
        """Try to take the lock; return whether this process has it."""
        # Descriptors of Python are closed on exec: no child inherits the lock.
        file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            return False
        self._file = file
        return True

    def release(self) -> None:
        """Release the lock."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def is_locked(layout: Layout) -> bool:
    """Return whether a supervisor uses the folder."""
    if not layout.lock.exists():
        return False
    lock = FolderLock(layout.lock)
    free = lock.acquire()
    lock.release()
    return not free


def marked_processes(stack_id: str) -> list[psutil.Process]:
    """Return all running processes with the stack's mark, except the caller."""
    found = []
    for process in psutil.process_iter():
        if process.pid == os.getpid():
            continue
        with contextlib.suppress(psutil.Error, OSError):
            if process.status() != psutil.STATUS_ZOMBIE and process.environ().get(MARK) == stack_id:
                found.append(process)
    return found
