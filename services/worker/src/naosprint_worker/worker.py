"""Worker: registration, runs, periodic duties, shutdown."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable, Sequence

from naojobs import leases, registry, retention
from naojobs.database import make_sessions
from naojobs.errors import OtherSchemaError
from naojobs.models import AnyWork, Evaluation, Job, Match, WorkKind
from naojobs.notifications import Notifier, make_celery
from naojobs.preemption import make_room
from naojobs.store import ArtifactStore, StoreError
from naospec.files import private_folder
from naospec.processes import ProcessIdentity
from sqlalchemy import Engine

from naosprint_worker import __version__, spool
from naosprint_worker.capabilities import installed_capabilities
from naosprint_worker.context import WorkerContext
from naosprint_worker.database import DATABASE_ERRORS, open_engine
from naosprint_worker.memory import MIB, MemoryBudget
from naosprint_worker.orphans import touch_owner
from naosprint_worker.reaper import Reaper
from naosprint_worker.retry import describe
from naosprint_worker.runs import Run
from naosprint_worker.settings import WorkerSettings
from naosprint_worker.studies import Conductor

logger = logging.getLogger(__name__)


class WorkLoop:
    """Worker process without its connection to the broker.

    Its slots are filled by one thread, which looks for waiting work whenever a wake-up message arrives or a run ends,
    and every ``worker_claim_s`` seconds in any case.
    """

    def __init__(self, settings: WorkerSettings) -> None:
        """Prepare; nothing is started or written yet."""
        self._settings = settings
        identity = ProcessIdentity.current()
        self._host = socket.gethostname()
        self.id = f"{self._host}:{identity.pid}:{identity.boot[:8]}{identity.ticks:x}"
        self._engine: Engine = open_engine(
            settings, pool_size=settings.worker_concurrency + 4, application_name="naosprint-worker"
        )
        self._context = WorkerContext(
            settings=settings,
            sessions=make_sessions(self._engine),
            worker_id=self.id,
            capabilities=installed_capabilities(settings),
            folder=settings.worker_dir / self.id.replace(":", "-"),
            memory=MemoryBudget.of_worker(settings),
        )
        self._store = ArtifactStore.from_settings(settings)
        self._notifier = Notifier(make_celery(settings.broker_url.get_secret_value(), name="naosprint_worker"))
        self._reaper = Reaper(self._context, self._wake_others)
        self._stopping = threading.Event()
        self._short_of_space = False
        self._runs: dict[Run, threading.Thread] = {}
        self._changed = threading.Condition()
        self._woken = threading.Event()
        self._study_woken = threading.Event()
        self._conductor = Conductor(self._context.sessions, settings.sqlalchemy_url)
        self._threads: list[threading.Thread] = []
        self._worked_at = time.monotonic()

    @property
    def queues(self) -> Sequence[str]:
        """Queues whose work it claims."""
        return self._context.capabilities.simulators

    def start(self) -> None:
        """Register and start to claim work, without waiting for the broker."""
        settings = self._settings
        private_folder(settings.worker_dir)
        touch_owner(self._context.folder)
        for name, period_s, duty, wake in (
            ("beat", settings.heartbeat_s, self._beat, self._stopping),
            ("reap", settings.worker_reap_s, self._reaper.sweep, self._stopping),
            ("sweep", settings.worker_sweep_s, self._sweep, self._stopping),
            ("claim", settings.worker_claim_s, self._look_for_work, self._woken),
            ("studies", settings.worker_claim_s, self._conduct, self._study_woken),
        ):
            thread = threading.Thread(target=self._repeat, args=(name, period_s, duty, wake), name=name, daemon=True)
            thread.start()
            self._threads.append(thread)
        logger.info("worker %s is ready for %s", self.id, ", ".join(self.queues))

    def wake_up(self, work_id: str) -> None:
        """Look for work at once; return only when a slot is free, so that a busy worker holds back further messages."""
        logger.debug("woken up for %s", work_id)
        with self._changed:
            self._changed.wait_for(lambda: self._stopping.is_set() or Job in self._claimable())
        self._wake()

    def shut_down(self) -> None:
        """Stop claiming and end all runs, trainings with a checkpoint; callable from a signal handler."""
        self._stopping.set()
        self._wake()
        with self._changed:
            self._changed.notify_all()
        for run in tuple(self._runs):
            run.shut_down()

    def close(self) -> None:
        """End all runs and unregister."""
        self.shut_down()
        for thread in self._threads:
            thread.join(timeout=10)
        for thread in tuple(self._runs.values()):
            thread.join()
        with contextlib.suppress(*DATABASE_ERRORS):
            registry.leave(self._context.sessions, self.id)
        shutil.rmtree(self._context.folder, ignore_errors=True)
        self._notifier.close()
        self._engine.dispose()

    def _look_for_work(self) -> None:
        """Fill the free slots; if there are none, make room for urgent work."""
        self._claim_work()
        settings, full = self._settings, len(self._runs) >= self._settings.worker_concurrency
        if settings.worker_preempt_by == 0 or not full or self._stopping.is_set() or not self._has_space():
            return
        made = make_room(
            self._context.sessions,
            self.id,
            self._context.capabilities,
            by=settings.worker_preempt_by,
            after_s=2 * settings.worker_claim_s,
        )
        if made is not None:
            logger.info("job %s makes room for %s", *made)

    def _claim_work(self) -> None:
        """Fill the free slots with waiting work."""
        while models := self._claimable():
            claim = leases.claim_next(
                self._context.sessions,
                self.id,
                models=models,
                capabilities=self._context.capabilities,
                lease_s=self._settings.lease_s,
            )
            if claim is None:
                self._end_if_idle()
                return
            run = Run(self._context, claim)
            thread = threading.Thread(target=self._run, args=(run,), name=claim.lease.id)
            with self._changed:
                thread.start()  # first: a run without a thread would keep its slot
                self._runs[run] = thread
            if self._stopping.is_set():  # it was set while the work was claimed
                run.shut_down()

    def _end_if_idle(self) -> None:
        """End the process as SIGTERM does if it has had no work for ``worker_idle_exit_s``."""
        limit_s, now = self._settings.worker_idle_exit_s, time.monotonic()
        if self._runs:
            self._worked_at = now
        elif limit_s is not None and now - self._worked_at > limit_s and not self._stopping.is_set():
            logger.info("worker %s ends: it had no work for %g s", self.id, limit_s)
            self._stopping.set()
            os.kill(os.getpid(), signal.SIGTERM)

    def _claimable(self) -> tuple[type[AnyWork], ...]:
        """Return what this worker can take now: beside its slots, one evaluation may run.

        A user who evaluates the newest checkpoint of a running job wants the result now, not when the training has
        ended.
        """
        runs, slots = tuple(self._runs), self._settings.worker_concurrency
        if self._stopping.is_set() or len(runs) > slots or not self._has_space():
            return ()
        if len(runs) < slots:
            return (Job, Match, Evaluation)
        if any(run.kind is WorkKind.EVALUATION for run in runs):
            return (Job, Match)
        return (Evaluation,) if self._context.memory.has_room() else ()

    def _run(self, run: Run) -> None:
        try:
            run.run()
        except Exception:
            logger.exception("a run failed")
        finally:
            if self._stopping.is_set():  # this worker takes it no more
                self._wake_others((run.id, queue) for queue in self.queues)
            with self._changed:
                del self._runs[run]
                self._changed.notify_all()
            self._wake()

    def _wake(self) -> None:
        self._woken.set()
        self._study_woken.set()

    def _wake_others(self, work: Iterable[tuple[str, str]]) -> None:
        """Send wake-up messages for pairs of requeued work and queue, unless the broker is down."""
        for work_id, queue in work:
            if self._notifier.wake_up(work_id, queue) is not None:
                return  # free workers poll

    def _conduct(self) -> None:
        """Advance all studies."""
        if self._conductor.advance_all():
            self._woken.set()

    def _free_bytes(self) -> int | None:
        with contextlib.suppress(OSError):
            return shutil.disk_usage(self._settings.worker_dir).free
        return None

    def _has_space(self) -> bool:
        """Return whether the disk has room for an attempt; work waits until it has."""
        free_bytes = self._free_bytes()
        if free_bytes is None:
            return True  # the attempt will fail with the reason
        free_mb = free_bytes // MIB
        enough = free_mb >= self._settings.worker_min_free_mb
        if enough is self._short_of_space:  # it has changed
            self._short_of_space = not enough
            log = logger.info if enough else logger.warning
            log(
                "%s has %d MiB free, NAOSPRINT_WORKER_MIN_FREE_MB is %d: this worker %s",
                self._settings.worker_dir,
                free_mb,
                self._settings.worker_min_free_mb,
                "claims work again" if enough else "claims no work until there is more",
            )
        return enough

    def _beat(self) -> None:
        self._reaper.lost.workers = registry.beat(
            self._context.sessions,
            self.id,
            host=self._host,
            pid=os.getpid(),
            capabilities=self._context.capabilities,
            version=__version__,
            disk_free_bytes=self._free_bytes(),
            stale_s=self._settings.lease_s,
        )

    def _sweep(self) -> None:
        """Delete files that no row refers to, for example after an outage of the store, and old spools."""
        for folder in spool.sweep(self._settings.worker_dir, self._context.sessions):
            logger.info("deleted %s: its job no longer needs it", folder)
        try:
            retention.sweep(self._context.sessions, self._store)
        except StoreError as error:
            logger.warning("sweep: %s", describe(error, 200))
        except retention.ForeignStoreError as error:
            logger.error("sweep: %s", error)
        self._conductor.forget_deleted()

    def _repeat(self, name: str, period_s: float, duty: Callable[[], None], wake: threading.Event) -> None:
        """Do a duty at once, every ``period_s`` seconds and when ``wake`` is set, also after errors."""
        while True:
            if wake is not self._stopping:
                wake.clear()
            try:
                duty()
            except DATABASE_ERRORS as error:
                logger.warning("%s: the database did not answer: %s", name, describe(error, 200))
            except OtherSchemaError as error:
                logger.error("%s: %s", name, error)
            except Exception:
                logger.exception("%s failed", name)
            wake.wait(period_s)
            if self._stopping.is_set():
                return
