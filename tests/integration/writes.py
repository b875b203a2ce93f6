"""Rows that a worker writes in batches, one at a time, and rows that the database refuses to change."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from naojobs.database import Sessions
from naojobs.leases import Lease
from naojobs.models import Evaluation
from naojobs.records import Batch, EventRecord, MetricsRow, StoredCheckpoint, write
from naojobs.submission import EvaluationRequest, submit_evaluation
from sqlalchemy import text


def append_metrics(sessions: Sessions, lease: Lease, rows: Sequence[Mapping[str, float]]) -> None:
    """Write rows of metrics, each with its `step`. Raises LeaseLostError, and ValueError for a row without a step."""
    if any("step" not in row for row in rows):
        raise ValueError("metrics row without step")
    write(sessions, lease, Batch(metrics=[MetricsRow(int(row["step"]), row) for row in rows]))


def record_event(
    sessions: Sessions, lease: Lease, kind: str, message: str, data: Mapping[str, object] | None = None
) -> None:
    """Write an event of a leased job. Raises LeaseLostError."""
    write(sessions, lease, Batch(events=[EventRecord(kind, message, data or {})]))


def record_checkpoint(sessions: Sessions, lease: Lease, *, step: int, key: str, manifest: Mapping[str, object]) -> str:
    """Write a checkpoint whose files are all in the store; return its id.

    The same step of the same attempt keeps its id. Raises LeaseLostError.
    """
    return write(sessions, lease, Batch(checkpoints=[StoredCheckpoint(step, key, manifest)]))[step]


def request_evaluation(sessions: Sessions, job_id: str, **fields: Any) -> Evaluation:
    """Submit an evaluation of a job, with the given fields of the request; return it."""
    return submit_evaluation(sessions, job_id, EvaluationRequest(**fields))[0]


@contextmanager
def refusing(
    sessions: Sessions,
    table: str,
    condition: str = "true",
    changes: str = "INSERT OR UPDATE",
    error: str = "lock_not_available",
) -> Iterator[None]:
    """Make the database refuse changes of rows, by default as if they were locked for longer than a statement waits."""
    refuse = f"CREATE FUNCTION refuse() RETURNS trigger AS 'BEGIN RAISE {error}; END' LANGUAGE plpgsql"
    when = f"BEFORE {changes} ON {table} FOR EACH ROW WHEN ({condition}) EXECUTE FUNCTION refuse()"
    with sessions.begin() as session:
        session.execute(text(refuse))
        session.execute(text(f"CREATE TRIGGER refuse {when}"))
    try:
        yield
    finally:
        with sessions.begin() as session:
            session.execute(text("DROP FUNCTION refuse CASCADE"))
