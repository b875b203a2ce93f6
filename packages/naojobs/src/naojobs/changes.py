"""State of work and its history: the only place that changes a state, and what every change writes beside it.

The state of a piece of work changes only in `change`, which checks it against `naojobs.states.TRANSITIONS`, under a
lock on its row. Times come from the database's clock, never from a host's. Events are written under the lock on the
job's row, so their ids ascend in the order of their commits; a function that locks an evaluation's row and writes an
event locks the job's row first.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from naojobs.database import notify
from naojobs.errors import ConflictError, public
from naojobs.models import AnyWork, Evaluation, Event, Job, Log, Match, MatchEvent
from naojobs.states import ENDED, LEASED, WorkState, can_become
from naojobs.webhooks import MessageType, publish

MAX_LOG_CHARS = 8_000
"""Longer lines of a log are truncated."""

W = TypeVar("W", Job, Evaluation, Match)


def change(work: AnyWork, target: WorkState) -> None:
    """Change the state of a locked row and all columns that depend on it. Raises ConflictError."""
    if not can_become(work.state, target):
        raise ConflictError(f"{work.kind} {work.id} is {work.state} and cannot become {target}")
    work.state = target
    work.updated_at = func.now()
    if work.postponed:  # any change ends the wait for a service; the user's own time stays
        work.not_before = None
    if isinstance(work, Job) and (target is WorkState.EVALUATING or target not in LEASED):
        work.yields_to = None  # an evaluation makes no room, so another training has to
    if target not in LEASED:
        if isinstance(work, Match):
            work.live = None
        work.lease_owner = work.lease_generation = None
        work.lease_expires_at = None
        work.stalled_since = None
    if target is WorkState.QUEUED:
        work.queued_at = func.now()
        work.finished_at = None
    if target in ENDED:
        work.finished_at = func.now()
        work.cancel_requested = False


def add_event(session: Session, work: AnyWork, kind: str, message: str, data: Mapping[str, Any] | None = None) -> None:
    """Add an event to the job's history; the caller holds the lock on the job's row.

    Events of an evaluation are of kind `evaluation` and contain its id and state; its job counts as changed, so that
    followers of lists see its result. Those of a match have no data.
    """
    message = public(message)
    if isinstance(work, Evaluation):
        job = session.get_one(Job, work.job_id)
        job.updated_at = func.now()
        event = Event(
            job_id=work.job_id,
            kind="evaluation",
            attempt=job.attempt,
            message=f"evaluation {work.id}: {message}",
            data={**(data or {}), "evaluation_id": work.id, "state": str(work.state)},
        )
        session.add(event)
    elif isinstance(work, Job):
        event = Event(job_id=work.id, kind=kind, attempt=work.attempt, message=message, data=dict(data or {}))
        work.row_count += 1
        session.add(event)
    else:
        work.row_count += 1
        session.add(MatchEvent(match_id=work.id, kind=kind, attempt=work.attempt, message=message))
    notify(session, work.job_id)
    announce(session, work, kind)


def add_line(session: Session, work: AnyWork, level: str, text: str) -> None:
    """Add a line to the log of a locked job or match; evaluations have none."""
    if isinstance(work, Evaluation):
        return
    of_attempt = {"attempt": work.attempt, "message": public(text)[:MAX_LOG_CHARS]}
    if isinstance(work, Job):
        session.add(Log(job_id=work.id, level=level, **of_attempt))
    else:
        session.add(MatchEvent(match_id=work.id, kind=level, **of_attempt))
    work.row_count += 1


def announce(session: Session, work: AnyWork, kind: str) -> None:
    """Write the messages of an event to webhooks, if it is an end or the stall of a job."""
    ended = work.state in ENDED and kind == str(work.state)
    if not ended and (kind != "stalled" or not isinstance(work, Job)):
        return
    data: dict[str, Any]
    if isinstance(work, Match):
        teams, results = [team.get("name") for team in work.spec.get("teams", ())], work.summary or {}
        data = {"match_id": work.id, "teams": teams, "state": str(work.state), "error": work.error}
        data |= {name: results.get(name, 0) for name in ("games", "wins", "draws", "losses")}
        publish(session, work.owner, MessageType.MATCH_ENDED, data)
        return
    job = work if isinstance(work, Job) else session.get_one(Job, work.job_id)
    data = {"job_id": job.id, "name": job.name, "tags": job.tags, "group_id": job.group_id}
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
