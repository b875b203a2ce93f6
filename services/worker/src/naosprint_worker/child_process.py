"""Environment of a worker's child processes: protection, signals, services, orderly exit."""

from __future__ import annotations

import argparse
import contextlib
import errno
import faulthandler
import logging
import os
import shutil
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TypeVar

from naojobs.database import Sessions, make_sessions
from naojobs.errors import LeaseLostError
from naojobs.store import ArtifactStore, CorruptArtifactError, MissingArtifactError, StoreError, StoreManifest
from naosim.launchers import LauncherUnavailableError
from naosim.simulator import ServerLostError, ServersUnavailableError

from naosprint_worker.child import TRACEBACK_SIGNAL
from naosprint_worker.database import DATABASE_ERRORS, open_engine
from naosprint_worker.guard import prefer_as_oom_victim, watch_parent
from naosprint_worker.orphans import settle_orphan
from naosprint_worker.outcome import SERVICE_UNAVAILABLE, Outcome, TrainerExitCode
from naosprint_worker.progress import Progress
from naosprint_worker.retry import PatienceExhaustedError, describe, retry
from naosprint_worker.settings import WorkerSettings

logger = logging.getLogger(__name__)

T = TypeVar("T")

TRAINER_OOM_SCORE, EVALUATOR_OOM_SCORE = 200, 1000
"""What the kernel adds to a process's thousandths of memory: it ends evaluations before trainings before the worker."""

_SMALLEST_BLOCK = 4096
"""Bytes below which a disk has no room for any file."""


class StopRequestedError(Exception):
    """Request to stop, raised where the child can stop at once."""


class CheckpointsUnusableError(Exception):
    """Failure of a job whose checkpoints are all unusable."""


class StopRequest:
    """Whether this process was asked to stop (SIGTERM, or the worker's death)."""

    def __init__(self) -> None:
        """No request yet."""
        self._event = threading.Event()
        self._interruptible = False
        self.orphaned = False
        """Whether the reason was the worker's death."""

    def install(self) -> None:
        """Listen to SIGTERM; SIGINT is ignored, since the worker handles a terminal's Ctrl-C."""
        signal.signal(signal.SIGTERM, self._on_signal)
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    def worker_died(self) -> None:
        """Request a stop because the worker is gone; thread-safe."""
        self.orphaned = True
        os.kill(os.getpid(), signal.SIGTERM)

    def requested(self) -> bool:
        """Return whether to stop."""
        return self._event.is_set()

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[None]:
        """Raise `StopRequestedError` in the block once a stop is requested, at once if it is already."""
        self._interruptible = True
        try:
            if self.requested():
                raise StopRequestedError
            yield
        finally:
            self._interruptible = False

    def _on_signal(self, _signal: int, _frame: FrameType | None) -> None:
        self._event.set()
        if self._interruptible:
            self._interruptible = False
            raise StopRequestedError


@dataclass(frozen=True)
class Services:
    """Services that a child uses."""

    settings: WorkerSettings
    sessions: Sessions
    store: ArtifactStore
    workdir: Path
    stop: StopRequest
    progress: Progress

    def step(self) -> bool:
        """Mark progress, or a reason to wait; return whether this process was asked to stop."""
        self.progress.mark()
        return self.stop.requested()

    def fetch(
        self,
        key: str,
        folder: Path,
        manifest: StoreManifest,
        *,
        patience_s: float | None = None,
        on_retry: Callable[[Exception, float], None] | None = None,
    ) -> None:
        """Download an artifact into ``folder`` and verify it, waiting for a store that fails.

        A file that is missing or other than its manifest says is a failure like any other: a proxy's page of errors, a
        body that is cut or a 404 may be the store's trouble of a moment.

        Args:
            key: of the artifact.
            folder: where to put it.
            manifest: of the artifact.
            patience_s: seconds to wait; None: the worker's patience.
            on_retry: called with each error and the seconds until the next try.

        Raises:
            MissingArtifactError: a file was still gone at the end, from a store that returns a new one.
            CorruptArtifactError: a file did still not match the manifest, likewise.
            PatienceExhaustedError: the store failed for too long.
            StoreError: the store does not return a new file.
        """
        with self.progress.waiting():
            try:
                retry(
                    lambda: self.store.get_directory(key, folder, manifest),
                    what=f"fetching {key}",
                    transient=(StoreError,),
                    patience_s=self.settings.worker_patience_s if patience_s is None else patience_s,
                    on_retry=on_retry,
                )
            except PatienceExhaustedError as error:
                if not isinstance(error.__cause__, CorruptArtifactError | MissingArtifactError):
                    raise
            else:
                return
            # A store that does not return a new file either says nothing of this one.
            self.store.check()
            self.store.get_directory(key, folder, manifest)

    def put(
        self, key: str, folder: Path, *, what: str, on_retry: Callable[[Exception, float], None] | None = None
    ) -> StoreManifest:
        """Upload the files of ``folder`` as an artifact and return its manifest, waiting for a store that fails.

        Args:
            key: of the artifact.
            folder: its files.
            what: what is stored, for people.
            on_retry: called with each error and the seconds until the next try.

        Raises:
            PatienceExhaustedError: the store failed for too long.
        """
        with self.progress.waiting():
            return retry(
                lambda: self.store.put_directory(key, folder),
                what=f"storing {what}",
                transient=(StoreError,),
                patience_s=self.settings.worker_patience_s,
                on_retry=on_retry,
            )

    def database(self, call: Callable[[], T], what: str) -> T:
        """Return ``call()``, waiting for a database that fails.

        Raises:
            PatienceExhaustedError: the database failed for too long; ``what`` names what was tried.
        """
        with self.progress.waiting():
            return retry(call, what=what, transient=DATABASE_ERRORS, patience_s=self.settings.worker_patience_s)


def run_child(work: Callable[[Services], Outcome], *, oom_score: int = TRAINER_OOM_SCORE) -> int:
    """Do ``work`` protected and connected; return the exit status and leave an `Outcome` in the working folder.

    When memory runs out, the kernel ends processes of the highest ``oom_score`` first, then the largest.
    """
    parser = argparse.ArgumentParser(description="Child process of a naosprint worker; started by the worker only.")
    parser.add_argument("--workdir", type=Path, required=True, help="folder with assignment.json")
    workdir: Path = parser.parse_args().workdir
    settings = WorkerSettings()  # type: ignore[call-arg]  # the environment fills it
    faulthandler.register(TRACEBACK_SIGNAL)
    stop = StopRequest()
    stop.install()
    prefer_as_oom_victim(oom_score)
    with contextlib.suppress(OSError):
        os.nice(settings.worker_nice)
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    engine = open_engine(settings, pool_size=2, application_name="naosprint-child")
    sessions = make_sessions(engine)
    grace_s = settings.worker_orphan_grace_s
    watch_parent(stop.worker_died, lambda: settle_orphan(sessions, workdir), grace_s=grace_s)
    try:
        store = ArtifactStore.from_settings(settings)
        outcome = work(Services(settings, sessions, store, workdir, stop, Progress(workdir)))
    except StopRequestedError:
        outcome = Outcome(TrainerExitCode.STOPPED, "stopped", "stopped on request")
    except BaseException as error:
        outcome = classify(error, workdir)
        logger.error("%s: %s", outcome.kind, outcome.message, exc_info=error)
    if stop.orphaned:
        settle_orphan(sessions, workdir, outcome)
    engine.dispose()
    outcome.leave(workdir)
    return int(outcome.code)


def classify(error: BaseException, workdir: Path) -> Outcome:
    """Return the outcome of an error that ended the work in ``workdir``."""
    from naosprint import CheckpointError, TrainingDivergedError  # loads PyTorch, which is loaded by now anyway

    text = "".join(traceback.format_exception(error))
    if not isinstance(error, Exception):
        message = f"a task, learner or library ended the process: {describe(error)}"
        return Outcome(TrainerExitCode.PERMANENT, "exit", message, text)
    if isinstance(error, LeaseLostError):
        return Outcome(TrainerExitCode.FENCED, "lease_lost", describe(error))
    if _tells_of_full_disk(error, workdir):
        message = f"no space left on the disk of the worker's folder {workdir.parent}: {describe(error)}"
        return Outcome(TrainerExitCode.DISK_FULL, "disk_full", message, text)
    if isinstance(error, TrainingDivergedError):
        return Outcome(TrainerExitCode.PERMANENT, "diverged", describe(error), text)
    if isinstance(error, CheckpointError | CheckpointsUnusableError | CorruptArtifactError | MissingArtifactError):
        return Outcome(TrainerExitCode.PERMANENT, "checkpoint", describe(error), text)
    away: tuple[type[Exception], ...] = (
        PatienceExhaustedError,
        StoreError,
        LauncherUnavailableError,
        ServersUnavailableError,
        *DATABASE_ERRORS,
    )
    if isinstance(error, away):
        return Outcome(TrainerExitCode.TRANSIENT, SERVICE_UNAVAILABLE, describe(error), text)
    if isinstance(error, OSError | MemoryError | ServerLostError):
        return Outcome(TrainerExitCode.TRANSIENT, "system", describe(error), text)
    return Outcome(TrainerExitCode.PERMANENT, "error", describe(error), text)


def _tells_of_full_disk(error: BaseException, workdir: Path) -> bool:
    """Return whether an error, or its cause, is a full disk or an exhausted quota.

    Some errors of the system come without their number: those of NumPy's own writes, and those that ``copytree``
    gathers. For these the free space of the disk decides.
    """
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError):
            if cause.errno in (errno.ENOSPC, errno.EDQUOT):
                return True
            if cause.errno is None:
                with contextlib.suppress(OSError):
                    return shutil.disk_usage(workdir).free < _SMALLEST_BLOCK
        cause = cause.__cause__ or cause.__context__
    return False
