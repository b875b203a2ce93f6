"""Outcomes of attempts: what workers report of leased work, and what follows a worker that is lost.

Each function is one small transaction.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, cast

from sqlalchemy import ColumnElement, Select, and_, func, or_, select
from sqlalchemy.orm import Session

from naojobs.changes import MAX_LOG_CHARS, add_event, add_line, change, lock
from naojobs.checkpoints import newest_checkpoint
from naojobs.database import Sessions, is_outage, one_statement
from naojobs.errors import public
from naojobs.leases import DEFAULT_LEASE_S, LONGEST_POSTPONE_S, Lease, hold, hold_as, read_lease_clock
from naojobs.models import WORK, AnyWork, Evaluation, Event, Job, Match, MetricsRecord, WorkKind, generation, lease_time
from naojobs.states import LEASED, WorkState

POSTPONE_S = 5.0
"""Seconds until the next attempt after one that ended because a service was unavailable, doubled with each in a row up
to the longest.
"""


_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Requeued:
    """Work whose lease had expired, and its new state."""

    kind: WorkKind
    id: str
    simulator: str
    state: WorkState


def report_stall(sessions: Sessions, lease: Lease, idle_s: float | None) -> None:
    """Record that leased work has made no step for `idle_s` seconds; none: that it makes steps again.

    Raises LeaseLostError.
    """
    with sessions.begin() as session:
        work = hold(session, lease)
        work.updated_at = func.now()
        if idle_s is None:
            work.stalled_since = None
            add_event(session, work, "recovered", "makes steps again")
        else:
            work.stalled_since = func.now() - timedelta(seconds=idle_s)
            add_event(session, work, "stalled", f"has made no step for {idle_s:.0f} s")


def transition(
    sessions: Sessions,
    lease: Lease,
    target: WorkState,
    *,
    message: str = "",
    error: str | None = None,
    data: Mapping[str, Any] | None = None,
    output: str = "",
) -> WorkState:
    """Change the state of leased work to `target`, with the last `output` in its log; return the state it had.

    The lease ends with every state outside `LEASED`; work that a user asked to cancel becomes cancelled instead. Use it
    with `queued` to requeue work without counting a failure (a worker that shuts down); after a lost child process use
    `lose`, after an outage of a service `postpone`.

    Raises LeaseLostError, and ConflictError if the table of transitions does not allow it.
    """
    with sessions.begin() as session:
        work = hold(session, lease)
        source = work.state
        if source is not target:
            _log_output(session, work, output)
            _settle(session, work, target, message=message, error=error, data=data)
    return source


def succeed(sessions: Sessions, lease: Lease) -> str | None:
    """Change leased work to succeeded if all that it has to leave is stored; else return what is missing.

    Raises LeaseLostError, and ConflictError if the table of transitions does not allow it.
    """
    with sessions.begin() as session:
        work = hold(session, lease)
        missing = _missing(session, work)
        if missing is None:
            _settle(session, work, WorkState.SUCCEEDED, message="done")
    return missing


def _missing(session: Session, work: AnyWork) -> str | None:
    """Return in words what locked work lacks to have succeeded; none if nothing."""
    if isinstance(work, Evaluation):
        complete = work.summary is not None and work.key is not None and work.manifest is not None
        return None if complete else "its result is not stored"
    if isinstance(work, Match):
        played = (work.summary or {}).get("games", 0)
        decided = (work.summary or {}).get("decided", False)
        return None if played == work.spec["games"] or decided else f"{played} of {work.spec['games']} games are stored"
    if work.progress_step < work.total_steps:
        return f"it stands at step {work.progress_step:,} of {work.total_steps:,}"
    last = newest_checkpoint(session, work.id)
    if last is None or last.step < work.total_steps:
        return f"its checkpoint of step {work.total_steps:,} is not stored"
    evaluated = select(Evaluation.id).where(
        Evaluation.checkpoint_id == last.id, Evaluation.state == WorkState.SUCCEEDED
    )
    if work.evaluation and session.scalar(evaluated.limit(1)) is None:
        return "its evaluation is not stored"
    return None


def _settle(
    session: Session,
    work: AnyWork,
    target: WorkState,
    *,
    message: str = "",
    error: str | None = None,
    data: Mapping[str, Any] | None = None,
) -> None:
    """Change the state of locked work to `target` and record it. Raises ConflictError.

    A request to cancel was acknowledged: work that then ends or gives up its lease is cancelled in any case.
    """
    source = work.state
    if work.cancel_requested and target not in LEASED | {WorkState.CANCELLED}:
        target, message = WorkState.CANCELLED, f"{message or target}; cancelled as requested"
    change(work, target)
    if isinstance(work, Job) and target is WorkState.CANCELLED and work.pruned:
        message = error = f"pruned: {work.pruned}"
    if error is not None:
        work.error = error
    elif target is WorkState.SUCCEEDED:
        work.error = None
        work.failures = work.postponed = 0
    add_event(session, work, str(target), message or error or f"{source} -> {target}", data)


def _begun(job: Job, step: int, resumed_from: str | None) -> Select[int]:
    """Return the query of the event that this attempt has begun in this way."""
    data = {"step": step, "checkpoint_id": resumed_from}
    ways = ("started", "resumed")
    same = (Event.job_id == job.id, Event.attempt == job.attempt, Event.kind.in_(ways), Event.data == data)
    return select(Event.id).where(*same).limit(1)


def begin(
    sessions: Sessions,
    lease: Lease,
    *,
    step: int,
    resumed_from: str | None = None,
    software: Mapping[str, str] | None = None,
) -> None:
    """Record that a training starts at `step`; with steps done but no `resumed_from` from a file on the worker's disk.

    `software` is what it runs with, see `naojobs.models.Job`; what differs from the attempt before is an event.
    Metrics beyond it will be measured again; those of earlier attempts stay until a new checkpoint supersedes them
    (`naojobs.records.write`). Raises LeaseLostError.
    """
    with sessions.begin() as session:
        job = hold_as(session, lease, Job)
        resumed = resumed_from is not None or step > 0
        if session.scalar(_begun(job, step, resumed_from)) is not None:
            return  # a commit that seemed to fail did not
        newest = session.scalar(
            select(MetricsRecord)
            .where(MetricsRecord.job_id == job.id, MetricsRecord.step <= step)
            .order_by(MetricsRecord.step.desc())
            .limit(1),
        )
        if software is not None:
            _note_software(session, job, software)
        job.progress_step = job.began_step = step
        job.latest_metrics = newest.values if newest is not None else {}
        job.updated_at = func.now()
        add_event(
            session,
            job,
            "resumed" if resumed else "started",
            f"{'resumes from' if resumed else 'starts at'} step {step}",
            {"step": step, "checkpoint_id": resumed_from},
        )


def _note_software(session: Session, job: Job, software: Mapping[str, str]) -> None:
    """Store what a job runs with; add an event if an earlier attempt ran with something else."""
    before = job.software
    changed = [name for name in sorted({*before, *software}) if before.get(name) != software.get(name)]
    if before and changed:
        parts = [f"{name} {before.get(name, 'none')} -> {software.get(name, 'none')}" for name in changed]
        add_event(session, job, "software_changed", f"runs with other software: {', '.join(parts)}", {"before": before})
    job.software = dict(software)


def _log_output(session: Session, work: AnyWork, output: str) -> None:
    """Write the last output of an attempt to the log of its work.

    In the transaction that ends the lease: an attempt that is settled again after an error writes nothing twice.
    """
    if output.strip():
        add_line(session, work, "error", public(output)[-MAX_LOG_CHARS:])  # an error is at the end


def lose(sessions: Sessions, lease: Lease, reason: str, *, output: str = "") -> WorkState:
    """Count a failed attempt and queue the work again, or end it when that was the last; return the new state.

    Work that a user asked to cancel or pause ends that way instead. Its log gets the last `output`. Raises
    LeaseLostError.
    """
    with sessions.begin() as session:
        work = hold(session, lease)
        _log_output(session, work, output)
        return _lose(session, work, reason)


def postpone(sessions: Sessions, lease: Lease, reason: str) -> WorkState:
    """Queue work again whose attempt ended because a service was unavailable; return the new state.

    It counts no failed attempt. The next attempt begins after a delay, which grows while attempts end in this way.
    Work that a user asked to cancel or pause ends that way instead. Raises LeaseLostError.
    """
    with sessions.begin() as session:
        return _lose(session, hold(session, lease), reason, counts=False)


def _lose(session: Session, work: AnyWork, reason: str, *, counts: bool = True) -> WorkState:
    work.failures += counts
    error = reason = public(reason)
    delay_s = None
    if work.cancel_requested:
        target, message = WorkState.CANCELLED, f"{reason}; cancelled as requested"
    elif work.state is WorkState.PAUSING:
        target, message = WorkState.PAUSED, f"{reason}; paused as requested, at its last checkpoint"
    elif not counts:
        delay_s = min(POSTPONE_S * 2**work.postponed, LONGEST_POSTPONE_S)
        work.postponed = min(work.postponed + 1, 30)
        target, message = WorkState.QUEUED, f"{reason}; queued again, the next attempt begins in {delay_s:.0f} s"
    elif work.failures >= work.max_attempts:
        target = WorkState.FAILED
        error = message = f"{reason}; that was attempt {work.failures} of {work.max_attempts}"
    else:
        target = WorkState.QUEUED
        message = f"{reason}; queued again after attempt {work.failures} of {work.max_attempts}"
    data = {"reason": reason, "failures": work.failures}
    if delay_s is not None:
        data["delay_s"] = delay_s
    _settle(session, work, target, message=message, error=error, data=data)
    if delay_s is not None:
        work.not_before = func.now() + timedelta(seconds=delay_s)
    return target


def _why_lost(session: Session, work: AnyWork, restored: ColumnElement[bool]) -> tuple[str, bool]:
    """Return why the lease on locked work has expired, and whether its attempt counts as a failed one."""
    model, worker = type(work), work.lease_owner
    if session.scalar(select(restored).where(model.id == work.id)):
        return f"the {'service was upgraded' if work.lease_generation is None else 'database was restored'}", False
    if session.scalar(select(model.heartbeat_at < func.pg_postmaster_start_time()).where(model.id == work.id)):
        return f"the service was restarted, and with it worker {worker}", False
    return f"lease of worker {worker} expired", True


def requeue_stale(sessions: Sessions, *, lease_s: float = DEFAULT_LEASE_S) -> list[Requeued]:
    """Count a failed attempt for all work whose lease has expired, and queue it again or end it; return the new states.

    An attempt whose last heartbeat is older than the database's start counts as none: the machine, the container engine
    or the service was restarted, with the worker. Neither does one of another generation: the database was restored.
    Several workers may do so at once: each row is processed by one. A row for which that fails keeps no other from it.
    """
    done = []
    with one_statement(sessions) as session:
        read_lease_clock(session, lease_s)
    now = select(lease_time(lease_s)).scalar_subquery()
    for model in WORK.values():
        restored = model.lease_generation.is_distinct_from(generation())
        # A constraint lets leased work, and no other, have an owner: asked in this way, the index of leases serves.
        expired = and_(model.lease_owner.is_not(None), or_(model.lease_expires_at < now, restored))
        with sessions() as session:
            stale = session.scalars(select(model.id).where(expired).order_by(model.lease_expires_at)).all()
        for work_id in stale:
            try:
                with sessions.begin() as session:
                    work = lock(session, cast("type[Job]", model), work_id, expired, skip_locked=True)
                    if work is not None:
                        reason, counts = _why_lost(session, work, restored)
                        state = _lose(session, work, reason, counts=counts)
            except Exception as error:
                if is_outage(error):
                    raise
                _log.exception("%s is not requeued", work_id)
            else:
                done += [] if work is None else [Requeued(work.kind, work.id, work.simulator, state)]
    return done


def record_notification_failure(sessions: Sessions, job_id: str, error: str) -> None:
    """Record that the broker could not be reached for the wake-up message of a job."""
    with sessions.begin() as session:
        job = lock(session, Job, job_id)
        if job is not None:
            message = "the broker could not be reached; the job waits until a free worker polls the queue"
            add_event(session, job, "notification_failed", message, {"error": public(error)})
