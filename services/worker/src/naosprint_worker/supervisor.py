"""Supervision of one child process: heartbeat, users' requests, grace periods, time limit, memory."""

from __future__ import annotations

import contextlib
import enum
import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from naojobs.errors import LeaseLostError
from naojobs.leases import Requests
from naojobs.states import WorkState

from naosprint_worker.child import TrainingProcess
from naosprint_worker.database import DATABASE_ERRORS
from naosprint_worker.memory import MIB
from naosprint_worker.outcome import Outcome, TrainerExitCode, last_lines
from naosprint_worker.progress import ProgressWatch
from naosprint_worker.retry import describe
from naosprint_worker.settings import WorkerSettings

logger = logging.getLogger(__name__)

MEMORY_PERIOD_S = 1.0
"""Seconds between two checks of a child's memory: finding all of its processes takes time."""
USAGE_PERIOD_S = 60.0
"""Seconds between two reports of what a child has used."""

_TRACEBACK_S, _TRACEBACK_LINES = 0.5, 60
"""Seconds that a stalled child has to print where it is, and the lines of that which are kept."""


class Intent(enum.IntEnum):
    """Reason to stop a child; a higher one overrides a lower one."""

    NONE = 0
    """It was not asked to stop."""
    SHUTDOWN = 1
    """The worker shuts down; the work resumes on another one."""
    REQUEUE = 2
    """It makes room for urgent work, or its worker is drained."""
    PAUSE = 3
    """A user requested a pause."""
    CUT_OFF = 4
    """The database has been unreachable for too long."""
    TIME_LIMIT = 5
    """It has run longer than it may."""
    CANCEL = 6
    """A user requested its end."""
    STALLED = 7
    """It has made no step for too long."""
    CROWDED = 8
    """All children of the worker together hold more memory than they may."""
    MEMORY = 9
    """It holds more memory than it may."""
    LEASE_LOST = 10
    """The lease is lost."""


@dataclass(frozen=True)
class Ending:
    """End of a child."""

    intent: Intent
    returncode: int
    outcome: Outcome | None
    overstayed: bool
    """Whether it had to be killed because it did not stop within the grace period."""
    peak_bytes: int
    oom: bool
    """Whether the kernel ended some process for lack of memory meanwhile."""
    last_output: str

    @property
    def reported(self) -> TrainerExitCode | None:
        """How our own code ended it; None if something else ended the process."""
        return self.outcome.code if self.outcome is not None else None


class TrainingSupervisor:
    """Supervisor of a child that works under a lease.

    ``beat`` renews the lease and returns the users' requests; ``look`` only reads them; ``report_stall`` records the
    seconds without a step once they exceed ``worker_stall_warn_s``, and None when there is a step again;
    ``report_usage`` adds seconds of processors and of running, every minute. They may raise `LeaseLostError` and
    database errors. ``must_end`` takes the child's bytes of memory and returns whether it has to
    end because all children of the worker hold too much. A lost lease, too much memory, or ``worker_stall_s`` seconds
    without a step kill the child at once; for every other reason, ``time_limit_s`` among them, it is asked to stop and
    has ``grace_s`` seconds (``worker_stop_grace_s`` by default) before it is killed.
    """

    def __init__(
        self,
        settings: WorkerSettings,
        *,
        start: Callable[[Callable[[], None]], TrainingProcess],
        beat: Callable[[], Requests],
        look: Callable[[], Requests],
        report_stall: Callable[[float | None], None],
        report_usage: Callable[[float, float], None] = lambda _cpu_s, _run_s: None,
        workdir: Path,
        log_path: Path,
        must_end: Callable[[int], bool] = lambda _held_bytes: False,
        time_limit_s: float = math.inf,
        grace_s: float | None = None,
    ) -> None:
        """Prepare; ``start`` takes a function to call when the child is gone and returns the running child."""
        self._settings = settings
        self._start = start
        self._beat = beat
        self._look = look
        self._report_stall = report_stall
        self._report_usage = report_usage
        self._used_s = self._reported_s = (0.0, 0.0)
        self._must_end = must_end
        self._stalled = False
        self._workdir = workdir
        self._log_path = log_path
        self._time_limit_s = time_limit_s
        self._grace_s = settings.worker_stop_grace_s if grace_s is None else grace_s
        self._wake = threading.Event()
        self._shutdown = False
        self._intent = Intent.NONE
        self._kill_at: float | None = None
        self._overstayed = False
        self._peak_bytes = 0
        self._weighed_at = -math.inf

    def shut_down(self) -> None:
        """Request an end because the worker shuts down; safe to call from any thread and from a signal handler."""
        self._shutdown = True
        self._wake.set()

    def run(self) -> Ending:
        """Start the child, watch it, return how it ended."""
        oom_before = _oom_kills()
        child = self._start(self._wake.set)
        try:
            self._watch(child)
        except BaseException:
            child.kill()
            raise
        returncode = child.wait()
        self._weigh(child)  # once more, since the last look may be long ago for a short run
        assert returncode is not None
        outcome = Outcome.read(self._workdir)
        stopped = outcome is not None and outcome.code is TrainerExitCode.STOPPED
        if self._intent is Intent.NONE and self._shutdown and stopped:
            self._intent = Intent.SHUTDOWN  # the signal that ended the worker has reached the child, too
        return Ending(
            intent=self._intent,
            returncode=returncode,
            outcome=outcome,
            overstayed=self._overstayed,
            peak_bytes=self._peak_bytes,
            oom=_oom_kills() > oom_before,
            last_output=last_lines(
                self._log_path, **{"lines": _TRACEBACK_LINES} if self._intent is Intent.STALLED else {}
            ),
        )

    def _watch(self, child: TrainingProcess) -> None:
        settings = self._settings
        started = contact = beaten = time.monotonic()
        progress = ProgressWatch(self._workdir)
        while child.runs():
            self._used_s = (self._used_s[0], time.monotonic() - started)
            self._wake.wait(settings.worker_poll_s)
            self._wake.clear()
            if not child.runs():
                return
            now = time.monotonic()
            try:
                if now - beaten >= settings.heartbeat_s:
                    requests = self._beat()
                    beaten = now
                else:
                    requests = self._look()
                contact = time.monotonic()
                self._obey(child, requests)
                self._note_stall(progress.idle_s)
                if self._used_s[1] - self._reported_s[1] >= USAGE_PERIOD_S:
                    self.account()
            except LeaseLostError as error:
                logger.warning("%s; ending its child", error)
                self._intent = Intent.LEASE_LOST
                child.kill()
                child.wait()
                return
            except DATABASE_ERRORS as error:
                away_s = time.monotonic() - contact
                logger.warning("the database has not answered for %.0f s: %s", away_s, describe(error, 200))
                if away_s > settings.worker_patience_s:
                    self._stop(child, Intent.CUT_OFF)
            if time.monotonic() - started > self._time_limit_s:
                self._stop(child, Intent.TIME_LIMIT)
            if self._shutdown:
                self._stop(child, Intent.SHUTDOWN)
            self._check_memory(child)
            if progress.look() > settings.worker_stall_s and self._kill_at is None and self._intent < Intent.STALLED:
                self._intent = Intent.STALLED
                child.print_traceback()
                child.wait(_TRACEBACK_S)
                child.kill()
            if self._kill_at is not None and time.monotonic() >= self._kill_at and child.runs():
                self._overstayed = True
                child.kill()

    def account(self) -> None:
        """Report what the child has used since the last report."""
        used, before = self._used_s, self._reported_s
        if used != before:
            self._report_usage(used[0] - before[0], used[1] - before[1])
            self._reported_s = used

    def _note_stall(self, idle_s: float) -> None:
        stalled = idle_s > self._settings.worker_stall_warn_s
        if stalled is not self._stalled:
            self._report_stall(idle_s if stalled else None)
            self._stalled = stalled

    def _obey(self, child: TrainingProcess, requests: Requests) -> None:
        if requests.cancel:
            self._stop(child, Intent.CANCEL)
        elif requests.state is WorkState.PAUSING:
            self._stop(child, Intent.PAUSE)
        elif requests.requeue and requests.state in (WorkState.STARTING, WorkState.RUNNING):
            self._stop(child, Intent.REQUEUE)

    def _stop(self, child: TrainingProcess, intent: Intent) -> None:
        self._intent = max(self._intent, intent)
        if self._kill_at is None:
            logger.info("stopping child %d: %s", child.pid, intent.name.lower())
            self._kill_at = time.monotonic() + self._grace_s
            child.terminate()

    def _weigh(self, child: TrainingProcess) -> int:
        """Note what the child has used so far, and return the bytes that it holds."""
        held, cpu_s = child.usage()
        self._used_s = (max(cpu_s, self._used_s[0]), self._used_s[1])  # a server that has ended counts no more
        return held

    def _check_memory(self, child: TrainingProcess) -> None:
        now = time.monotonic()
        if now - self._weighed_at < MEMORY_PERIOD_S:
            return
        self._weighed_at = now
        held = self._weigh(child)
        self._peak_bytes = max(self._peak_bytes, held)
        limit = self._settings.worker_memory_mb
        if limit is not None and held > limit * MIB and self._intent < Intent.MEMORY:
            self._intent = Intent.MEMORY
            child.kill()
        elif self._must_end(held) and self._intent < Intent.CROWDED:
            self._intent = Intent.CROWDED
            child.kill()


def _oom_kills() -> int:
    """Return how many processes the kernel has ended for lack of memory since it started; 0 where that is unknown."""
    with contextlib.suppress(OSError, ValueError):
        for line in Path("/proc/vmstat").read_text(encoding="ascii").splitlines():
            if line.startswith("oom_kill "):
                return int(line.split()[1])
    return 0
