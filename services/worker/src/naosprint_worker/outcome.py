"""Outcome of a child process: its own report, without which no exit status counts as success."""

from __future__ import annotations

import contextlib
import enum
import json
import os
import shutil
import signal
from dataclasses import asdict, dataclass
from pathlib import Path

from naospec.files import write_whole

OUTCOME_FILE = "outcome.json"

SERVICE_UNAVAILABLE = "service_unavailable"
"""Kind of an outcome that the work did not cause: store, database or Docker engine did not answer."""


class TrainerExitCode(enum.IntEnum):
    """Ways in which a child reports its end, and its exit statuses (numbers from sysexits.h where one fits).

    A status alone is no report: any library can end the process with one.
    """

    FINISHED = 0
    PERMANENT = 65
    """It cannot succeed by being tried again: bad input, diverged training, a defect."""
    TRANSIENT = 69
    """Something outside failed (store, database, disk, simulator); another attempt may succeed."""
    DISK_FULL = 74
    """Its working folder's disk is full; there may be no space for a report."""
    STOPPED = 75
    """It stopped on request and left a checkpoint."""
    FENCED = 76
    """The row no longer belongs to this attempt; nothing may be written any more."""


@dataclass(frozen=True)
class Outcome:
    """A child's own report of how it ended."""

    code: TrainerExitCode
    kind: str
    message: str
    traceback: str = ""

    def write(self, workdir: Path) -> None:
        """Store the report in ``workdir``, replacing an earlier one atomically."""
        write_whole(workdir / OUTCOME_FILE, json.dumps(asdict(self)))

    def leave(self, workdir: Path) -> None:
        """Store the report in ``workdir``; on a full disk, delete the attempt's own files first.

        Call it when the work has ended: the job resumes from files in the store.
        """
        try:
            self.write(workdir)
        except OSError:
            for folder in workdir.iterdir():
                if folder.is_dir():
                    shutil.rmtree(folder, ignore_errors=True)
            with contextlib.suppress(OSError):
                self.write(workdir)

    @classmethod
    def read(cls, workdir: Path) -> Outcome | None:
        """Return the report in ``workdir``, or None if the child died before writing one."""
        try:
            data = json.loads((workdir / OUTCOME_FILE).read_text(encoding="utf-8"))
            code, kind, message = TrainerExitCode(data["code"]), str(data["kind"]), str(data["message"])
            return cls(code, kind, message, str(data.get("traceback", "")))
        except (OSError, ValueError, KeyError, TypeError):
            return None


def last_lines(path: Path, *, lines: int = 5) -> str:
    """Return the last non-empty lines of a text file, reading at most 8 KiB; empty where there is none."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - 8192))
            text = file.read().decode("utf-8", errors="replace")
    except OSError:
        return ""
    return "\n".join([line.rstrip() for line in text.splitlines() if line.strip()][-lines:])


def describe_exit(returncode: int) -> str:
    """Return an exit status in words: ``exit code 3`` or ``signal 9 (SIGKILL)``."""
    if returncode >= 0:
        return f"exit code {returncode}"
    try:
        name = signal.Signals(-returncode).name
    except ValueError:
        name = "unknown"
    return f"signal {-returncode} ({name})"
