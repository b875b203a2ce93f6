"""Requests of users about their work: cancel, pause, resume, retry, delete; each is one small transaction."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from naojobs import checkpoints
from naojobs.changes import W, add_event, change, lock
from naojobs.database import Sessions, notify
from naojobs.errors import ConflictError, NotFoundError
from naojobs.models import AnyWork, Checkpoint, Job, Match, PolicyRecord, PolicyVersion
from naojobs.quotas import NO_LIMITS, SPACE, Limits, Quota, require_room, wait_for_turn
from naojobs.states import ENDED, LEASED, OPEN, WorkState

R = TypeVar("R", Job, Match)


@contextmanager
def _locked(
    sessions: Sessions, model: type[W], work_id: str, limits: Limits = NO_LIMITS, *quotas: Quota
) -> Iterator[tuple[Session, W]]:
    """Lock a piece of work for a change, after which the row can be read. Raises NotFoundError.

    With quotas that the change will require, they come first.
    """
    with sessions.begin() as session:
        if quotas:
            owner = Job.owner if model is Job else Match.owner
            of_work = select(owner).where((Job.id if model is Job else Match.id) == work_id)
            wait_for_turn(session, session.scalar(of_work), limits, *quotas)
        work = lock(session, model, work_id)
        if work is None:
            raise NotFoundError(f"no {model.kind} {work_id}")
        yield session, work
        session.flush()
        session.refresh(work)


def request_cancel(sessions: Sessions, model: type[W], work_id: str) -> W:
    """Cancel waiting work, or ask the worker of running work to stop; a second request changes nothing.

    Raises NotFoundError, and ConflictError if the work has succeeded or failed.
    """
    with _locked(sessions, model, work_id) as (session, work):
        _cancel(session, work)
    return work


def _cancel(session: Session, work: AnyWork, why: str = "") -> bool:
    """Cancel locked work or ask its worker to stop; return whether that is new. Raises ConflictError."""
    reason = f": {why}" if why else ""
    if work.state is WorkState.CANCELLED or (work.cancel_requested and work.state in LEASED):
        return False
    if work.state in LEASED:
        work.cancel_requested = True
        work.updated_at = func.now()
        add_event(session, work, "cancel_requested", f"asked the worker to stop{reason}")
    elif work.state not in ENDED:
        change(work, WorkState.CANCELLED)
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
    with _locked(sessions, Job, job_id) as (session, job):
        if job.state in (WorkState.PAUSING, WorkState.PAUSED):
            return job
        if job.state in (WorkState.STARTING, WorkState.RUNNING):
            change(job, WorkState.PAUSING)
            add_event(session, job, "pause_requested", "asked the worker to write a checkpoint and stop")
        elif job.state is WorkState.QUEUED:
            change(job, WorkState.PAUSED)
            add_event(session, job, "paused", "paused before a worker claimed it")
        elif job.state is WorkState.EVALUATING:
            raise ConflictError(f"job {job_id} is evaluating, which cannot be paused; wait for its end, or cancel it")
        else:
            raise ConflictError(f"job {job_id} has already {job.state}; there is nothing to pause")
    return job


def resume(sessions: Sessions, job_id: str, *, limits: Limits = NO_LIMITS) -> Job:
    """Queue a paused job again; it resumes from its last checkpoint.

    Raises NotFoundError, ConflictError if the job is not paused, and QuotaError if its owner's jobs have as many rows
    as `limits` allow.
    """
    with _locked(sessions, Job, job_id, limits, Quota.ROWS) as (session, job):
        if job.state is WorkState.PAUSING:
            raise ConflictError(f"job {job_id} is still pausing; try again when its state is paused")
        if job.state in (WorkState.FAILED, WorkState.CANCELLED):
            raise ConflictError(f"job {job_id} is {job.state}, not paused; use retry")
        if job.state is not WorkState.PAUSED:
            raise ConflictError(f"job {job_id} is {job.state}; only a paused job can be resumed")
        require_room(session, job.owner, limits, Quota.ROWS)
        change(job, WorkState.QUEUED)
        add_event(session, job, "queued", "resumed by a user")
    return job


def retry(sessions: Sessions, model: type[R], work_id: str, *, limits: Limits = NO_LIMITS) -> R:
    """Queue a failed or cancelled job or match again, with all its attempts.

    A job resumes from its last checkpoint; of a match only the games are played that are not over.

    Raises NotFoundError, ConflictError if it has not failed and is not cancelled, and QuotaError if its owner has as
    many open jobs, bytes or rows as `limits` allow.
    """
    with _locked(sessions, model, work_id, limits, Quota.OPEN_JOBS, *SPACE) as (session, work):
        if work.state not in (WorkState.FAILED, WorkState.CANCELLED):
            what = f"only a failed or cancelled {work.kind} can be retried"
            hint = "use resume" if work.state is WorkState.PAUSED else f"submit a new {work.kind} instead"
            raise ConflictError(f"{work.kind} {work_id} is {work.state}; {what}; {hint}")
        require_room(session, work.owner, limits, Quota.OPEN_JOBS, *SPACE)
        change(work, WorkState.QUEUED)
        work.failures = work.postponed = 0
        work.error = None
        if isinstance(work, Job):
            work.pruned = None
        add_event(session, work, "queued", "retried by a user")
    return work


def delete_match(sessions: Sessions, match_id: str) -> None:
    """Delete a match that has ended; the caller deletes its logs afterwards. Raises NotFoundError, ConflictError."""
    with sessions.begin() as session:
        match = lock(session, Match, match_id)
        if match is None:
            raise NotFoundError(f"no match {match_id}")
        if match.state not in ENDED:
            raise ConflictError(f"match {match_id} is {match.state}; cancel it first")
        session.delete(match)


def delete(sessions: Sessions, job_id: str) -> None:
    """Delete an ended job with all its rows; the caller deletes its artifacts afterwards.

    Raises NotFoundError, and ConflictError if the job is open, if open work starts from its policy or plays with it, or
    if one of its checkpoints is a version of a registered policy.
    """
    with sessions.begin() as session:
        # Children before their parent, as a claim locks them: the deletion changes their rows, too.
        session.execute(select(Job.id).where(Job.parent_job_id == job_id).order_by(Job.id).with_for_update())
        job = lock(session, Job, job_id)
        if job is None:
            raise NotFoundError(f"no job {job_id}")
        if job.state not in ENDED:
            raise ConflictError(f"job {job_id} is {job.state}; cancel it first")
        starts_here = (Job.parent_job_id == job_id, Job.state.in_(OPEN))
        child = session.execute(select(Job.id, Job.owner).where(*starts_here).limit(1)).first()
        if child is not None:
            name = checkpoints.named("job", child.id, child.owner, job.owner)
            raise ConflictError(f"{name} starts from the policy of job {job_id}; wait for its end, or cancel it")
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
        users = checkpoints.in_use(session, job.owner)
        mine = session.scalars(select(Checkpoint.id).where(Checkpoint.job_id == job_id, Checkpoint.id.in_(users)))
        if (used := mine.first()) is not None:
            raise ConflictError(f"{users[used]} uses a checkpoint of job {job_id}; wait for its end, or cancel it")
        session.delete(job)
        notify(session, job_id, deleted_from=job.owner)
