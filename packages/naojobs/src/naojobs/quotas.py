"""Quotas of owners: open jobs, bytes in the store, rows in the database."""

from __future__ import annotations

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from naojobs.database import Sessions
from naojobs.errors import QuotaError
from naojobs.models import Checkpoint, Evaluation, Job
from naojobs.states import OPEN


def require_free_slot(session: Session, owner: str, max_open_jobs: int) -> None:
    """Raise QuotaError if `owner` has `max_open_jobs` open jobs; others wait until the transaction has ended."""
    # Two concurrent submits must not both see the last free slot.
    session.execute(select(func.pg_advisory_xact_lock(func.hashtextextended(f"quota:{owner}", 0))))
    open_jobs = session.scalar(
        select(func.count()).select_from(Job).where(Job.owner == owner, Job.state.in_(OPEN)),
    )
    if (open_jobs or 0) >= max_open_jobs:
        raise QuotaError(
            f"{owner} has {open_jobs} open jobs, the most that are allowed; wait until some finish, or cancel some",
        )


def require_space(sessions: Sessions, owner: str, *, max_bytes: int, max_rows: int) -> None:
    """Raise QuotaError if the jobs of `owner` have stored as much as they may.

    Args:
        sessions: the database.
        owner: whose jobs count.
        max_bytes: bytes of checkpoints and evaluations in the store.
        max_rows: rows of metrics, logs and events that workers have written.
    """
    with sessions.begin() as session:
        of_owner = Job.owner == owner
        rows = session.scalar(select(func.coalesce(func.sum(Job.row_count), 0)).where(of_owner)) or 0
        used = sum(
            session.scalar(
                select(func.coalesce(func.sum(table.size), 0)).join(Job, Job.id == table.job_id).where(of_owner)
            )
            or 0
            for table in (Checkpoint, Evaluation)
        )
    for amount, most, what in ((used, max_bytes, "bytes in the store"), (rows, max_rows, "rows in the database")):
        if amount >= most:
            raise QuotaError(f"{owner} has {amount:,} {what}, of {most:,} that are allowed; delete jobs")
