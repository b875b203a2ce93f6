"""Records of leased work: metrics, log lines, events, checkpoints and results of evaluations.

Every write locks the job's row and checks the lease first, so a worker that lost it can write nothing more, and
sequence numbers of one job ascend in the order of their commits: a follower that resumes after the last number it has
read misses nothing.
"""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import timedelta
from typing import Any

from naospec import EvaluationSpec, stored
from sqlalchemy import BigInteger, Double, Integer, Interval, Text, bindparam, column, delete, func, insert, select
from sqlalchemy.dialects.postgresql import JSONB, Insert
from sqlalchemy.dialects.postgresql import insert as upsert
from sqlalchemy.orm import Session

from naojobs.capabilities import Requirements
from naojobs.changes import MAX_LOG_CHARS, add_event
from naojobs.database import Sessions, notify
from naojobs.errors import public
from naojobs.ids import new_id
from naojobs.leases import Lease, hold_as
from naojobs.models import METRICS_SEQ, Checkpoint, Evaluation, Job, Log, MetricsRecord
from naojobs.states import WorkState

_LOGGED_AT = func.statement_timestamp() - bindparam("age", type_=Interval)
_INSERT_LOG = insert(Log.__table__).values(at=_LOGGED_AT)  # type: ignore[arg-type]


def _upsert_metrics() -> Insert:
    """Return the statement that writes any number of rows: one for the server to run, and one text to send."""
    columns = column("step", BigInteger), column("time_s", Double), column("values", JSONB)
    row = func.jsonb_to_recordset(bindparam("rows", type_=JSONB)).table_valued(*columns).render_derived(with_types=True)
    own = bindparam("job_id", type_=Text), bindparam("attempt", type_=Integer)
    statement = upsert(MetricsRecord.__table__).from_select(  # type: ignore[arg-type]
        ["job_id", "attempt", "step", "time_s", "values"],
        select(*own, row.c.step, row.c.time_s, row.c["values"]).order_by(row.c.step),
    )
    return statement.on_conflict_do_update(
        index_elements=[MetricsRecord.job_id, MetricsRecord.step],
        set_={
            "attempt": statement.excluded.attempt,
            "time_s": statement.excluded.time_s,
            "values": statement.excluded["values"],
            "seq": METRICS_SEQ.next_value(),
        },
        where=MetricsRecord.attempt <= statement.excluded.attempt,
    )


_UPSERT_METRICS = _upsert_metrics()


@dataclass(frozen=True)
class LogLine:
    """Line for a job's log; its age when it is written, not its host's clock, gives its time."""

    level: str
    message: str
    made_s: float = field(default_factory=time.monotonic)
    """Time at which it was made, by this process's monotonic clock."""


@dataclass(frozen=True)
class MetricsRow:
    """Metrics of one update of the policy by name, with its environment step."""

    step: int
    values: Mapping[str, float]


@dataclass(frozen=True)
class EventRecord:
    """Event for a job's history."""

    kind: str
    message: str
    data: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class StoredCheckpoint:
    """Checkpoint whose files and manifest are all in the store."""

    step: int
    key: str
    manifest: Mapping[str, object]


@dataclass
class Batch:
    """Records of one transaction, in the order of reporting within each kind."""

    metrics: list[MetricsRow] = field(default_factory=list)
    logs: list[LogLine] = field(default_factory=list)
    events: list[EventRecord] = field(default_factory=list)
    checkpoints: list[StoredCheckpoint] = field(default_factory=list)
    id: str = field(default_factory=lambda: secrets.token_hex(8))
    """Distinguishes a repeated write, whose first commit may have succeeded unnoticed, from another batch."""

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.metrics) + len(self.logs) + len(self.events) + len(self.checkpoints)


def write(sessions: Sessions, lease: Lease, batch: Batch) -> dict[int, str]:
    """Write all records of `batch` for a leased job in one transaction; return the ids of its checkpoints by step.

    A repeated call replaces the metrics, keeps existing checkpoints and adds no log line or event again, if
    no other batch was written in between. Metrics that are not finite are left
    out. A new checkpoint supersedes the metrics that earlier attempts wrote beyond the step at which this one began.
    Raises LeaseLostError.
    """
    with sessions.begin() as session:
        job = hold_as(session, lease, Job)
        if batch.metrics:
            _write_metrics(session, job, batch.metrics)
        repeated, job.last_batch = job.last_batch == batch.id, batch.id
        if batch.logs and not repeated:
            session.execute(_INSERT_LOG, [_log_row(job, line) for line in batch.logs])
        for event in batch.events if not repeated else ():
            add_event(session, job, event.kind, event.message, event.data)
        ids = {stored.step: _write_checkpoint(session, job, stored) for stored in batch.checkpoints}
        job.row_count += len(batch.metrics) + (0 if repeated else len(batch.logs))
        notify(session, job.id)
    return ids


def append_logs(sessions: Sessions, lease: Lease, lines: Sequence[LogLine]) -> None:
    """Write lines of the job's log, in this order. Raises LeaseLostError."""
    if lines:
        write(sessions, lease, Batch(logs=list(lines)))


def _write_metrics(session: Session, job: Job, metrics: Sequence[MetricsRow]) -> None:
    rows = {
        row.step: {name: float(value) for name, value in row.values.items() if math.isfinite(value)} for row in metrics
    }
    ascending = [{"step": step, "time_s": rows[step].get("time_s"), "values": rows[step]} for step in sorted(rows)]
    session.execute(_UPSERT_METRICS, {"job_id": job.id, "attempt": job.attempt, "rows": ascending})
    last = max(rows)
    if last >= job.progress_step:
        job.progress_step = last
        job.latest_metrics = rows[last]
    job.updated_at = func.now()


def _log_row(job: Job, line: LogLine) -> dict[str, Any]:
    message = public(line.message)[:MAX_LOG_CHARS]
    level = line.level.lower()[:10]
    age = timedelta(seconds=time.monotonic() - line.made_s)
    return {"job_id": job.id, "attempt": job.attempt, "level": level, "message": message, "age": age}


def _write_checkpoint(session: Session, job: Job, stored: StoredCheckpoint) -> str:
    same = {"job_id": job.id, "step": stored.step, "attempt": job.attempt}
    furthest = session.scalar(select(func.max(Checkpoint.step)).where(Checkpoint.job_id == job.id))
    new: str | None = session.scalar(
        upsert(Checkpoint)
        .values(id=new_id("ckpt"), key=stored.key, manifest=dict(stored.manifest), size=_size(stored.manifest), **same)
        .on_conflict_do_nothing(index_elements=[Checkpoint.job_id, Checkpoint.step, Checkpoint.attempt])
        .returning(Checkpoint.id),
    )
    if new is None:
        return session.execute(select(Checkpoint.id).filter_by(**same)).scalar_one()
    if stored.step > job.began_step:
        _drop_superseded(session, job)
    if furthest is None or stored.step > furthest:  # the attempts so far have made progress
        job.failures = job.postponed = 0
    message = f"checkpoint at step {stored.step}"
    add_event(session, job, "checkpoint", message, {"checkpoint_id": new, "step": stored.step})
    return new


def _size(manifest: Mapping[str, Any]) -> int:
    """Return the bytes of all files of a manifest."""
    return sum(int(file["size"]) for file in manifest["files"])


def _drop_superseded(session: Session, job: Job) -> None:
    """Delete the metrics of earlier attempts beyond the step at which this one began."""
    beyond = (MetricsRecord.job_id == job.id, MetricsRecord.attempt < job.attempt, MetricsRecord.step > job.began_step)
    session.execute(delete(MetricsRecord).where(*beyond))


# --- evaluations ------------------------------------------------------------------------------------------------------


def record_result(
    sessions: Sessions, lease: Lease, *, summary: Mapping[str, Any], key: str, manifest: Mapping[str, Any]
) -> None:
    """Write the result of a leased evaluation; it counts once the evaluation has succeeded. Raises LeaseLostError."""
    with sessions.begin() as session:
        evaluation = hold_as(session, lease, Evaluation)
        evaluation.summary = dict(summary)
        evaluation.key = key
        evaluation.manifest = dict(manifest)
        evaluation.size = _size(manifest)
        evaluation.updated_at = func.now()


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
    """Write the evaluation at the end of a job, done under the job's own lease; return its id.

    The same `evaluation_id` is written once. Raises LeaseLostError.
    """
    with sessions.begin() as session:
        job = hold_as(session, lease, Job)
        identifier = evaluation_id or new_id("eval")
        if session.get(Evaluation, identifier) is not None:
            return identifier
        evaluation = Evaluation(
            id=identifier,
            job_id=job.id,
            checkpoint_id=checkpoint_id,
            state=WorkState.SUCCEEDED,
            spec=stored(spec),
            **asdict(Requirements.of_evaluation(spec, job)),
            attempt=1,
            summary=dict(summary),
            key=key,
            manifest=dict(manifest),
            size=_size(manifest),
            finished_at=func.now(),
        )
        session.add(evaluation)
        session.flush()
        add_event(session, evaluation, "succeeded", "done")
    return identifier


def has_evaluation(sessions: Sessions, evaluation_id: str) -> bool:
    """Return whether an evaluation is recorded."""
    with sessions() as session:
        return session.get(Evaluation, evaluation_id) is not None


# --- reading ----------------------------------------------------------------------------------------------------------


def job_name(sessions: Sessions, job_id: str) -> str:
    """Return a job's name."""
    with sessions() as session:
        return session.execute(select(Job.name).where(Job.id == job_id)).scalar_one()


def metrics_steps(sessions: Sessions, job_id: str) -> set[int]:
    """Return the steps of a job's rows of metrics."""
    with sessions() as session:
        return set(session.scalars(select(MetricsRecord.step).where(MetricsRecord.job_id == job_id)))


def metrics_until(sessions: Sessions, job_id: str, step: int) -> Iterator[dict[str, Any]]:
    """Yield a job's rows of metrics up to and including `step`, in order."""
    rows = (
        select(MetricsRecord.values)
        .where(MetricsRecord.job_id == job_id, MetricsRecord.step <= step)
        .order_by(MetricsRecord.step)
    )
    with sessions() as session:
        yield from session.scalars(rows.execution_options(yield_per=500))
