"""Runs of claimed work: run the child process, then settle the state by how it ended."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import shutil
import sys
import threading
from collections.abc import Callable
from functools import partial
from typing import TypeVar

from naojobs import leases, outcomes
from naojobs.errors import ConflictError, LeaseLostError
from naojobs.leases import Claim, EvaluationClaim
from naojobs.models import WorkKind
from naojobs.states import WorkState
from naojobs.usage import add_usage
from naosim.launchers import LABELS_VARIABLE

from naosprint_worker.assignment import write_assignment
from naosprint_worker.child import TrainingProcess
from naosprint_worker.context import WorkerContext
from naosprint_worker.database import DATABASE_ERRORS
from naosprint_worker.memory import MIB, Share
from naosprint_worker.orphans import child_marks
from naosprint_worker.outcome import SERVICE_UNAVAILABLE, TrainerExitCode, describe_exit
from naosprint_worker.retry import PatienceExhaustedError, describe, retry
from naosprint_worker.settings import WorkerSettings
from naosprint_worker.supervisor import Ending, Intent, TrainingSupervisor

logger = logging.getLogger(__name__)

T = TypeVar("T")

EVALUATOR_GRACE_S = 5.0
"""Seconds that evaluations and matches have to stop: they have nothing to save."""

_LAST_PATIENCE_S = 10.0
"""Seconds for which a worker that shuts down waits for the database."""

_BROKER_VARIABLE, _NO_BROKER = "NAOSPRINT_BROKER_URL", "redis://none:none@none.invalid"
"""Children send no messages and receive none; the settings need an address."""

_PROGRAMS = {WorkKind.JOB: "trainer", WorkKind.EVALUATION: "evaluator", WorkKind.MATCH: "match"}
"""Module of the child process by kind of work."""


def child_environment(settings: WorkerSettings) -> dict[str, str]:
    """Return the environment variables of every child process: the worker's own, without the broker's address."""
    return {
        **{name: value for name, value in os.environ.items() if not name.upper().startswith(_BROKER_VARIABLE)},
        _BROKER_VARIABLE: _NO_BROKER,
        "PYTHONFAULTHANDLER": "1",
        "PYTHONUNBUFFERED": "1",
        **child_marks(settings.worker_dir),
        **settings.server_environment,
    }


class Run:
    """One attempt at a piece of work, from the claim to its next state."""

    def __init__(self, context: WorkerContext, claim: Claim) -> None:
        self._context = context
        self._claim = claim
        self._lease = claim.lease
        self._program = _PROGRAMS[claim.lease.kind]
        limit_s = claim.time_limit_s if isinstance(claim, EvaluationClaim) else context.settings.worker_time_limit_s
        self._time_limit_s = math.inf if limit_s is None else limit_s
        self._workdir = context.folder / f"{claim.lease.id}-{claim.lease.attempt}"
        sessions, lease_s = context.sessions, context.settings.lease_s
        self._closing = threading.Event()
        self._share: Share | None = None
        self._supervisor = TrainingSupervisor(
            context.settings,
            start=self._start,
            beat=lambda: leases.heartbeat(sessions, self._lease, lease_s=lease_s),
            look=lambda: leases.read_requests(sessions, self._lease),
            report_stall=lambda idle_s: outcomes.report_stall(sessions, self._lease, idle_s),
            report_usage=lambda cpu_s, run_s: add_usage(sessions, self._lease, cpu_s=cpu_s, run_s=run_s),
            must_end=self._must_end,
            workdir=self._workdir,
            log_path=self._workdir / "output.log",
            time_limit_s=self._time_limit_s,
            grace_s=context.settings.worker_stop_grace_s if self.kind is WorkKind.JOB else EVALUATOR_GRACE_S,
        )

    @property
    def kind(self) -> WorkKind:
        """Kind of the work."""
        return self._lease.kind

    @property
    def id(self) -> str:
        """Id of the work."""
        return self._lease.id

    def shut_down(self) -> None:
        """End the attempt, a training with a checkpoint, and requeue the work; callable from a signal handler."""
        self._closing.set()
        self._supervisor.shut_down()

    def run(self) -> None:
        """Run the attempt to its end and settle the state."""
        logger.info("%s %s attempt %d: begins", self._lease.kind, self._lease.id, self._lease.attempt)
        try:
            try:
                self._workdir.mkdir(parents=True)
                write_assignment(self._claim, self._workdir)
                with self._context.memory.share(self.kind) as self._share:
                    ending = self._supervisor.run()
            except OSError as error:
                reason = f"the {self._program} could not be started: {describe(error)}"
                logger.warning("%s: %s", self._lease, reason)
                self._patiently(lambda: outcomes.postpone(self._context.sessions, self._lease, reason))
                return
            self._patiently(self._supervisor.account)
            self._patiently(lambda: self._settle(ending))
        except LeaseLostError as error:
            logger.warning("%s; leaving it to its new owner", error)
        finally:
            shutil.rmtree(self._workdir, ignore_errors=True)

    def _start(self, on_exit: Callable[[], None]) -> TrainingProcess:
        settings = self._context.settings
        return TrainingProcess(
            [sys.executable, "-P", "-m", f"naosprint_worker.{self._program}", "--workdir", str(self._workdir)],
            env={
                **child_environment(settings),
                LABELS_VARIABLE: f"job={self._lease.id},attempt={self._lease.attempt}",
            },
            cwd=self._workdir,
            log_path=self._workdir / "output.log",
            on_exit=on_exit,
        )

    def _must_end(self, held_bytes: int) -> bool:
        return self._share is not None and self._share.must_end(held_bytes)

    def _settle(self, ending: Ending) -> None:
        """Set the state according to how the child ended."""
        text, output = describe_ending(self._program, ending), last_words(ending)
        whole = f"{text}\n{output}" if output else text  # users get what is public of it
        logger.info("%s %s attempt %d: %s", self._lease.kind, self._lease.id, self._lease.attempt, whole)
        without_checkpoint = self.kind is WorkKind.JOB and ending.reported is not TrainerExitCode.STOPPED
        where = f" without a last checkpoint ({text})" if without_checkpoint else ""
        if ending.intent is Intent.LEASE_LOST or ending.reported is TrainerExitCode.FENCED:
            return
        if ending.reported is TrainerExitCode.FINISHED:
            missing = outcomes.succeed(self._context.sessions, self._lease)
            if missing is None:
                return
            text = f"the {self._program} reported its end, but {missing}"
        if ending.intent is Intent.CANCEL:
            self._transition(WorkState.CANCELLED, f"cancelled as requested{where}")
        elif ending.intent is Intent.CROWDED and self._share is not None and self._share.crowded:
            self._give_way()
        elif ending.intent in (Intent.MEMORY, Intent.CROWDED):
            self._fail(ending, self._memory_message(ending))
        elif ending.intent is Intent.TIME_LIMIT:
            self._fail(ending, f"the {self._program} ran longer than its time limit of {self._time_limit_s:g} s")
        elif ending.intent is Intent.PAUSE:
            self._give_back(WorkState.PAUSED, f"paused as requested{where}")
        elif ending.intent is Intent.REQUEUE:
            self._give_back(WorkState.QUEUED, f"requeued as requested{where}")
        elif ending.intent is Intent.SHUTDOWN:
            self._give_back(WorkState.QUEUED, f"requeued: the worker shuts down{where}")
        elif ending.reported is TrainerExitCode.PERMANENT:
            self._fail(ending, text)
        elif ending.intent is Intent.STALLED:
            reason = f"the {self._program} made no step for {self._context.settings.worker_stall_s:g} s and was killed"
            outcomes.lose(self._context.sessions, self._lease, reason, output=last_words(ending))
        elif ending.intent is Intent.CUT_OFF:
            reason = f"the database did not answer for {self._context.settings.worker_patience_s:g} s"
            outcomes.postpone(self._context.sessions, self._lease, f"{reason}{where}")
        elif ending.outcome is not None and ending.outcome.kind == SERVICE_UNAVAILABLE:
            outcomes.postpone(self._context.sessions, self._lease, text)
        else:
            outcomes.lose(self._context.sessions, self._lease, text, output=last_words(ending))

    def _transition(self, target: WorkState, message: str) -> None:
        outcomes.transition(self._context.sessions, self._lease, target, message=message)

    def _give_back(self, target: WorkState, message: str) -> None:
        """End the attempt in ``target``, or in the state that a user or the training has requested meanwhile."""
        try:
            self._transition(target, message)
        except ConflictError:
            # pausing -> paused where the worker shuts down meanwhile; evaluating -> queued where a pause came too late
            self._transition(WorkState.PAUSED if target is WorkState.QUEUED else WorkState.QUEUED, message)

    def _fail(self, ending: Ending, error: str) -> None:
        data = {"exit": ending.returncode, "kind": ending.outcome.kind if ending.outcome else "killed"}
        why = {"message": error, "error": error, "output": last_words(ending)}
        outcomes.transition(self._context.sessions, self._lease, WorkState.FAILED, data=data, **why)

    def _give_way(self) -> None:
        """Queue the work again: together with the worker's other children it needed too much memory."""
        limit = f"the {self._context.memory.limit_bytes // MIB:.0f} MiB of its worker"
        if self.kind is WorkKind.EVALUATION:
            reason = f"a training needs {limit}; the evaluation waits"
            outcomes.postpone(self._context.sessions, self._lease, reason)
        else:
            reason = f"the trainings of its worker need more than {limit}, this one the most"
            outcomes.lose(self._context.sessions, self._lease, reason)

    def _memory_message(self, ending: Ending) -> str:
        settings, total = self._context.settings, ending.intent is Intent.CROWDED
        limit = int(self._context.memory.limit_bytes // MIB) if total else settings.worker_memory_mb
        return (
            f"the {self._program} held {ending.peak_bytes // MIB} MiB of memory, more than the worker's limit of "
            f"{limit} MiB{' with the files of its attempts' if total else ''}; lower n_envs or n_steps, or raise "
            f"NAOSPRINT_WORKER_MEMORY_{'TOTAL_' if total else ''}MB"
        )

    def _patiently(self, call: Callable[[], T]) -> T | None:
        """Return ``call()`` once the database answers, however long that takes; give up when the worker shuts down.

        Retries are frequent enough to succeed before other workers requeue work whose lease has expired. Each renews
        the lease: a database with a full disk may refuse new rows for hours, while its clock of leases advances.
        """
        what = f"settling {self._lease.kind} {self._lease.id}"
        lease_s = self._context.settings.lease_s

        def renew(_error: Exception, _pause_s: float) -> None:
            with contextlib.suppress(LeaseLostError, *DATABASE_ERRORS):
                leases.heartbeat(self._context.sessions, self._lease, lease_s=lease_s)

        tries = partial(retry, call, what=what, transient=DATABASE_ERRORS, max_delay_s=lease_s / 4, on_retry=renew)
        try:
            try:
                return tries(patience_s=math.inf, stop=self._closing)
            except PatienceExhaustedError:
                return tries(patience_s=_LAST_PATIENCE_S)
        except PatienceExhaustedError:
            logger.exception("%s; its lease will expire", what)
            return None


def last_words(ending: Ending) -> str:
    """Return the last output of a child for the log of its work."""
    return ending.outcome.traceback if ending.outcome else ending.last_output


def describe_ending(who: str, ending: Ending) -> str:
    """Return in one or two sentences how a child ended and, where it is known, why."""
    held = f"it held up to {ending.peak_bytes // MIB} MiB of memory"
    if ending.overstayed:
        return f"the {who} did not stop within the grace period and was killed"
    if ending.outcome is not None:
        return ending.outcome.message if ending.returncode > 0 else f"{who}: {ending.outcome.message}"
    text = f"the {who} ended by {describe_exit(ending.returncode)}"
    if ending.returncode == TrainerExitCode.DISK_FULL:
        return f"the {who} found no space left on the disk of the worker's folder"
    if ending.returncode == 0:
        text += " before it had reported its end"
    if ending.oom:
        return f"{text}: probably out of memory, {held}"
    if ending.returncode == -9:
        return f"{text}: killed from outside; {held}"
    last = ending.last_output.splitlines()[-1] if ending.last_output else ""
    return f"{text}; last output: {last}" if last else text
