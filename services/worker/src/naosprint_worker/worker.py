"""A worker: its place in the registry, its runs, its sweeps, its end."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

from naojobs import lifecycle, records, registry, retention
from naojobs.database import make_sessions
from naojobs.doorbell import Doorbell
from naojobs.store import ArtifactStore, StoreError
from sqlalchemy import Engine

from naosprint_worker import __version__
from naosprint_worker.context import Context
from naosprint_worker.database import DATABASE_TROUBLE, open_engine
from naosprint_worker.orphans import Owner
from naosprint_worker.reaper import Reaper
from naosprint_worker.retry import describe
from naosprint_worker.runs import EvaluationRun, JobRun
from naosprint_worker.settings import WorkerSettings
from naosprint_worker.supervisor import MIB

logger = logging.getLogger(__name__)

OWNER_FILE = "owner"


class Run(Protocol):
    """Something that keeps a slot of the worker busy."""

    def run(self) -> None:
        """Do it, to the end."""

    def shut_down(self) -> None:
        """Bring the end about soon; callable from a signal handler."""


class Worker:
    """Everything of a worker that is not the broker's business."""

    def __init__(self, settings: WorkerSettings, doorbell: Doorbell) -> None:
        """Prepare; nothing is started or written yet."""
        self._settings = settings
        owner = Owner.current()
        self._host = socket.gethostname()
        self.id = f"{self._host}:{owner.pid}:{int(owner.started * 1000):x}"
        self._engine: Engine = open_engine(
            settings, pool_size=settings.worker_concurrency + 3, application_name="naosprint-worker"
        )
        self._context = Context(
            settings=settings,
            sessions=make_sessions(self._engine),
            doorbell=doorbell,
            worker_id=self.id,
            folder=settings.worker_dir / self.id.replace(":", "-"),
        )
        self._store = ArtifactStore.from_settings(settings)
        self._reaper = Reaper(self._context, free_slots=self._free_slots)
        self._stopping = threading.Event()
        self._short_of_space = False
        self._runs: set[Run] = set()
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Enter the registry and begin to beat and to sweep."""
        settings = self._settings
        _remove_left_folders(settings.worker_dir)
        self._context.folder.mkdir(parents=True, exist_ok=True)
        (self._context.folder / OWNER_FILE).write_text(str(Owner.current()), encoding="utf-8")
        for name, period_s, duty in (
            ("beat", settings.heartbeat_s, self._beat),
            ("reap", settings.worker_reap_s, self._reaper.sweep),
            ("sweep", settings.worker_sweep_s, self._sweep_store),
            ("evaluate", settings.worker_poll_s, self._evaluate_beside),
        ):
            thread = threading.Thread(target=self._repeat, args=(name, period_s, duty), name=name, daemon=True)
            thread.start()
            self._threads.append(thread)

    def shut_down(self) -> None:
        """Take nothing new and end what runs, each with a checkpoint; callable from a signal handler."""
        self._stopping.set()
        for run in tuple(self._runs):
            run.shut_down()

    def close(self) -> None:
        """Leave the registry; call it when nothing runs any more."""
        self._stopping.set()
        for thread in self._threads:
            thread.join(timeout=10)
        with contextlib.suppress(*DATABASE_TROUBLE):
            registry.leave(self._context.sessions, self.id)
        shutil.rmtree(self._context.folder, ignore_errors=True)
        self._engine.dispose()

    def run_job(self, job_id: str) -> bool:
        """See a job through if it waits; return False where somebody else has it or it needs no work."""
        if self._stopping.is_set() or not self._has_space():
            return False
        claim = lifecycle.claim(self._context.sessions, job_id, self.id, lease_s=self._settings.lease_s)
        if claim is None:
            return False
        logger.info("job %s: attempt %d begins", job_id, claim.lease.attempt)
        self._see_through(JobRun(self._context, claim))
        return True

    def run_evaluation(self, evaluation_id: str) -> bool:
        """See an evaluation through if it waits; return False where somebody else has it."""
        if self._stopping.is_set() or not self._has_space():
            return False
        claim = records.claim_evaluation(self._context.sessions, evaluation_id, self.id, lease_s=self._settings.lease_s)
        if claim is None:
            return False
        logger.info("evaluation %s: attempt %d begins", evaluation_id, claim.attempt)
        self._see_through(EvaluationRun(self._context, claim))
        return True

    def _evaluate_beside(self) -> None:
        """Run the evaluation that waits longest, while jobs keep every slot busy.

        Who asks how the newest checkpoint of a running job runs wants to see it now, not when the training has ended.
        """
        if self._stopping.is_set() or self._free_slots() > 0:
            return
        waiting = records.waiting_evaluation(self._context.sessions, self._settings.worker_queues)
        if waiting is not None:
            self.run_evaluation(waiting)

    def _see_through(self, run: Run) -> None:
        with self._occupied(run):
            run.run()

    @contextlib.contextmanager
    def _occupied(self, run: Run) -> Iterator[None]:
        with self._lock:
            self._runs.add(run)
        try:
            if self._stopping.is_set():  # it was set between the first look and here
                run.shut_down()
            yield
        finally:
            with self._lock:
                self._runs.discard(run)

    def _free_slots(self) -> int:
        if self._stopping.is_set() or not self._has_space():
            return 0
        return self._settings.worker_concurrency - len(self._runs)

    def _has_space(self) -> bool:
        """Say whether the disk has room for an attempt; what waits is announced again once it has."""
        try:
            free_mb = shutil.disk_usage(self._settings.worker_dir).free // MIB
        except OSError:
            return True  # the attempt will tell what is wrong with the folder
        enough = free_mb >= self._settings.worker_min_free_mb
        if enough is self._short_of_space:  # it has changed
            self._short_of_space = not enough
            log = logger.info if enough else logger.warning
            log(
                "%s has %d MiB free, NAOSPRINT_WORKER_MIN_FREE_MB is %d: jobs are %s",
                self._settings.worker_dir,
                free_mb,
                self._settings.worker_min_free_mb,
                "taken again" if enough else "left to others until there is more",
            )
        return enough

    def _beat(self) -> None:
        registry.beat(
            self._context.sessions,
            self.id,
            host=self._host,
            pid=os.getpid(),
            queues=self._settings.worker_queues,
            version=__version__,
        )

    def _sweep_store(self) -> None:
        """Delete files that no row refers to: of jobs that were deleted while the store was away, of cut uploads."""
        try:
            retention.sweep(self._context.sessions, self._store)
        except StoreError as error:
            logger.warning("sweep: the store did not answer: %s", describe(error, 200))

    def _repeat(self, name: str, period_s: float, duty: Callable[[], None]) -> None:
        """Do a duty at once and then every ``period_s`` seconds, whatever goes wrong meanwhile."""
        while True:
            try:
                duty()
            except DATABASE_TROUBLE as error:
                self._reaper.database_failed()
                logger.warning("%s: the database did not answer: %s", name, describe(error, 200))
            except Exception:
                logger.exception("%s failed", name)
            if self._stopping.wait(period_s):
                return


def _remove_left_folders(parent: Path) -> None:
    """Remove the working folders of workers that no longer exist on this machine."""
    here = Owner.current().namespace
    for mark in parent.glob(f"*/{OWNER_FILE}"):
        with contextlib.suppress(OSError):
            owner = Owner.parse(mark.read_text(encoding="utf-8"))
            if owner is not None and owner.namespace == here and not owner.alive():
                shutil.rmtree(mark.parent, ignore_errors=True)
