"""Checkpoints on the worker's disk that the database does not have yet."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from naojobs.database import Sessions
from naojobs.leases import Lease
from naojobs.models import Checkpoint, Job, ServiceKey, generation
from naojobs.records import MetricsRow
from naojobs.states import WorkState
from naospec.files import sync, write_whole
from sqlalchemy import func, select

SPOOL = "spool"
"""Folder below the workers' folder: spools persist beyond attempts and workers."""

_FILES, _METRICS = "checkpoint", "metrics.json"


@dataclass(frozen=True)
class Entry:
    """Checkpoint in a spool, with the metrics before it that were not recorded either."""

    step: int
    attempt: int
    """The attempt that saved it."""
    folder: Path

    @property
    def checkpoint(self) -> Path:
        """Folder of the checkpoint's files."""
        return self.folder / _FILES

    def metrics(self) -> list[MetricsRow]:
        """Read the metrics. Raises ValueError if the file is damaged, OSError if it is gone."""
        rows = json.loads((self.folder / _METRICS).read_text(encoding="utf-8"))
        try:
            return [MetricsRow(int(row["step"]), row) for row in rows]
        except (KeyError, TypeError) as error:
            raise ValueError(f"not a list of metrics: {error}") from error

    def without_metrics(self) -> Self:
        """Return the entry after its metrics were given up, which cannot be read."""
        write_whole(self.folder / _METRICS, b"[]")
        return self

    def size(self) -> int:
        """Return the size of its files, in bytes."""
        return sum(path.stat().st_size for path in self.folder.rglob("*") if path.is_file())


class Spool:
    """Checkpoints of one attempt that are not recorded yet.

    An entry appears atomically and stays until the database has the checkpoint's row. The next attempt on the same disk
    takes over the entries that remain. Files are hard links to those of the training where the disk supports them.
    """

    def __init__(self, folder: Path, attempt: int = 1) -> None:
        """Use ``folder``, which need not exist."""
        self._folder = folder
        self._attempt = attempt
        self._lock = threading.Lock()
        self._sizes: dict[int, int] = {}

    @classmethod
    def of_attempt(cls, worker_dir: Path, lease: Lease) -> Self:
        """Return the spool of an attempt below the folder of a host's workers."""
        of_job = worker_dir / SPOOL / lease.service / lease.generation / lease.job_id
        return cls(of_job / str(lease.attempt), lease.attempt)

    @property
    def size(self) -> int:
        """Size of all entries, in bytes."""
        with self._lock:
            return sum(self._sizes.values())

    def add(self, checkpoint: Path, step: int, metrics: Sequence[MetricsRow]) -> Entry:
        """Take over a checkpoint directory and the metrics that are not recorded yet."""
        self._folder.mkdir(parents=True, exist_ok=True)
        unfinished = self._folder / f".{step:012d}"
        shutil.rmtree(unfinished, ignore_errors=True)
        shutil.copytree(checkpoint, unfinished / _FILES, copy_function=link_or_copy)
        rows = [{**row.values, "step": row.step} for row in metrics]
        write_whole(unfinished / _METRICS, json.dumps(rows).encode())
        return self._take(unfinished, step)

    def remove(self, step: int) -> None:
        """Delete the entry of a step; its row is in the database."""
        with self._lock:
            known = self._sizes.pop(step, None) is not None
        if known:
            shutil.rmtree(self._folder / f"{step:012d}", ignore_errors=True)

    def left_by_others(self, since_attempt: int) -> list[Entry]:
        """Return the entries of attempts from ``since_attempt`` to the one before this, in order of steps."""
        found: dict[int, Entry] = {}
        for entry in _entries(self._folder.parent):
            if since_attempt <= entry.attempt < self._attempt:
                found[entry.step] = entry
        return [found[step] for step in sorted(found)]

    def adopt(self, entry: Entry) -> Entry:
        """Move an entry of an earlier attempt into this spool.

        Raises:
            OSError: it is gone.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        return self._take(entry.folder, entry.step)

    def discard_others(self) -> None:
        """Delete the entries of earlier attempts that this one has not taken over."""
        for folder in _folders(self._folder.parent):
            if int(folder.name) < self._attempt:
                shutil.rmtree(folder, ignore_errors=True)

    def close(self) -> None:
        """Remove the folders that are empty."""
        for folder in (self._folder, *list(self._folder.parents)[:4]):
            with contextlib.suppress(OSError):
                folder.rmdir()

    def _take(self, folder: Path, step: int) -> Entry:
        entry = Entry(step, self._attempt, self._folder / f"{step:012d}")
        for path in (folder / _FILES, folder):
            sync(path)
        folder.rename(entry.folder)
        sync(self._folder)
        size = entry.size()
        with self._lock:
            self._sizes[step] = size
        return entry


def sweep(worker_dir: Path, sessions: Sessions) -> list[Path]:
    """Delete spools of jobs that are gone, that succeeded, or that resumed elsewhere; return their folders.

    Spools of another generation are of attempts whose records the database may lack. Those of other services, whose
    workers may use the same folder, stay.
    """
    gone = []
    with sessions() as session:
        service, current = session.execute(select(ServiceKey.key, generation())).one()
    of_service = worker_dir / SPOOL / service
    if (before := worker_dir / SPOOL / current).is_dir():  # of a version that did not tell services apart
        with contextlib.suppress(OSError):
            of_service.mkdir(exist_ok=True)
            before.rename(of_service / current)
    for folder in of_service.glob("*"):
        if folder.name != current:
            shutil.rmtree(folder, ignore_errors=True)
            gone.append(folder)
    for job_folder in sorted(path for path in (of_service / current).glob("*") if path.is_dir()):
        with sessions() as session:
            job = session.get(Job, job_folder.name)
            of_job = Checkpoint.job_id == job_folder.name
            newest = session.scalar(select(func.max(Checkpoint.attempt)).where(of_job)) or 0
        over = job is None or job.state is WorkState.SUCCEEDED
        for folder in _folders(job_folder):
            if over or int(folder.name) < newest:
                shutil.rmtree(folder, ignore_errors=True)
                gone.append(folder)
        with contextlib.suppress(OSError):
            job_folder.rmdir()
    return gone


def link_or_copy(source: str, target: str) -> None:
    """Make ``target`` a hard link to ``source``, or a copy on a disk without links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _folders(job_folder: Path) -> list[Path]:
    """Return the folders of a job's attempts, in order."""
    found = [path for path in job_folder.glob("*") if path.name.isdecimal() and path.is_dir()]
    return sorted(found, key=lambda path: int(path.name))


def _entries(job_folder: Path) -> list[Entry]:
    return [
        Entry(int(path.name), int(folder.name), path)
        for folder in _folders(job_folder)
        for path in sorted(folder.glob("*"))
        if path.name.isdecimal()
    ]
