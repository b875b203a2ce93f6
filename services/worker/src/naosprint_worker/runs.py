"""See one claimed job or evaluation through: run the child, then settle what became of it."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from naojobs import lifecycle, records
from naojobs.errors import ConflictError, LeaseLostError
from naojobs.lifecycle import Claim, Orders
from naojobs.models import Job
from naojobs.records import EvaluationClaim, LogLine
from naojobs.states import EvaluationState, JobState
from naosim.launchers import LABELS_VARIABLE, NETWORK_VARIABLE
from naosim.simspark.program import PROGRAM_VARIABLE
from sqlalchemy import select

from naosprint_worker.assignment import EvaluationAssignment, TrainingAssignment
from naosprint_worker.child import Child
from naosprint_worker.context import Context
from naosprint_worker.database import DATABASE_TROUBLE
from naosprint_worker.orphans import OWNER_VARIABLE, Owner
from naosprint_worker.outcome import ExitCode, describe_exit
from naosprint_worker.retry import PatienceExhaustedError, describe, retry
from naosprint_worker.settings import WorkerSettings
from naosprint_worker.supervisor import MIB, Ending, Intent, Supervisor

logger = logging.getLogger(__name__)

T = TypeVar("T")


class JobRun:
    """One attempt at a job, from the claim to the state it leaves the job in."""

    def __init__(self, context: Context, claim: Claim) -> None:
        """Prepare the working folder."""
        self._context = context
        self._claim = claim
        self._lease = claim.lease
        self._workdir = context.folder / f"{claim.lease.job_id}-{claim.lease.attempt}"
        self._supervisor = Supervisor(
            context.settings,
            start=self._start,
            beat=lambda: lifecycle.heartbeat(context.sessions, self._lease, lease_s=context.settings.lease_s),
            look=self._look,
            workdir=self._workdir,
            log_path=self._workdir / "output.log",
        )

    def shut_down(self) -> None:
        """Let the attempt end with a checkpoint, and the job go on elsewhere."""
        self._supervisor.shut_down()

    def run(self) -> None:
        """Run the attempt to its end and settle the job's state."""
        try:
            try:
                self._workdir.mkdir(parents=True)
                TrainingAssignment.from_claim(self._claim).write(self._workdir)
                ending = self._supervisor.run()
            except OSError as error:
                reason = f"the trainer could not be started: {describe(error)}"
                _patiently(
                    self._context,
                    lambda: lifecycle.lose(self._context.sessions, self._lease, reason),
                    f"giving job {self._lease.job_id} back",
                )
                return
            _patiently(self._context, lambda: self._settle(ending), f"settling job {self._lease.job_id}")
        except LeaseLostError as error:
            logger.warning("%s; leaving it to its new owner", error)
        finally:
            shutil.rmtree(self._workdir, ignore_errors=True)

    def _start(self, on_exit: Callable[[], None]) -> Child:
        labels = f"job={self._lease.job_id},attempt={self._lease.attempt}"
        return _start_child("trainer", self._workdir, on_exit, self._context.settings, labels)

    def _look(self) -> Orders:
        with self._context.sessions() as session:
            row = session.execute(
                select(Job.state, Job.cancel_requested, Job.pause_requested).where(
                    Job.id == self._lease.job_id,
                    Job.lease_owner == self._lease.owner,
                    Job.attempt == self._lease.attempt,
                )
            ).one_or_none()
        if row is None:
            raise LeaseLostError(f"job {self._lease.job_id} is no longer leased to {self._lease.owner}")
        return Orders(JobState(row.state), cancel=row.cancel_requested, pause=row.pause_requested)

    def _settle(self, ending: Ending) -> None:
        """Turn how the child ended into the job's next state."""
        sessions, lease = self._context.sessions, self._lease
        stopped_well = ending.returncode == ExitCode.STOPPED
        where = "" if stopped_well else f" without a last checkpoint ({describe_ending('trainer', ending)})"
        logger.info("job %s attempt %d: %s", lease.job_id, lease.attempt, describe_ending("trainer", ending))
        if ending.intent is Intent.LEASE_LOST or ending.returncode == ExitCode.FENCED:
            return
        if ending.returncode == ExitCode.FINISHED:
            lifecycle.transition(sessions, lease, JobState.SUCCEEDED, message="done")
        elif ending.intent is Intent.CANCEL:
            lifecycle.transition(sessions, lease, JobState.CANCELLED, message=f"cancelled as asked{where}")
        elif ending.intent is Intent.MEMORY:
            self._fail(ending, _memory_message("trainer", ending, self._context.settings))
        elif ending.intent is Intent.PAUSE:
            self._give_back(JobState.PAUSED, f"paused as asked{where}")
        elif ending.intent is Intent.SHUTDOWN:
            if self._look().cancel:
                lifecycle.transition(sessions, lease, JobState.CANCELLED, message=f"cancelled as asked{where}")
            else:
                self._give_back(JobState.QUEUED, f"worker ends, job goes on elsewhere{where}")
        elif ending.returncode == ExitCode.PERMANENT:
            self._fail(ending, describe_ending("trainer", ending))
        else:
            self._log_ending(ending)
            state = lifecycle.lose(sessions, lease, describe_ending("trainer", ending))
            self._ring_if_queued(state)

    def _give_back(self, target: JobState, message: str) -> None:
        """End the attempt in ``target``, or in the state that fits when users or the trainer were faster."""
        sessions, lease = self._context.sessions, self._lease
        try:
            lifecycle.transition(sessions, lease, target, message=message)
        except ConflictError:
            # pausing -> paused where the worker ends meanwhile; evaluating -> queued where a pause came too late
            target = JobState.PAUSED if target is JobState.QUEUED else JobState.QUEUED
            lifecycle.transition(sessions, lease, target, message=message)
        self._ring_if_queued(target)

    def _fail(self, ending: Ending, error: str) -> None:
        self._log_ending(ending)
        data = {"exit": ending.returncode, "kind": ending.outcome.kind if ending.outcome else "killed"}
        lifecycle.transition(
            self._context.sessions, self._lease, JobState.FAILED, message=error, error=error, data=data
        )

    def _log_ending(self, ending: Ending) -> None:
        lines = [ending.outcome.traceback if ending.outcome else "", ending.last_output if not ending.outcome else ""]
        records.append_logs(
            self._context.sessions, self._lease, [LogLine("error", text) for text in lines if text.strip()]
        )

    def _ring_if_queued(self, state: JobState) -> None:
        if state is JobState.QUEUED:
            with contextlib.suppress(*DATABASE_TROUBLE):
                self._context.announce_job(self._lease.job_id)


class EvaluationRun:
    """One attempt at an evaluation that a user asked for."""

    def __init__(self, context: Context, claim: EvaluationClaim) -> None:
        """Prepare the working folder."""
        self._context = context
        self._claim = claim
        self._workdir = context.folder / f"{claim.id}-{claim.attempt}"
        self._supervisor = Supervisor(
            context.settings,
            start=self._start,
            beat=self._beat,
            look=lambda: _NO_ORDERS,
            workdir=self._workdir,
            log_path=self._workdir / "output.log",
        )

    def shut_down(self) -> None:
        """Stop; the evaluation starts again elsewhere."""
        self._supervisor.shut_down()

    def run(self) -> None:
        """Run the evaluation to its end and settle its state."""
        try:
            try:
                self._workdir.mkdir(parents=True)
                EvaluationAssignment(claim=self._claim).write(self._workdir)
                ending = self._supervisor.run()
            except OSError as error:
                reason = f"the evaluator could not be started: {describe(error)}"
                _patiently(
                    self._context,
                    lambda: records.release_evaluation(self._context.sessions, self._claim, reason),
                    f"giving evaluation {self._claim.id} back",
                )
                return
            _patiently(self._context, lambda: self._settle(ending), f"settling evaluation {self._claim.id}")
        except LeaseLostError as error:
            logger.warning("%s", error)
        finally:
            shutil.rmtree(self._workdir, ignore_errors=True)

    def _start(self, on_exit: Callable[[], None]) -> Child:
        labels = f"evaluation={self._claim.id},attempt={self._claim.attempt}"
        return _start_child("evaluator", self._workdir, on_exit, self._context.settings, labels)

    def _beat(self) -> Orders:
        records.heartbeat_evaluation(self._context.sessions, self._claim, lease_s=self._context.settings.lease_s)
        return _NO_ORDERS

    def _settle(self, ending: Ending) -> None:
        sessions, claim = self._context.sessions, self._claim
        what = describe_ending("evaluator", ending)
        logger.info("evaluation %s attempt %d: %s", claim.id, claim.attempt, what)
        if ending.returncode in (ExitCode.FINISHED, ExitCode.FENCED) or ending.intent is Intent.LEASE_LOST:
            return  # the child records its figures itself, as the last thing it does
        if ending.intent is Intent.MEMORY:
            error = _memory_message("evaluator", ending, self._context.settings)
            records.finish_evaluation(sessions, claim, error=error)
        elif ending.returncode == ExitCode.PERMANENT:
            records.finish_evaluation(sessions, claim, error=what)
        else:
            state = records.release_evaluation(sessions, claim, what, count=ending.intent is not Intent.SHUTDOWN)
            if state is EvaluationState.QUEUED:
                with contextlib.suppress(*DATABASE_TROUBLE):
                    self._context.announce_evaluation(claim.id)


_NO_ORDERS = Orders(JobState.EVALUATING, cancel=False, pause=False)


def describe_ending(who: str, ending: Ending) -> str:
    """Say in one or two sentences how a child ended and, where it is known, why."""
    held = f"it held up to {ending.peak_bytes // MIB} MiB of memory"
    if ending.overstayed:
        return f"the {who} did not stop within the grace period and was killed"
    if ending.outcome is not None:
        return ending.outcome.message if ending.returncode > 0 else f"{who}: {ending.outcome.message}"
    text = f"the {who} ended by {describe_exit(ending.returncode)}"
    if ending.returncode == ExitCode.DISK_FULL:
        return f"the {who} found no space left on the disk of the worker's folder"
    if ending.returncode == 0:
        return f"the {who} finished"
    if ending.oom:
        return f"{text}: probably out of memory, {held}"
    if ending.returncode == -9:
        return f"{text}: killed from outside; {held}"
    last = ending.last_output.splitlines()[-1] if ending.last_output else ""
    return f"{text}; last output: {last}" if last else text


def _memory_message(who: str, ending: Ending, settings: WorkerSettings) -> str:
    return (
        f"the {who} held {ending.peak_bytes // MIB} MiB of memory, more than the worker's limit of "
        f"{settings.worker_memory_mb} MiB; lower n_envs or n_steps, or raise NAOSPRINT_WORKER_MEMORY_MB"
    )


def _start_child(
    module: str, workdir: Path, on_exit: Callable[[], None], settings: WorkerSettings, server_labels: str
) -> Child:
    return Child(
        [sys.executable, "-m", f"naosprint_worker.{module}", "--workdir", str(workdir)],
        env={
            **os.environ,
            "PYTHONFAULTHANDLER": "1",
            "PYTHONUNBUFFERED": "1",
            OWNER_VARIABLE: str(Owner.current()),
            PROGRAM_VARIABLE: settings.simserver,
            NETWORK_VARIABLE: settings.simserver_network or "",
            LABELS_VARIABLE: server_labels,
        },
        cwd=workdir,
        log_path=workdir / "output.log",
        on_exit=on_exit,
    )


def _patiently(context: Context, call: Callable[[], T], what: str) -> T | None:
    """Return ``call()`` once the database takes it; give up after a while, since the reaper will notice the lease."""
    try:
        return retry(call, what=what, transient=DATABASE_TROUBLE, patience_s=context.settings.worker_patience_s)
    except PatienceExhaustedError:
        logger.exception("%s; its lease will run out", what)
        return None
