"""What a worker records about a job: metrics, logs, events, checkpoints, evaluations.

Every write locks the job's row and checks the lease first, so a worker that lost it can write nothing more, and
sequence numbers of one job ascend in the order of their commits: a follower that continues after the last number
it has seen misses nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, cast

from naospec import EvaluationSpec
from sqlalchemy import CursorResult, func, insert, select, update
from sqlalchemy.dialects.postgresql import insert as upsert
from sqlalchemy.orm import Session

from naojobs.database import notify
from naojobs.errors import ConflictError, LeaseLostError, NotFoundError
from naojobs.ids import new_id
from naojobs.lifecycle import DEFAULT_LEASE_S, CheckpointRef, Lease, Sessions, hold, newest_checkpoint
from naojobs.models import METRICS_SEQ, Checkpoint, Evaluation, Event, Job, Log, Metric
from naojobs.states import EvaluationState

#: Longer messages are cut: a log line is for reading.
MAX_LOG_CHARS = 8_000


@dataclass(frozen=True, slots=True)
class LogLine:
    """Is one line of a log; `at` none means now."""

    level: str
    message: str
    at: datetime | None = None


def append_metrics(sessions: Sessions, lease: Lease, rows: Sequence[Mapping[str, float]]) -> None:
    """Record rows of figures, each with its `step`; writing a row again replaces it.

    Figures that are not finite are left out. Raises LeaseLostError, and ValueError for a row without a step.
    """
    if not rows:
        return
    values = {}
    for row in rows:
        if "step" not in row:
            raise ValueError("metrics row without step")
        figures = {name: float(value) for name, value in row.items() if math.isfinite(value)}
        values[int(row["step"])] = {
            "job_id": lease.job_id,
            "step": int(row["step"]),
            "attempt": lease.attempt,
            "time_s": figures.get("time_s"),
            "values": figures,
        }
    with sessions.begin() as session:
        job = hold(session, lease)
        statement = upsert(Metric)
        session.execute(
            statement.on_conflict_do_update(
                index_elements=[Metric.job_id, Metric.step],
                set_={
                    "attempt": statement.excluded.attempt,
                    "time_s": statement.excluded.time_s,
                    "values": statement.excluded["values"],
                    "seq": METRICS_SEQ.next_value(),
                },
                where=Metric.attempt <= statement.excluded.attempt,
            ),
            [values[step] for step in sorted(values)],
        )
        last = max(values)
        if last >= job.progress_step:
            job.progress_step = last
            job.latest_metrics = cast("dict[str, Any]", values[last]["values"])
        job.updated_at = func.now()
        notify(session, job.id)


def append_logs(sessions: Sessions, lease: Lease, lines: Sequence[LogLine]) -> None:
    """Record lines of the job's log, in this order. Raises LeaseLostError."""
    if not lines:
        return
    with sessions.begin() as session:
        hold(session, lease)
        _insert_logs(session, lease.job_id, lease.attempt, lines)


def _insert_logs(session: Session, job_id: str, attempt: int, lines: Sequence[LogLine]) -> None:
    for line in lines:
        # Postgres has no text with a zero byte in it.
        message = line.message.replace("\x00", "\N{REPLACEMENT CHARACTER}")[:MAX_LOG_CHARS]
        row: dict[str, Any] = {
            "job_id": job_id,
            "attempt": attempt,
            "level": line.level.lower()[:10],
            "message": message,
        }
        if line.at is not None:
            row["at"] = line.at
        session.execute(insert(Log).values(row))
    notify(session, job_id)


def record_event(
    sessions: Sessions,
    lease: Lease,
    kind: str,
    message: str,
    data: Mapping[str, Any] | None = None,
) -> None:
    """Record something that happened to a leased job. Raises LeaseLostError."""
    with sessions.begin() as session:
        job = hold(session, lease)
        session.add(Event(job_id=job.id, kind=kind, attempt=job.attempt, message=message, data=dict(data or {})))
        notify(session, job.id)


def record_checkpoint(
    sessions: Sessions,
    lease: Lease,
    *,
    step: int,
    key: str,
    manifest: Mapping[str, Any],
) -> str:
    """Record a checkpoint whose files and manifest are all in the store; return its id.

    Recording the same step of the same attempt again returns the id it has. Raises LeaseLostError.
    """
    with sessions.begin() as session:
        job = hold(session, lease)
        new: str | None = session.scalar(
            upsert(Checkpoint)
            .values(
                id=new_id("ckpt"),
                job_id=job.id,
                attempt=lease.attempt,
                step=step,
                key=key,
                manifest=dict(manifest),
            )
            .on_conflict_do_nothing(index_elements=[Checkpoint.job_id, Checkpoint.step, Checkpoint.attempt])
            .returning(Checkpoint.id),
        )
        if new is None:
            known: str = session.execute(
                select(Checkpoint.id).where(
                    Checkpoint.job_id == job.id,
                    Checkpoint.step == step,
                    Checkpoint.attempt == lease.attempt,
                ),
            ).scalar_one()
            return known
        session.add(
            Event(
                job_id=job.id,
                kind="checkpoint",
                attempt=job.attempt,
                message=f"checkpoint at step {step}",
                data={"checkpoint_id": new, "step": step},
            ),
        )
        notify(session, job.id)
        return new


def record_evaluation(
    sessions: Sessions,
    lease: Lease,
    *,
    checkpoint_id: str,
    spec: EvaluationSpec,
    summary: Mapping[str, Any],
    key: str,
    manifest: Mapping[str, Any],
    evaluation_id: str | None = None,
) -> str:
    """Record the evaluation at the end of a job, done under the job's own lease; return its id.

    Recording the same `evaluation_id` again returns it. Raises LeaseLostError.
    """
    with sessions.begin() as session:
        job = hold(session, lease)
        identifier = evaluation_id or new_id("eval")
        if session.get(Evaluation, identifier) is not None:
            return identifier
        session.add(
            Evaluation(
                id=identifier,
                job_id=job.id,
                checkpoint_id=checkpoint_id,
                state=EvaluationState.SUCCEEDED,
                spec=spec.model_dump(mode="json"),
                queue=spec.simulator or job.queue,
                attempt=1,
                summary=dict(summary),
                key=key,
                manifest=dict(manifest),
                finished_at=func.now(),
            ),
        )
        _evaluation_event(session, job.id, job.attempt, identifier, "succeeded", f"evaluation {identifier} is done")
    return identifier


def has_evaluation(sessions: Sessions, evaluation_id: str) -> bool:
    """Tell whether an evaluation is recorded."""
    with sessions() as session:
        return session.get(Evaluation, evaluation_id) is not None


def _evaluation_event(
    session: Session,
    job_id: str,
    attempt: int,
    evaluation_id: str,
    state: str,
    message: str,
) -> None:
    data = {"evaluation_id": evaluation_id, "state": state}
    session.add(Event(job_id=job_id, kind="evaluation", attempt=attempt, message=message, data=data))
    notify(session, job_id)


# --- evaluations that users ask for, with leases of their own ---------------------------------------------------------


@dataclass(frozen=True, slots=True)
class EvaluationClaim:
    """Is what a worker gets to know with the lease on an evaluation."""

    id: str
    owner: str
    attempt: int
    job_id: str
    checkpoint: CheckpointRef
    spec: EvaluationSpec


def request_evaluation(
    sessions: Sessions,
    job_id: str,
    *,
    checkpoint_id: str | None = None,
    spec: EvaluationSpec | None = None,
    max_open: int = 100,
) -> Evaluation:
    """Queue an evaluation of a checkpoint (the newest if none is named) of a job.

    Raises NotFoundError, and ConflictError if the job has no checkpoint yet or too many evaluations wait.
    """
    with sessions.begin() as session:
        job = session.scalar(select(Job).where(Job.id == job_id).with_for_update())
        if job is None:
            raise NotFoundError(f"no job {job_id}")
        if checkpoint_id is None:
            checkpoint = newest_checkpoint(session, job_id)
            if checkpoint is None:
                raise ConflictError(f"job {job_id} has no checkpoint yet; wait for the first", "checkpoint_id")
        else:
            checkpoint = session.get(Checkpoint, checkpoint_id)
            if checkpoint is None or checkpoint.job_id != job_id:
                raise NotFoundError(f"job {job_id} has no checkpoint {checkpoint_id}")
        waiting = session.scalar(
            select(func.count())
            .select_from(Evaluation)
            .where(
                Evaluation.job_id == job_id,
                Evaluation.state.in_([EvaluationState.QUEUED, EvaluationState.RUNNING]),
            ),
        )
        if (waiting or 0) >= max_open:
            raise ConflictError(f"{waiting} evaluations of job {job_id} wait already; let some end first")
        spec = spec or EvaluationSpec(task=job.spec["task"])
        evaluation = Evaluation(
            id=new_id("eval"),
            job_id=job_id,
            checkpoint_id=checkpoint.id,
            state=EvaluationState.QUEUED,
            spec=spec.model_dump(mode="json"),
            queue=spec.simulator or job.queue,
        )
        session.add(evaluation)
        session.flush()
        _evaluation_event(session, job.id, job.attempt, evaluation.id, "queued", "an evaluation was asked for")
        session.refresh(evaluation)
    return evaluation


def claim_evaluation(
    sessions: Sessions,
    evaluation_id: str,
    worker: str,
    *,
    lease_s: float = DEFAULT_LEASE_S,
) -> EvaluationClaim | None:
    """Take a queued evaluation for `worker`; exactly one of all who try gets it."""
    with sessions.begin() as session:
        row = session.scalar(
            update(Evaluation)
            .where(Evaluation.id == evaluation_id, Evaluation.state == EvaluationState.QUEUED)
            .values(
                state=EvaluationState.RUNNING,
                attempt=Evaluation.attempt + 1,
                lease_owner=worker,
                lease_expires_at=func.now() + timedelta(seconds=lease_s),
            )
            .returning(Evaluation)
            .execution_options(synchronize_session=False, populate_existing=True),
        )
        if row is None:
            return None
        checkpoint = session.get_one(Checkpoint, row.checkpoint_id)
        return EvaluationClaim(
            id=row.id,
            owner=worker,
            attempt=row.attempt,
            job_id=row.job_id,
            checkpoint=CheckpointRef(
                checkpoint.id, checkpoint.job_id, checkpoint.step, checkpoint.key, checkpoint.manifest
            ),
            spec=EvaluationSpec.model_validate(row.spec),
        )


def heartbeat_evaluation(sessions: Sessions, claim: EvaluationClaim, *, lease_s: float = DEFAULT_LEASE_S) -> None:
    """Renew the lease on an evaluation. Raises LeaseLostError (also when its job was deleted)."""
    with sessions.begin() as session:
        result = cast(
            "CursorResult[Any]",
            session.execute(
                update(Evaluation)
                .where(
                    Evaluation.id == claim.id,
                    Evaluation.lease_owner == claim.owner,
                    Evaluation.attempt == claim.attempt,
                )
                .values(lease_expires_at=func.now() + timedelta(seconds=lease_s)),
            ),
        )
        if result.rowcount != 1:
            raise LeaseLostError(f"evaluation {claim.id} is no longer leased to {claim.owner}")


def finish_evaluation(
    sessions: Sessions,
    claim: EvaluationClaim,
    *,
    summary: Mapping[str, Any] | None = None,
    key: str | None = None,
    manifest: Mapping[str, Any] | None = None,
    error: str | None = None,
) -> None:
    """End an evaluation with its figures and files, or with an error. Raises LeaseLostError."""
    if (error is None) == (summary is None):
        raise ValueError("give either summary, key and manifest, or error")
    with sessions.begin() as session:
        row = session.scalar(
            select(Evaluation)
            .where(
                Evaluation.id == claim.id,
                Evaluation.lease_owner == claim.owner,
                Evaluation.attempt == claim.attempt,
            )
            .with_for_update(),
        )
        if row is None:
            raise LeaseLostError(f"evaluation {claim.id} is no longer leased to {claim.owner}")
        row.state = EvaluationState.SUCCEEDED if error is None else EvaluationState.FAILED
        row.summary = dict(summary) if summary is not None else None
        row.key = key
        row.manifest = dict(manifest) if manifest is not None else None
        row.error = error
        row.lease_owner = None
        row.lease_expires_at = None
        row.finished_at = func.now()
        job = session.execute(select(Job).where(Job.id == row.job_id).with_for_update()).scalar_one()
        message = f"evaluation {row.id} is done" if error is None else f"evaluation {row.id} failed: {error}"
        _evaluation_event(session, job.id, job.attempt, row.id, str(row.state), message)


def release_evaluation(
    sessions: Sessions,
    claim: EvaluationClaim,
    reason: str,
    *,
    count: bool = True,
) -> EvaluationState:
    """Give a leased evaluation back to be done again; it fails when it was lost `max_attempts` times.

    Without `count` the attempt is not held against it (a worker that is told to stop). Return its new state.
    Raises LeaseLostError.
    """
    with sessions.begin() as session:
        row = session.scalar(
            select(Evaluation)
            .where(
                Evaluation.id == claim.id,
                Evaluation.lease_owner == claim.owner,
                Evaluation.attempt == claim.attempt,
            )
            .with_for_update(),
        )
        if row is None:
            raise LeaseLostError(f"evaluation {claim.id} is no longer leased to {claim.owner}")
        if not count:
            row.max_attempts += 1  # `attempt` fences off earlier workers, so it never goes back
        _take_back(row, reason)
        notify(session, row.job_id)
        return EvaluationState(row.state)


def _take_back(row: Evaluation, reason: str) -> None:
    if row.attempt >= row.max_attempts:
        row.state = EvaluationState.FAILED
        row.error = f"{reason}; that was attempt {row.attempt} of {row.max_attempts}"
        row.finished_at = func.now()
    else:
        row.state = EvaluationState.QUEUED
        row.rung_at = None
    row.lease_owner = None
    row.lease_expires_at = None


def requeue_stale_evaluations(sessions: Sessions, *, limit: int = 100) -> None:
    """Take back every evaluation whose lease has run out; it fails after `max_attempts`."""
    with sessions.begin() as session:
        for row in session.scalars(
            select(Evaluation)
            .where(Evaluation.state == EvaluationState.RUNNING, Evaluation.lease_expires_at < func.now())
            .limit(limit)
            .with_for_update(skip_locked=True),
        ).all():
            _take_back(row, f"worker {row.lease_owner} was not heard of in time")
            notify(session, row.job_id)


def waiting_evaluation(sessions: Sessions, queues: Sequence[str]) -> str | None:
    """Return the id of the evaluation that waits longest in one of `queues`; none if none waits."""
    with sessions() as session:
        return session.scalar(
            select(Evaluation.id)
            .where(Evaluation.state == EvaluationState.QUEUED, Evaluation.queue.in_(queues))
            .order_by(Evaluation.created_at)
            .limit(1),
        )
