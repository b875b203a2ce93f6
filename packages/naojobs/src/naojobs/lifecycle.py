"""Life cycle of work, the same for jobs and evaluations: every function is one small transaction.

The state of a piece of work changes only in `_change`, which checks it against `naojobs.states.TRANSITIONS`, under a
lock on its row. Times come from the database's clock, never from a host's, those of leases from their own
(`naojobs.models.lease_time`). Events are written under the lock on the
job's row, so their ids ascend in the order of their commits; a function that locks an evaluation's row and writes an
event locks the job's row first.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, TypeAlias, TypeVar, cast, overload

import naopolicies
from naospec import EvaluationSpec, TrainingSpec, plugins, read_stored, validation_words
from pydantic import ValidationError
from sqlalchemy import ColumnElement, ScalarSelect, Select, and_, func, or_, select, update
from sqlalchemy.orm import Session

from naojobs.capabilities import Capabilities
from naojobs.checkpoints import CheckpointRef, awaits_policy, newest_checkpoint, trained_checkpoint
from naojobs.database import Sessions, is_due, notify, one_statement
from naojobs.errors import ConflictError, LeaseLostError, NotFoundError
from naojobs.models import (
    WORK,
    Checkpoint,
    Evaluation,
    Event,
    Job,
    LeaseClock,
    MetricsRecord,
    PolicyRecord,
    PolicyVersion,
    WorkKind,
    generation,
    lease_time,
)
from naojobs.quotas import NO_LIMITS, Limits, Quota, require_room
from naojobs.states import ENDED, LEASED, OPEN, WorkState, can_become
from naojobs.webhooks import MessageType, publish

POSTPONE_S, LONGEST_POSTPONE_S = 5.0, 300.0
"""Seconds until the next attempt after one that ended because a service was unavailable, doubled with each in a row up
to the longest.
"""

DEFAULT_LEASE_S = 30.0
"""Seconds after a heartbeat at which a lease expires."""

W = TypeVar("W", Job, Evaluation)


@dataclass(frozen=True, slots=True)
class Lease:
    """Right of a worker to write to a piece of work.

    `attempt` fences it off once another worker has claimed the work, `generation` once the database was restored.
    """

    kind: WorkKind
    id: str
    job_id: str
    """The job that it belongs to; a job's own id."""
    owner: str
    attempt: int
    generation: str
    """Generation of the database that gave it, see `naojobs.models.generation`."""

    def __str__(self) -> str:
        """Return the work and its holder for messages."""
        return f"{self.kind} {self.id} of {self.owner} (attempt {self.attempt})"


@dataclass(frozen=True, slots=True)
class JobClaim:
    """Lease on a job with what to do and where to start from."""

    lease: Lease
    name: str
    spec: TrainingSpec
    evaluation: EvaluationSpec | None
    resume_from: CheckpointRef | None
    """The job's own newest checkpoint, to continue from."""
    initial_policy: CheckpointRef | None
    """The checkpoint of another job to take the initial policy from; none when there is something to resume."""
    bundled_policy: str | None = None
    """The bundled policy to start from; none when there is something to resume."""


@dataclass(frozen=True, slots=True)
class EvaluationClaim:
    """Lease on an evaluation with what to evaluate."""

    lease: Lease
    spec: EvaluationSpec
    checkpoint: CheckpointRef
    time_limit_s: float


Claim: TypeAlias = JobClaim | EvaluationClaim


@dataclass(frozen=True, slots=True)
class Requests:
    """State of leased work and what users request of it."""

    state: WorkState
    cancel: bool


@dataclass(frozen=True, slots=True)
class Requeued:
    """Work whose lease had expired, and its new state."""

    kind: WorkKind
    id: str
    state: WorkState


# --- changes of state -------------------------------------------------------------------------------------------------


def _change(work: Job | Evaluation, target: WorkState) -> None:
    """Change the state of a locked row and all columns that depend on it. Raises ConflictError."""
    if not can_become(work.state, target):
        raise ConflictError(f"{work.kind} {work.id} is {work.state} and cannot become {target}")
    work.state = target
    work.updated_at = func.now()
    if target not in LEASED:
        work.lease_owner = work.lease_generation = None
        work.lease_expires_at = None
        work.stalled_since = None
    if target is WorkState.QUEUED:
        work.queued_at = func.now()
        work.finished_at = None
        work.not_before = None
    if target in ENDED:
        work.finished_at = func.now()
        work.cancel_requested = False
    if isinstance(work, Job) and target in ENDED | {WorkState.QUEUED, WorkState.PAUSED}:
        work.pause_requested = False


def add_event(
    session: Session, work: Job | Evaluation, kind: str, message: str, data: Mapping[str, Any] | None = None
) -> None:
    """Add an event to the job's history; the caller holds the lock on the job's row.

    Events of an evaluation are of kind `evaluation` and contain its id and state.
    """
    if isinstance(work, Evaluation):
        event = Event(
            kind="evaluation",
            attempt=session.get_one(Job, work.job_id).attempt,
            message=f"evaluation {work.id}: {message}",
            data={**(data or {}), "evaluation_id": work.id, "state": str(work.state)},
        )
    else:
        event = Event(kind=kind, attempt=work.attempt, message=message, data=dict(data or {}))
        work.row_count += 1
    event.job_id = work.job_id
    session.add(event)
    notify(session, work.job_id)
    _publish(session, work, kind)


def _publish(session: Session, work: Job | Evaluation, kind: str) -> None:
    """Write the messages of an event to webhooks, if it is an end or the stall of a job."""
    ended = work.state in ENDED and kind == str(work.state)
    if not ended and (kind != "stalled" or isinstance(work, Evaluation)):
        return
    job = work if isinstance(work, Job) else session.get_one(Job, work.job_id)
    data: dict[str, Any] = {"job_id": job.id, "name": job.name, "tags": job.tags, "group_id": job.group_id}
    if isinstance(work, Evaluation):
        message = MessageType.EVALUATION_FINISHED
        results = {item["name"]: item["value"] for item in (work.summary or {}).get("results", ())}
        data |= {"evaluation_id": work.id, "checkpoint_id": work.checkpoint_id, "results": results}
    else:
        message = MessageType.JOB_ENDED if ended else MessageType.JOB_STALLED
        data |= {"step": job.progress_step, "total_steps": job.total_steps, "attempt": job.attempt}
    publish(session, job.owner, message, {**data, "state": str(work.state), "error": work.error})


def lock(
    session: Session, model: type[W], work_id: str, *conditions: ColumnElement[bool], skip_locked: bool = False
) -> W | None:
    """Lock a piece of work, and first the job that it belongs to; return it, or none if no row meets `conditions`."""
    if model is Evaluation:
        job_id = select(Evaluation.job_id).where(Evaluation.id == work_id).scalar_subquery()
        job = select(Job).where(Job.id == job_id).with_for_update(skip_locked=skip_locked)
        if session.scalar(job) is None:
            return None
    return session.scalar(
        select(model).where(model.id == work_id, *conditions).with_for_update(skip_locked=skip_locked)
    )


def _known(session: Session, model: type[W], work_id: str) -> W:
    work = lock(session, model, work_id)
    if work is None:
        raise NotFoundError(f"no {model.kind} {work_id}")
    return work


def _held_by(lease: Lease) -> ColumnElement[bool]:
    """Return the condition under which `lease` is still valid."""
    model = WORK[lease.kind]
    return and_(
        model.id == lease.id,
        model.lease_owner == lease.owner,
        model.attempt == lease.attempt,
        generation() == lease.generation,
    )


def _lost(lease: Lease) -> LeaseLostError:
    return LeaseLostError(f"{lease.kind} {lease.id} is no longer leased to {lease.owner} (attempt {lease.attempt})")


def hold(session: Session, lease: Lease) -> Job | Evaluation:
    """Lock leased work for the rest of the transaction. Raises LeaseLostError."""
    work = lock(session, cast("type[Job]", WORK[lease.kind]), lease.id, _held_by(lease))
    if work is None:
        raise _lost(lease)
    return work


def hold_job(session: Session, lease: Lease) -> Job:
    """Lock a leased job for the rest of the transaction. Raises LeaseLostError."""
    job = hold(session, lease)
    assert isinstance(job, Job), f"{lease} is not a lease on a job"
    return job


def hold_evaluation(session: Session, lease: Lease) -> Evaluation:
    """Lock a leased evaluation for the rest of the transaction. Raises LeaseLostError."""
    evaluation = hold(session, lease)
    assert isinstance(evaluation, Evaluation), f"{lease} is not a lease on an evaluation"
    return evaluation


# --- requests of users ------------------------------------------------------------------------------------------------


def request_cancel(sessions: Sessions, model: type[W], work_id: str) -> W:
    """Cancel waiting work, or ask the worker of running work to stop; a second request changes nothing.

    Raises NotFoundError, and ConflictError if the work has succeeded or failed.
    """
    with sessions.begin() as session:
        work = _known(session, model, work_id)
        _cancel(session, work)
        session.flush()
        session.refresh(work)
    return work


def _cancel(session: Session, work: Job | Evaluation, why: str = "") -> bool:
    """Cancel locked work or ask its worker to stop; return whether that is new. Raises ConflictError."""
    reason = f": {why}" if why else ""
    if work.state is WorkState.CANCELLED or (work.cancel_requested and work.state in LEASED):
        return False
    if work.state in LEASED:
        work.cancel_requested = True
        work.updated_at = func.now()
        add_event(session, work, "cancel_requested", f"asked the worker to stop{reason}")
    elif work.state not in ENDED:
        _change(work, WorkState.CANCELLED)
        add_event(session, work, "cancelled", f"cancelled before a worker claimed it{reason}")
    else:
        raise ConflictError(f"{work.kind} {work.id} has already {work.state}; there is nothing to cancel")
    return True


def cancel_open(session: Session, job_ids: Iterable[str], why: str) -> None:
    """Cancel those of these jobs that are open, for the reason `why`."""
    rows = select(Job).where(Job.id.in_(list(job_ids)), Job.state.in_(OPEN)).order_by(Job.id).with_for_update()
    for job in session.scalars(rows):
        _cancel(session, job, why)


def prune(sessions: Sessions, job_id: str, why: str) -> None:
    """Ask the worker of a running training to stop because its study gains nothing from it.

    Nothing happens to a job that is not training any more or whose end a user requested.
    """
    with sessions.begin() as session:
        job = lock(session, Job, job_id, Job.state == WorkState.RUNNING)
        if job is not None and _cancel(session, job, why):
            job.pruned = why


def request_pause(sessions: Sessions, job_id: str) -> Job:
    """Pause a job that waits, or ask the worker of one that trains to write a checkpoint and stop.

    Raises NotFoundError, and ConflictError if the job is evaluating or has ended.
    """
    with sessions.begin() as session:
        job = _known(session, Job, job_id)
        if job.state in (WorkState.PAUSING, WorkState.PAUSED):
            return job
        if job.state in (WorkState.STARTING, WorkState.RUNNING):
            job.pause_requested = True
            _change(job, WorkState.PAUSING)
            add_event(session, job, "pause_requested", "asked the worker to write a checkpoint and stop")
        elif job.state is WorkState.QUEUED:
            _change(job, WorkState.PAUSED)
            add_event(session, job, "paused", "paused before a worker claimed it")
        elif job.state is WorkState.EVALUATING:
            raise ConflictError(f"job {job_id} is evaluating, which cannot be paused; wait for its end, or cancel it")
        else:
            raise ConflictError(f"job {job_id} has already {job.state}; there is nothing to pause")
        session.flush()
        session.refresh(job)
    return job


def resume(sessions: Sessions, job_id: str, *, limits: Limits = NO_LIMITS) -> Job:
    """Queue a paused job again; it resumes from its last checkpoint.

    Raises NotFoundError, ConflictError if the job is not paused, and QuotaError if its owner's jobs have as many rows
    as `limits` allow.
    """
    with sessions.begin() as session:
        job = _known(session, Job, job_id)
        if job.state is WorkState.PAUSING:
            raise ConflictError(f"job {job_id} is still pausing; try again when its state is paused")
        if job.state in (WorkState.FAILED, WorkState.CANCELLED):
            raise ConflictError(f"job {job_id} is {job.state}, not paused; use retry")
        if job.state is not WorkState.PAUSED:
            raise ConflictError(f"job {job_id} is {job.state}; only a paused job can be resumed")
        require_room(session, job.owner, limits, Quota.ROWS)
        _change(job, WorkState.QUEUED)
        add_event(session, job, "queued", "resumed by a user")
        session.flush()
        session.refresh(job)
    return job


def retry(sessions: Sessions, job_id: str, *, limits: Limits = NO_LIMITS) -> Job:
    """Queue a failed or cancelled job again, with all its attempts; it resumes from its last checkpoint.

    Raises NotFoundError, ConflictError if the job has not failed and is not cancelled, and QuotaError if its owner has
    as many open jobs as `limits` allow.
    """
    with sessions.begin() as session:
        job = _known(session, Job, job_id)
        if job.state not in (WorkState.FAILED, WorkState.CANCELLED):
            hint = "use resume" if job.state is WorkState.PAUSED else "submit a new job to train again"
            raise ConflictError(f"job {job_id} is {job.state}; only a failed or cancelled job can be retried; {hint}")
        require_room(session, job.owner, limits, Quota.OPEN_JOBS)
        _change(job, WorkState.QUEUED)
        job.failures = job.postponed = 0
        job.error = job.pruned = None
        add_event(session, job, "queued", "retried by a user")
        session.flush()
        session.refresh(job)
    return job


def delete(sessions: Sessions, job_id: str) -> None:
    """Delete an ended job with all its rows; the caller deletes its artifacts afterwards.

    Raises NotFoundError, and ConflictError if the job is open, if an open job starts from its policy, or if one of its
    checkpoints is a version of a registered policy.
    """
    with sessions.begin() as session:
        # Children before their parent, as a claim locks them: the deletion changes their rows, too.
        session.execute(select(Job.id).where(Job.parent_job_id == job_id).order_by(Job.id).with_for_update())
        job = _known(session, Job, job_id)
        if job.state not in ENDED:
            raise ConflictError(f"job {job_id} is {job.state}; cancel it first")
        child = session.scalar(select(Job.id).where(Job.parent_job_id == job_id, Job.state.in_(OPEN)).limit(1))
        if child is not None:
            raise ConflictError(f"job {child} starts from the policy of job {job_id}; wait for its end, or cancel it")
        registered = session.execute(
            select(PolicyRecord.name, PolicyVersion.number)
            .join(PolicyVersion, PolicyVersion.policy_id == PolicyRecord.id)
            .join(Checkpoint, Checkpoint.id == PolicyVersion.checkpoint_id)
            .where(Checkpoint.job_id == job_id)
            .limit(1)
        ).first()
        if registered is not None:
            reference = f"{registered.name}@{registered.number}"
            raise ConflictError(f"policy {reference} is a checkpoint of job {job_id}; delete {reference} first")
        session.delete(job)
        notify(session, job_id, deleted_from=job.owner)


# --- claims and leases of workers -------------------------------------------------------------------------------------


@overload
def claim(
    sessions: Sessions,
    model: type[Job],
    work_id: str,
    worker: str,
    *,
    capabilities: Capabilities | None = None,
    lease_s: float = DEFAULT_LEASE_S,
) -> JobClaim | None: ...
@overload
def claim(
    sessions: Sessions,
    model: type[Evaluation],
    work_id: str,
    worker: str,
    *,
    capabilities: Capabilities | None = None,
    lease_s: float = DEFAULT_LEASE_S,
) -> EvaluationClaim | None: ...
def claim(
    sessions: Sessions,
    model: type[Job] | type[Evaluation],
    work_id: str,
    worker: str,
    *,
    capabilities: Capabilities | None = None,
    lease_s: float = DEFAULT_LEASE_S,
) -> Claim | None:
    """Claim one piece of work for `worker`; of several that try at once, one gets it and the others get none.

    None is also returned for work that is not queued, or that needs more than the worker's `capabilities`.
    """
    with sessions.begin() as session:
        waiting = _waiting(model, capabilities).where(model.id == work_id)
        work = session.scalar(waiting.with_for_update())
        return None if work is None else _take(session, work, worker, lease_s)


def claim_next(
    sessions: Sessions,
    worker: str,
    *,
    models: Iterable[type[Job] | type[Evaluation]] = (Job, Evaluation),
    queues: Sequence[str],
    capabilities: Capabilities,
    lease_s: float = DEFAULT_LEASE_S,
) -> Claim | None:
    """Claim the work of highest priority, the oldest first, in one of `queues` that `worker` can run.

    Several workers may look at once: each skips the rows that another is claiming.
    """
    models = tuple(models)
    while True:
        with sessions.begin() as session:
            found: list[Job | Evaluation] = []
            for model in models:
                first = _waiting(model, capabilities).where(model.queue.in_(queues))
                first = first.order_by(model.priority.desc(), model.queued_at).limit(1)
                work = session.scalar(first.with_for_update(skip_locked=True))
                found += [] if work is None else [work]
            if not found:
                return None
            taken = _take(session, min(found, key=lambda work: (-work.priority, work.queued_at)), worker, lease_s)
        if taken is not None:  # else it is no longer queued, and its row has the reason
            return taken


def _waiting(model: type[Job] | type[Evaluation], capabilities: Capabilities | None) -> Any:
    due = or_(model.not_before.is_(None), is_due(model.not_before, LONGEST_POSTPONE_S))
    waiting = select(model).where(model.state == WorkState.QUEUED, due)
    if model is Job:
        waiting = waiting.where(~awaits_policy())
    return waiting if capabilities is None else waiting.where(capabilities.condition(model))


def _take(session: Session, work: Job | Evaluation, worker: str, lease_s: float) -> Claim | None:
    """Lease a locked row to `worker`; the new attempt fences off every earlier worker.

    Work whose specification this version cannot read fails, as does a job that lacks the policy it starts from; then
    None is returned.
    """
    try:
        training = isinstance(work, Job)
        spec = read_stored(TrainingSpec, work.spec) if training else read_stored(EvaluationSpec, work.spec)
        final = isinstance(work, Job) and work.evaluation
        evaluation = read_stored(EvaluationSpec, final) if final else None
    except (ValidationError, plugins.BrokenPluginError) as error:
        words = validation_words(error.errors()) if isinstance(error, ValidationError) else str(error)
        reason = f"the specification does not fit this version: {words}"
        _refuse(session, work, reason)
        return None
    own = parent = bundled = None
    if isinstance(work, Job) and (own := newest_checkpoint(session, work.id)) is None and work.needs_policy:
        bundled = work.parent_policy if work.parent_policy in naopolicies.names() else None
        parent = _parent_policy(session, work) if bundled is None else None
        if parent is None and bundled is None:
            _refuse(session, work, _missing_policy(work))
            return None
    _change(work, WorkState.STARTING)
    work.attempt += 1
    work.lease_owner = worker
    work.lease_generation = session.scalars(select(generation())).one()
    work.lease_expires_at = _lease_end(lease_s)
    work.heartbeat_at = func.now()
    work.started_at = func.coalesce(type(work).started_at, func.now())
    lease = Lease(work.kind, work.id, work.job_id, worker, work.attempt, work.lease_generation)
    if isinstance(work, Evaluation):
        notify(session, work.job_id)  # no event: the job's row is not locked
        checkpoint = CheckpointRef.of(session.get_one(Checkpoint, work.checkpoint_id))
        assert isinstance(spec, EvaluationSpec)
        return EvaluationClaim(lease, spec, checkpoint, work.time_limit_s)
    add_event(session, work, "claimed", f"claimed by {worker}", {"worker": worker})
    assert isinstance(spec, TrainingSpec)
    return JobClaim(
        lease=lease,
        name=work.name,
        spec=spec,
        evaluation=evaluation,
        resume_from=CheckpointRef.of(own) if own else None,
        initial_policy=CheckpointRef.of(parent) if parent else None,
        bundled_policy=bundled,
    )


def _refuse(session: Session, work: Job | Evaluation, reason: str) -> None:
    """End queued work that no worker can begin."""
    work.error = reason
    _change(work, WorkState.FAILED)
    if isinstance(work, Job):
        add_event(session, work, "failed", reason)
    else:
        notify(session, work.job_id)  # no event: the job's row is not locked
        _publish(session, work, "failed")


def _parent_policy(session: Session, job: Job) -> Checkpoint | None:
    """Return the checkpoint whose policy a locked job starts from; none if there no longer is one."""
    if job.parent_checkpoint_id is not None:
        return session.get(Checkpoint, job.parent_checkpoint_id)
    if job.parent_job_id is None:
        return None
    # From now on this checkpoint is the parent's, for every attempt: the lock and the reference keep it from being
    # pruned by the parent job, which may still run.
    session.execute(select(Job.id).where(Job.id == job.parent_job_id).with_for_update(key_share=True))
    parent = trained_checkpoint(session, job.parent_job_id)
    job.parent_checkpoint_id = parent.id if parent is not None else None
    return parent


def _missing_policy(job: Job) -> str:
    if job.parent_policy is not None and "@" not in job.parent_policy:
        return f"this version has no policy {job.parent_policy!r}, which it starts from"
    if job.parent_job_id is None:
        return "the job whose policy it starts from was deleted"
    return f"job {job.parent_job_id}, whose policy it starts from, ended without a trained checkpoint"


def heartbeat(sessions: Sessions, lease: Lease, *, lease_s: float = DEFAULT_LEASE_S) -> Requests:
    """Renew `lease` and return the users' requests.

    Raises LeaseLostError if the work was requeued, deleted, or claimed by another worker.
    """
    model = WORK[lease.kind]
    with one_statement(sessions) as session:
        row = session.execute(
            update(model)
            .where(_held_by(lease))
            .values(heartbeat_at=func.now(), lease_expires_at=_lease_end(lease_s))
            .returning(model.state, model.cancel_requested),
        ).one_or_none()
    if row is None:
        raise _lost(lease)
    return Requests(row.state, cancel=row.cancel_requested)


def read_requests(sessions: Sessions, lease: Lease) -> Requests:
    """Return the users' requests without renewing `lease`. Raises LeaseLostError."""
    model = WORK[lease.kind]
    with one_statement(sessions) as session:
        row = session.execute(select(model.state, model.cancel_requested).where(_held_by(lease))).one_or_none()
    if row is None:
        raise _lost(lease)
    return Requests(row.state, cancel=row.cancel_requested)


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
) -> WorkState:
    """Change the state of leased work to `target`; return the state it had.

    The lease ends with every state outside `LEASED`; work that a user asked to cancel becomes cancelled instead. Use it
    with `queued` to requeue work without counting a failure (a worker that shuts down); after a lost child process use
    `lose`, after an outage of a service `postpone`.

    Raises LeaseLostError, and ConflictError if the table of transitions does not allow it.
    """
    with sessions.begin() as session:
        work = hold(session, lease)
        source = work.state
        if source is not target:
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


def _missing(session: Session, work: Job | Evaluation) -> str | None:
    """Return in words what locked work lacks to have succeeded; none if nothing."""
    if isinstance(work, Evaluation):
        complete = work.summary is not None and work.key is not None and work.manifest is not None
        return None if complete else "its result is not stored"
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
    work: Job | Evaluation,
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
    _change(work, target)
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


def begin(sessions: Sessions, lease: Lease, *, step: int, resumed_from: str | None = None) -> None:
    """Record that a training starts at `step`; with steps done but no `resumed_from` from a file on the worker's disk.

    Metrics beyond it will be measured again; those of earlier attempts stay until a new checkpoint supersedes them
    (`naojobs.records.write`). Raises LeaseLostError.
    """
    with sessions.begin() as session:
        job = hold_job(session, lease)
        resumed = resumed_from is not None or step > 0
        if session.scalar(_begun(job, step, resumed_from)) is not None:
            return  # a commit that seemed to fail did not
        newest = session.scalar(
            select(MetricsRecord)
            .where(MetricsRecord.job_id == job.id, MetricsRecord.step <= step)
            .order_by(MetricsRecord.step.desc())
            .limit(1),
        )
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


def lose(sessions: Sessions, lease: Lease, reason: str) -> WorkState:
    """Count a failed attempt and queue the work again, or end it when that was the last; return the new state.

    Work that a user asked to cancel or pause ends that way instead. Raises LeaseLostError.
    """
    with sessions.begin() as session:
        return _lose(session, hold(session, lease), reason)


def postpone(sessions: Sessions, lease: Lease, reason: str) -> WorkState:
    """Queue work again whose attempt ended because a service was unavailable; return the new state.

    It counts no failed attempt. The next attempt begins after a delay, which grows while attempts end in this way.
    Work that a user asked to cancel or pause ends that way instead. Raises LeaseLostError.
    """
    with sessions.begin() as session:
        return _lose(session, hold(session, lease), reason, counts=False)


def _lose(session: Session, work: Job | Evaluation, reason: str, *, counts: bool = True) -> WorkState:
    work.failures += counts
    error = reason
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


def _lease_end(lease_s: float) -> ScalarSelect[datetime]:
    """Return the query of the time at which a lease of now expires."""
    return select(lease_time(lease_s) + timedelta(seconds=lease_s)).scalar_subquery()


def read_lease_clock(session: Session, lease_s: float) -> None:
    """Advance the clock of leases; of many workers that call this at once, one changes its row."""
    unread = func.clock_timestamp() - LeaseClock.read_at
    due = or_(unread < timedelta(), unread > timedelta(seconds=lease_s / 30))
    session.execute(
        update(LeaseClock)
        .where(due)
        .values(time=lease_time(lease_s), read_at=func.clock_timestamp())
        .execution_options(synchronize_session=False)
    )


def requeue_stale(sessions: Sessions, *, lease_s: float = DEFAULT_LEASE_S, limit: int = 100) -> list[Requeued]:
    """Count a failed attempt for all work whose lease has expired, and queue it again or end it; return the new states.

    An attempt whose last heartbeat is older than the database's start counts as none: the machine, the container engine
    or the service was restarted, with the worker. Neither does one of another generation: the database was restored.
    Several workers may do so at once: each row is processed by one.
    """
    done = []
    with one_statement(sessions) as session:
        read_lease_clock(session, lease_s)
    now = select(lease_time(lease_s)).scalar_subquery()
    for model in WORK.values():
        restored = model.lease_generation.is_distinct_from(generation())
        expired = and_(model.state.in_(LEASED), or_(model.lease_expires_at < now, restored))
        with sessions() as session:
            stale = session.scalars(select(model.id).where(expired).order_by(model.lease_expires_at).limit(limit)).all()
        for work_id in stale:
            with sessions.begin() as session:
                work = lock(session, cast("type[Job]", model), work_id, expired, skip_locked=True)
                if work is not None:
                    reason, counts = f"lease of worker {work.lease_owner} expired", True
                    if session.scalar(select(restored).where(model.id == work.id)):
                        what = "service was upgraded" if work.lease_generation is None else "database was restored"
                        reason, counts = f"the {what}", False
                    elif session.scalar(
                        select(model.heartbeat_at < func.pg_postmaster_start_time()).where(model.id == work.id)
                    ):
                        reason, counts = f"the service was restarted, and with it worker {work.lease_owner}", False
                    state = _lose(session, work, reason, counts=counts)
                    done.append(Requeued(work.kind, work.id, state))
    return done


def record_notification_failure(sessions: Sessions, job_id: str, error: str) -> None:
    """Record that the broker could not be reached for the wake-up message of a job."""
    with sessions.begin() as session:
        job = lock(session, Job, job_id)
        if job is not None:
            message = "the broker could not be reached; the job waits until a free worker polls the queue"
            add_event(session, job, "notification_failed", message, {"error": error})
