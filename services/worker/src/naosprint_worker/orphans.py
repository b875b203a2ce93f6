"""Find and end training processes whose worker no longer exists, and remove its files."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import psutil
from naojobs import leases, outcomes
from naojobs.database import Sessions
from naojobs.errors import ConflictError, LeaseLostError
from naospec.files import write_whole
from naospec.processes import ProcessIdentity

from naosprint_worker.assignment import read_lease
from naosprint_worker.database import DATABASE_ERRORS
from naosprint_worker.outcome import Outcome, TrainerExitCode

OWNER_VARIABLE = "NAOSPRINT_CHILD_OF"
"""Environment variable of a child that contains its worker's identity."""
FOLDER_VARIABLE = "NAOSPRINT_CHILD_IN"
"""Environment variable of a child that contains the folder of its service's workers on this host."""
OWNER_FILE = "owner"
"""File in a worker's working folder that contains its identity; the worker touches it as long as it lives."""
UNTOUCHED_S = 3600.0
"""Seconds after which a worker that cannot be seen from here, and touches nothing in its folder, is taken for gone."""


def child_marks(folder: Path) -> dict[str, str]:
    """Return the environment variables that mark a child of this process, a worker on ``folder``."""
    return {OWNER_VARIABLE: str(ProcessIdentity.current()), FOLDER_VARIABLE: str(folder.resolve())}


def touch_owner(folder: Path) -> None:
    """Show that this process, the worker of a working folder, lives; make the folder where it is missing."""
    try:
        os.utime(folder / OWNER_FILE)
    except FileNotFoundError:
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / OWNER_FILE, str(ProcessIdentity.current()))


def settle_orphan(sessions: Sessions, workdir: Path, outcome: Outcome | None = None) -> None:
    """Settle the work of a child whose worker has died; otherwise it would wait until the lease expires.

    It has succeeded if the child has finished and all is stored, and is queued again otherwise.
    """
    with contextlib.suppress(LeaseLostError, ConflictError, *DATABASE_ERRORS):
        lease = read_lease(workdir)
        finished = outcome is not None and outcome.code is TrainerExitCode.FINISHED
        if not finished or outcomes.succeed(sessions, lease) is not None:
            outcomes.lose(sessions, lease, f"worker {lease.owner} died")


def attempt_is_over(sessions: Sessions, workdir: Path) -> bool:
    """Return whether the attempt in ``workdir``, whose worker is gone, no longer has its lease; settle a finished one.

    A child that finishes just before its worker dies does not notice that it is an orphan. A folder without an
    assignment has no attempt. As long as the database does not answer, none is over.
    """
    try:
        lease = read_lease(workdir)
    except (OSError, ValueError, KeyError):
        return True
    outcome = Outcome.read(workdir)
    if outcome is not None and outcome.code is TrainerExitCode.FINISHED:
        settle_orphan(sessions, workdir, outcome)
    try:
        leases.read_requests(sessions, lease)
    except LeaseLostError:
        return True
    except DATABASE_ERRORS:
        pass
    return False


class OrphanSweeper:
    """Kill processes whose environment names a worker that is gone, and then remove its working folder.

    Only processes of this user that a worker on ``folder`` has started are considered, not those of other services on
    the host, and only once they have been seen orphaned for ``grace_s`` seconds: a child that notices by itself needs
    this time for a last checkpoint.

    A worker of another host or container cannot be seen from here, for example one in a container that was made again
    on the same volume. It has gone if nothing was touched in its folder for ``untouched_s`` seconds of this process.

    A folder stays as long as one of the attempts in it is not over: ``is_over`` takes the attempt's folder.
    """

    def __init__(
        self, folder: Path, is_over: Callable[[Path], bool], *, grace_s: float, untouched_s: float = UNTOUCHED_S
    ) -> None:
        """Start without known orphans."""
        self._folder = folder.resolve()
        self._is_over = is_over
        self._grace_s, self._untouched_s = grace_s, untouched_s
        self._touched: dict[Path, tuple[Sequence[int], float]] = {}
        """By working folder, the times of its files, and since when these are known."""
        self._first_seen: dict[ProcessIdentity, float] = {}

    def sweep(self) -> list[int]:
        """Check once; return the ids of the killed processes. Files of processes that may still run stay."""
        now = time.monotonic()
        left = self._left_folders()  # before the processes, so that the orphans of each are among these
        seen: dict[ProcessIdentity, float] = {}
        ended = []
        owners: set[ProcessIdentity] = set()
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                identity = ProcessIdentity.of(process.pid)
                if identity is None or process.uids().real != os.getuid():
                    continue
                owner = self._lost_owner(process.environ())
                if owner is None:
                    continue
                owners.add(owner)
                seen[identity] = self._first_seen.get(identity, now)
                if now - seen[identity] >= self._grace_s:
                    process.send_signal(signal.SIGKILL)
                    ended.append(process.pid)
        self._first_seen = seen
        for folder, owner in left:
            if owner not in owners and all([self._is_over(attempt) for attempt in folder.glob("*/")]):
                shutil.rmtree(folder, ignore_errors=True)
        return ended

    def _lost_owner(self, environment: Mapping[str, str]) -> ProcessIdentity | None:
        """Return the worker of an orphan's environment; none for any other process."""
        owner = ProcessIdentity.parse(environment.get(OWNER_VARIABLE, ""))
        of_folder = environment.get(FOLDER_VARIABLE) == str(self._folder)
        return owner if owner is not None and of_folder and owner.is_gone() else None

    def _left_folders(self) -> list[tuple[Path, ProcessIdentity | None]]:
        """Return the working folders of workers that are gone, with their owners; a power cut may empty the file."""
        left = []
        known, self._touched = self._touched, {}
        for mark in self._folder.glob(f"*/{OWNER_FILE}"):
            with contextlib.suppress(OSError):
                owner = ProcessIdentity.parse(mark.read_text(encoding="utf-8", errors="replace"))
                if owner is None or owner.is_gone() or self._untouched(mark.parent, known):
                    left.append((mark.parent, owner))
        return left

    def _untouched(self, folder: Path, known: Mapping[Path, tuple[Sequence[int], float]]) -> bool:
        """Return whether nothing in a worker's folder, or in those of its attempts, has been touched for long.

        The time is this process's monotonic time, so that setting a clock has no effect.
        """
        now = time.monotonic()
        touched = sorted(path.stat().st_mtime_ns for path in (*folder.glob("*"), *folder.glob("*/*")))
        before, since = known.get(folder, (None, now))
        same = touched == before
        self._touched[folder] = touched, since if same else now
        return same and now - since >= self._untouched_s
