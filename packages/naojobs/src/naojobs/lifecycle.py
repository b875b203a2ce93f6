"""The life of a job: every change of its state, each one small transaction.

All functions take a session maker and commit on their own. Changes are conditional UPDATEs, so that of two
parties that race one wins and the other hears of it. Times come from the database's clock, never from a host's.
Events of a job are written under the lock on its row, so their ids ascend in the order of their commits.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from naospec import PRESETS, EvaluationSpec, TrainingSpec
from pydantic import ValidationError
from sqlalchemy import ColumnElement, and_, func, select, update
from sqlalchemy.dialects.postgresql import insert
from sqlalchemy.orm import Session, sessionmaker

from naojobs.database import notify
from naojobs.errors import ConflictError, InvalidError, LeaseLostError, NotFoundError, QuotaError
from naojobs.ids import new_id
from naojobs.models import Checkpoint, Evaluation, Event, Job, Metric
from naojobs.schemas import MAX_GROUP_SIZE, GroupCreate, JobCreate
from naojobs.states import ENDED, LEASED, OPEN, JobState, can_become

Sessions = sessionmaker[Session]

#: Seconds after a heartbeat at which a lease is stale.
DEFAULT_LEASE_S = 30.0


@dataclass(frozen=True, slots=True)
class Lease:
    """Is a worker's right to write to a job; `attempt` fences it off once another worker has claimed the job."""

    job_id: str
    owner: str
    attempt: int


@dataclass(frozen=True, slots=True)
class CheckpointRef:
    """Points to a recorded checkpoint."""

    id: str
    job_id: str
    step: int
    key: str
    manifest: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Claim:
    """Is what a worker gets to know with the lease: what to do and where to start from."""

    lease: Lease
    name: str
    spec: TrainingSpec
    evaluation: EvaluationSpec | None
    #: The job's own newest checkpoint, to continue from.
    resume_from: CheckpointRef | None
    #: The checkpoint of another job to take the initial policy from; none when there is something to resume.
    initial_policy: CheckpointRef | None


@dataclass(frozen=True, slots=True)
class Orders:
    """Is what a heartbeat brings back."""

    state: JobState
    cancel: bool
    pause: bool


@dataclass(frozen=True, slots=True)
class Requeued:
    """Tells what the reaper did to one job."""

    job_id: str
    queue: str
    state: JobState


def _held_by(lease: Lease) -> ColumnElement[bool]:
    """Return the condition under which `lease` is still good."""
    return and_(Job.id == lease.job_id, Job.lease_owner == lease.owner, Job.attempt == lease.attempt)


def _add_event(session: Session, job: Job, kind: str, message: str, data: Mapping[str, Any] | None = None) -> None:
    session.add(Event(job_id=job.id, kind=kind, attempt=job.attempt, message=message, data=dict(data or {})))
    notify(session, job.id)


def _locked(session: Session, job_id: str) -> Job:
    job = session.scalar(select(Job).where(Job.id == job_id).with_for_update())
    if job is None:
        raise NotFoundError(f"no job {job_id}")
    return job


def _release(job: Job) -> None:
    job.lease_owner = None
    job.lease_expires_at = None


def _enqueue(job: Job) -> None:
    _release(job)
    job.state = JobState.QUEUED
    job.queued_at = func.now()
    job.rung_at = None
    job.finished_at = None
    job.pause_requested = False


def _touch(job: Job) -> None:
    job.updated_at = func.now()


def _change(job: Job, target: JobState) -> None:
    if not can_become(job.state, target):
        raise ConflictError(f"job {job.id} is {job.state} and cannot become {target}")
    if target is JobState.QUEUED:
        _enqueue(job)
    else:
        job.state = target
    if target not in LEASED:
        _release(job)
    if target in ENDED:
        job.finished_at = func.now()
        job.cancel_requested = False
        job.pause_requested = False
    if target is JobState.PAUSED:
        job.pause_requested = False
    _touch(job)


# --- what users ask for ---------------------------------------------------------------------------------------------


def submit(
    sessions: Sessions,
    request: JobCreate,
    *,
    owner: str,
    idempotency_key: str | None = None,
    max_open_jobs: int | None = None,
    see_all: bool = False,
) -> tuple[Job, bool]:
    """Queue a new job of `owner`; return it and whether it is new.

    The same `idempotency_key` with the same request returns the job that is already there.

    Raises:
        ConflictError: the key came before with another request.
        InvalidError: the parent job or checkpoint does not exist or does not fit; `see_all` allows others' jobs.
        QuotaError: `owner` has `max_open_jobs` open jobs.
    """
    with sessions.begin() as session:
        job, created = _submit(session, request, owner, idempotency_key, max_open_jobs, see_all, group_id=None)
    return job, created


def submit_group(
    sessions: Sessions,
    request: GroupCreate,
    *,
    owner: str,
    idempotency_key: str | None = None,
    max_open_jobs: int | None = None,
    see_all: bool = False,
) -> tuple[str, list[Job], bool]:
    """Queue one job for each seed and combination of grid values; all or none.

    Return the group's id, its jobs and whether they are new. Raises as `submit` does, and InvalidError for a
    combination that the specification refuses or a group of more than `MAX_GROUP_SIZE` jobs.
    """
    requests = expand_group(request)
    with sessions.begin() as session:
        group_id = new_id("group")
        jobs = []
        new = False
        for number, item in enumerate(requests):
            key = None if idempotency_key is None else f"{idempotency_key}#{number}"
            job, created = _submit(session, item, owner, key, max_open_jobs, see_all, group_id=group_id)
            new = new or created
            if not created:
                group_id = job.group_id or group_id
            jobs.append(job)
    return group_id, jobs, new


def expand_group(request: GroupCreate) -> list[JobCreate]:
    """Return the jobs that a group stands for. Raises InvalidError."""
    axes: dict[str, Sequence[Any]] = dict(request.grid)
    if request.seeds:
        if "seed" in axes:
            raise InvalidError("give the seeds in `seeds` or in `grid`, not in both", "seeds")
        axes["seed"] = request.seeds
    if not axes:
        raise InvalidError("name at least one seed in `seeds` or one field in `grid`", "seeds")
    for name in axes:
        if name not in TrainingSpec.model_fields:
            raise InvalidError(f"the training specification has no field {name!r}", f"grid.{name}")
    size = 1
    for values in axes.values():
        size *= len(values)
    if size > MAX_GROUP_SIZE:
        raise InvalidError(f"{size} jobs are more than {MAX_GROUP_SIZE}; give fewer values", "grid")
    base = _wishes(request.job.spec)
    jobs = []
    for values in itertools.product(*axes.values()):
        point = dict(zip(axes, values, strict=True))
        label = ",".join(f"{name}={value}" for name, value in point.items())
        try:
            spec = TrainingSpec.model_validate({**base, **point})
        except ValidationError as error:
            first = error.errors()[0]
            field = ".".join(str(part) for part in first["loc"]) or next(iter(point))
            raise InvalidError(f"{label}: {first['msg']}", f"grid.{field}") from error
        # without blanks, so that it can be typed as it stands
        apart = "".join(f"-{name}-{value}" for name, value in point.items()).replace(" ", "")
        name = f"{request.job.display_name()}{apart}"[:200]
        jobs.append(request.job.model_copy(update={"spec": spec, "name": name}))
    return jobs


def _wishes(spec: TrainingSpec) -> dict[str, Any]:
    """Return `spec` without what preset and task decide, so that another preset or task can decide it anew."""
    wishes = spec.model_dump(mode="json", exclude=set(PRESETS[spec.preset]) - set(spec.departures()))
    if spec.min_height == spec.task_definition.min_height_m:
        del wishes["min_height"]
    return wishes


def _digest(request: JobCreate) -> str:
    text = json.dumps(request.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _submit(
    session: Session,
    request: JobCreate,
    owner: str,
    idempotency_key: str | None,
    max_open_jobs: int | None,
    see_all: bool,
    group_id: str | None,
) -> tuple[Job, bool]:
    digest = _digest(request) if idempotency_key is not None else None
    if idempotency_key is not None:
        earlier = session.scalar(
            select(Job).where(Job.owner == owner, Job.idempotency_key == idempotency_key),
        )
        if earlier is not None:
            return _same_request(earlier, digest), False
    if max_open_jobs is not None:
        # Two submits at once must not both see the last free place.
        session.execute(select(func.pg_advisory_xact_lock(func.hashtextextended(f"quota:{owner}", 0))))
        open_jobs = session.scalar(
            select(func.count()).select_from(Job).where(Job.owner == owner, Job.state.in_(OPEN)),
        )
        if (open_jobs or 0) >= max_open_jobs:
            raise QuotaError(
                f"{owner} has {open_jobs} open jobs, the most that are allowed; wait until some end, or cancel some",
            )
    _check_parent(session, request, owner, see_all)
    job_id = session.scalar(
        insert(Job)
        .values(
            id=new_id("job"),
            name=request.display_name(),
            owner=owner,
            tags=list(dict.fromkeys(request.tags)),
            spec=request.spec.model_dump(mode="json"),
            evaluation=request.evaluation.model_dump(mode="json") if request.evaluation else None,
            queue=request.spec.simulator,
            priority=request.priority,
            state=JobState.QUEUED,
            max_attempts=request.max_attempts,
            parent_job_id=request.parent_job_id,
            parent_checkpoint_id=request.parent_checkpoint_id,
            group_id=group_id,
            idempotency_key=idempotency_key,
            idempotency_digest=digest,
            total_steps=request.spec.planned_steps,
            queued_at=func.now(),
        )
        .on_conflict_do_nothing(index_elements=[Job.owner, Job.idempotency_key])
        .returning(Job.id),
    )
    if job_id is None:  # another request with the same key was faster
        earlier = session.scalar(select(Job).where(Job.owner == owner, Job.idempotency_key == idempotency_key))
        if earlier is None:
            raise ConflictError("a job with this key was deleted just now; send the request again", "Idempotency-Key")
        return _same_request(earlier, digest), False
    job = _locked(session, job_id)
    _add_event(session, job, "queued", "submitted", {"owner": owner})
    return job, True


def _same_request(earlier: Job, digest: str | None) -> Job:
    if earlier.idempotency_digest != digest:
        raise ConflictError(
            f"the key came before with another request, which made job {earlier.id}; use a new key",
            "Idempotency-Key",
        )
    return earlier


def _check_parent(session: Session, request: JobCreate, owner: str, see_all: bool) -> None:
    if request.parent_job_id is None:
        return
    parent = session.scalar(select(Job).where(Job.id == request.parent_job_id).with_for_update(key_share=True))
    if parent is None or (parent.owner != owner and not see_all):
        raise InvalidError(f"no job {request.parent_job_id}; take the id of a job of yours", "parent_job_id")
    theirs, ours = TrainingSpec.model_validate(parent.spec), request.spec
    if theirs.hidden_sizes != ours.hidden_sizes:
        raise InvalidError(
            f"the parent's policy has hidden_sizes {list(theirs.hidden_sizes)}, this job asks for "
            f"{list(ours.hidden_sizes)}; they must be the same",
            "spec.hidden_sizes",
        )
    if request.parent_checkpoint_id is not None:
        checkpoint = session.get(Checkpoint, request.parent_checkpoint_id)
        if checkpoint is None or checkpoint.job_id != parent.id:
            raise InvalidError(
                f"job {parent.id} has no checkpoint {request.parent_checkpoint_id}",
                "parent_checkpoint_id",
            )


def request_cancel(sessions: Sessions, job_id: str) -> Job:
    """Cancel a job that waits, or ask the worker of one that runs to stop; a second request changes nothing.

    Raises NotFoundError, and ConflictError if the job has ended otherwise.
    """
    with sessions.begin() as session:
        job = _locked(session, job_id)
        if job.state is JobState.CANCELLED or (job.cancel_requested and job.state in LEASED):
            return job
        if job.state in LEASED:
            job.cancel_requested = True
            _touch(job)
            _add_event(session, job, "cancel_requested", "asked the worker to stop")
        elif can_become(job.state, JobState.CANCELLED):
            _change(job, JobState.CANCELLED)
            _add_event(session, job, "cancelled", "cancelled before a worker had it")
        else:
            raise ConflictError(f"job {job_id} has already {job.state}; there is nothing to cancel")
        session.flush()
        session.refresh(job)
    return job


def request_pause(sessions: Sessions, job_id: str) -> Job:
    """Pause a job that waits, or ask the worker of one that trains to write a checkpoint and stop.

    Raises NotFoundError, and ConflictError if the job is evaluating or has ended.
    """
    with sessions.begin() as session:
        job = _locked(session, job_id)
        if job.state in (JobState.PAUSING, JobState.PAUSED):
            return job
        if job.state in (JobState.STARTING, JobState.RUNNING):
            job.pause_requested = True
            _change(job, JobState.PAUSING)
            _add_event(session, job, "pause_requested", "asked the worker to write a checkpoint and stop")
        elif job.state is JobState.QUEUED:
            _change(job, JobState.PAUSED)
            _add_event(session, job, "paused", "paused before a worker had it")
        elif job.state is JobState.EVALUATING:
            raise ConflictError(f"job {job_id} is evaluating, which cannot be paused; let it end, or cancel it")
        else:
            raise ConflictError(f"job {job_id} has already {job.state}; there is nothing to pause")
        session.flush()
        session.refresh(job)
    return job


def resume(sessions: Sessions, job_id: str) -> Job:
    """Queue a paused job again; it goes on from its last checkpoint.

    Raises NotFoundError, and ConflictError if the job is not paused.
    """
    with sessions.begin() as session:
        job = _locked(session, job_id)
        if job.state is JobState.PAUSING:
            raise ConflictError(f"job {job_id} is still pausing; try again when its state is paused")
        if job.state in (JobState.FAILED, JobState.CANCELLED):
            raise ConflictError(f"job {job_id} is {job.state}, not paused; use retry")
        if job.state is not JobState.PAUSED:
            raise ConflictError(f"job {job_id} is {job.state}; only a paused job can be resumed")
        _change(job, JobState.QUEUED)
        _add_event(session, job, "queued", "resumed by a user")
        session.flush()
        session.refresh(job)
    return job


def retry(sessions: Sessions, job_id: str) -> Job:
    """Queue a failed or cancelled job again, with all its attempts; it goes on from its last checkpoint.

    Raises NotFoundError, and ConflictError if the job has not failed and is not cancelled.
    """
    with sessions.begin() as session:
        job = _locked(session, job_id)
        if job.state not in (JobState.FAILED, JobState.CANCELLED):
            hint = "use resume" if job.state is JobState.PAUSED else "submit a new job to train again"
            raise ConflictError(f"job {job_id} is {job.state}; only a failed or cancelled job can be retried; {hint}")
        _change(job, JobState.QUEUED)
        job.failures = 0
        job.error = None
        _add_event(session, job, "queued", "retried by a user")
        session.flush()
        session.refresh(job)
    return job


def delete(sessions: Sessions, job_id: str) -> None:
    """Delete a job that nobody works on, with all its rows; its artifacts are the caller's to delete afterwards.

    Raises NotFoundError, and ConflictError if the job is open, or if an open job starts from its policy.
    """
    with sessions.begin() as session:
        job = _locked(session, job_id)
        if job.state not in ENDED:
            raise ConflictError(f"job {job_id} is {job.state}; cancel it first")
        child = session.scalar(select(Job.id).where(Job.parent_job_id == job_id, Job.state.in_(OPEN)).limit(1))
        if child is not None:
            raise ConflictError(f"job {child} starts from the policy of job {job_id}; let it end, or cancel it")
        session.delete(job)
        notify(session, job_id, deleted_from=job.owner)


# --- what workers do ------------------------------------------------------------------------------------------------


def claim(sessions: Sessions, job_id: str, worker: str, *, lease_s: float = DEFAULT_LEASE_S) -> Claim | None:
    """Take a queued job for `worker`; of all who try, exactly one gets it and the others get none.

    The attempt is counted up, which fences off every earlier worker of the job.
    """
    with sessions.begin() as session:
        job = session.scalar(
            update(Job)
            .where(Job.id == job_id, Job.state == JobState.QUEUED)
            .values(
                state=JobState.STARTING,
                attempt=Job.attempt + 1,
                lease_owner=worker,
                lease_expires_at=func.now() + timedelta(seconds=lease_s),
                heartbeat_at=func.now(),
                started_at=func.coalesce(Job.started_at, func.now()),
                updated_at=func.now(),
            )
            .returning(Job)
            .execution_options(synchronize_session=False, populate_existing=True),
        )
        if job is None:
            return None
        _add_event(session, job, "claimed", f"claimed by {worker}", {"worker": worker})
        own = newest_checkpoint(session, job.id)
        parent = None
        if own is None and job.parent_checkpoint_id is not None:
            parent = session.get(Checkpoint, job.parent_checkpoint_id)
        elif own is None and job.parent_job_id is not None:
            # From now on this one is the parent, for every attempt: the lock and the reference keep it from being
            # pruned by the parent job, which may still run.
            session.execute(select(Job.id).where(Job.id == job.parent_job_id).with_for_update(key_share=True))
            parent = newest_checkpoint(session, job.parent_job_id)
            job.parent_checkpoint_id = parent.id if parent is not None else None
        return Claim(
            lease=Lease(job.id, worker, job.attempt),
            name=job.name,
            spec=TrainingSpec.model_validate(job.spec),
            evaluation=EvaluationSpec.model_validate(job.evaluation) if job.evaluation else None,
            resume_from=_ref(own),
            initial_policy=_ref(parent),
        )


def newest_checkpoint(session: Session, job_id: str) -> Checkpoint | None:
    """Return the checkpoint of `job_id` with the most steps, of the latest attempt where two have the same."""
    return session.scalar(
        select(Checkpoint)
        .where(Checkpoint.job_id == job_id)
        .order_by(Checkpoint.step.desc(), Checkpoint.attempt.desc())
        .limit(1),
    )


def _ref(checkpoint: Checkpoint | None) -> CheckpointRef | None:
    if checkpoint is None:
        return None
    return CheckpointRef(checkpoint.id, checkpoint.job_id, checkpoint.step, checkpoint.key, checkpoint.manifest)


def heartbeat(sessions: Sessions, lease: Lease, *, lease_s: float = DEFAULT_LEASE_S) -> Orders:
    """Renew `lease` and return what users have asked for meanwhile.

    Raises LeaseLostError if the job was given to another or taken back.
    """
    with sessions.begin() as session:
        row = session.execute(
            update(Job)
            .where(_held_by(lease))
            .values(heartbeat_at=func.now(), lease_expires_at=func.now() + timedelta(seconds=lease_s))
            .returning(Job.state, Job.cancel_requested, Job.pause_requested),
        ).one_or_none()
    if row is None:
        raise LeaseLostError(f"job {lease.job_id} is no longer leased to {lease.owner} (attempt {lease.attempt})")
    return Orders(JobState(row.state), cancel=row.cancel_requested, pause=row.pause_requested)


def hold(session: Session, lease: Lease) -> Job:
    """Lock the row of a leased job for the rest of the transaction. Raises LeaseLostError."""
    job = session.scalar(select(Job).where(_held_by(lease)).with_for_update())
    if job is None:
        raise LeaseLostError(f"job {lease.job_id} is no longer leased to {lease.owner} (attempt {lease.attempt})")
    return job


def transition(
    sessions: Sessions,
    lease: Lease,
    target: JobState,
    *,
    message: str = "",
    error: str | None = None,
    data: Mapping[str, Any] | None = None,
) -> JobState:
    """Turn a leased job into `target`; return the state it had.

    The lease ends with every state that no worker holds. To go back to `queued` without counting a lost attempt
    (a worker that is told to stop), this is the function; a lost trainer goes through `lose`.

    Raises LeaseLostError, and ConflictError if the table of transitions does not allow it.
    """
    with sessions.begin() as session:
        job = hold(session, lease)
        source = JobState(job.state)
        if source is target:
            return source
        _change(job, target)
        if error is not None:
            job.error = error
        elif target is JobState.SUCCEEDED:
            job.error = None
            job.failures = 0
        _add_event(session, job, str(target), message or error or f"{source} -> {target}", data)
    return source


def begin(sessions: Sessions, lease: Lease, *, step: int, resumed_from: str | None = None) -> None:
    """Say that the trainer starts at `step`: everything measured beyond it will be measured again.

    Metrics rows beyond `step` are dropped, so that no step is there twice and none of a lost attempt remains.
    Raises LeaseLostError.
    """
    with sessions.begin() as session:
        job = hold(session, lease)
        dropped = session.query(Metric).where(Metric.job_id == job.id, Metric.step > step).delete()
        newest = session.scalar(
            select(Metric).where(Metric.job_id == job.id).order_by(Metric.step.desc()).limit(1),
        )
        job.progress_step = step
        job.latest_metrics = newest.values if newest is not None else {}
        _touch(job)
        message = f"starts at step {step}" if resumed_from is None else f"goes on from step {step}"
        _add_event(
            session,
            job,
            "started" if resumed_from is None else "resumed",
            message,
            {"step": step, "checkpoint_id": resumed_from, "dropped_metrics": dropped},
        )


def lose(sessions: Sessions, lease: Lease, reason: str) -> JobState:
    """Count a lost attempt (the trainer died) and queue the job again, or end it when that was the last.

    A job that a user wants cancelled or paused ends so instead. Return the new state. Raises LeaseLostError.
    """
    with sessions.begin() as session:
        job = hold(session, lease)
        return _lose(session, job, reason)


def _lose(session: Session, job: Job, reason: str) -> JobState:
    job.failures += 1
    job.error = reason
    if job.cancel_requested:
        target, message = JobState.CANCELLED, f"{reason}; cancelled as asked"
    elif job.state is JobState.PAUSING:
        target, message = JobState.PAUSED, f"{reason}; paused as asked, at its last checkpoint"
    elif job.failures >= job.max_attempts:
        target, message = JobState.FAILED, f"{reason}; that was attempt {job.failures} of {job.max_attempts}"
        job.error = message
    else:
        target = JobState.QUEUED
        message = f"{reason}; queued again after attempt {job.failures} of {job.max_attempts}"
    _change(job, target)
    _add_event(session, job, str(target), message, {"reason": reason, "failures": job.failures})
    return target


def cut_leases(sessions: Sessions, longest_s: float) -> None:
    """Cut every lease of a job or an evaluation to `longest_s`.

    A longer one comes from before the database's clock was set back, and would keep what a dead worker held until the
    clock has caught up.
    """
    longest = func.now() + timedelta(seconds=longest_s)
    with sessions.begin() as session:
        for held in (Job, Evaluation):
            session.execute(
                update(held)
                .where(held.lease_owner.is_not(None), held.lease_expires_at > longest)
                .values(lease_expires_at=longest)
                .execution_options(synchronize_session=False)
            )


def requeue_stale(sessions: Sessions, *, limit: int = 100) -> list[Requeued]:
    """Take back every job whose lease has run out (the reaper); return what became of each.

    Several reapers may run at once: each row is taken by one.
    """
    done = []
    with sessions.begin() as session:
        stale = session.scalars(
            select(Job)
            .where(Job.state.in_(LEASED), Job.lease_expires_at < func.now())
            .order_by(Job.lease_expires_at)
            .limit(limit)
            .with_for_update(skip_locked=True),
        ).all()
        for job in stale:
            state = _lose(session, job, f"worker {job.lease_owner} was not heard of in time")
            done.append(Requeued(job.id, job.queue, state))
    return done


def mark_rung(sessions: Sessions, job_id: str, error: str | None = None) -> None:
    """Note that the doorbell was rung for a job, or (with `error`) that the broker could not be reached."""
    with sessions.begin() as session:
        if error is None:
            session.execute(
                update(Job).where(Job.id == job_id, Job.state == JobState.QUEUED).values(rung_at=func.now()),
            )
            return
        job = session.scalar(select(Job).where(Job.id == job_id).with_for_update())
        if job is not None:
            _add_event(
                session,
                job,
                "doorbell_failed",
                "the broker could not be reached; the job stays queued and is announced again",
                {"error": error},
            )
