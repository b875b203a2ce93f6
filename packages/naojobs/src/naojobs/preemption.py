"""Preemption: a training of low priority writes a checkpoint and waits again, so that urgent work can run.

A training resumes with the same bits, so that preemption costs seconds and changes no result.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta

from sqlalchemy import exists, func, select
from sqlalchemy.orm import Session, aliased

from naojobs.capabilities import Capabilities
from naojobs.changes import add_event
from naojobs.database import Sessions
from naojobs.leases import waiting
from naojobs.models import Job, Match, Worker
from naojobs.states import WorkState

YIELDING = (
    Job.state.in_((WorkState.STARTING, WorkState.RUNNING)),
    Job.yields_to.is_(None),
    Job.cancel_requested.is_(False),
)
"""Conditions of leased jobs that can be asked to make room."""

_LOCK = 0x6E6179
"""Key of the lock against two workers that make room for the same work."""


def make_room(
    sessions: Sessions, worker: str, capabilities: Capabilities, *, by: int, after_s: float
) -> tuple[str, str] | None:
    """Ask a training of a busy worker to make room for a job or a match that waits with a priority higher by `by`.

    Of the worker's trainings it is the one of lowest priority, the last claimed first. One training makes room for
    each piece of work, and only after that has waited for `after_s` seconds, in which a free worker would have taken
    it. A drained worker makes room for nothing, since it would not claim it.

    Returns:
        The training and what it makes room for; None if nothing is that urgent.
    """
    with sessions.begin() as session:
        session.execute(select(func.pg_advisory_xact_lock(_LOCK)))
        own = select(Job).where(Job.lease_owner == worker, *YIELDING)
        first = own.order_by(Job.priority, Job.started_at.desc(), Job.id.desc()).limit(1)
        job = session.scalar(first.with_for_update(skip_locked=True))
        if job is None or session.scalar(select(Worker.drained_at).where(Worker.id == worker)) is not None:
            return None
        urgent = max(
            _urgent(session, capabilities, job.priority + by, after_s),
            key=lambda work: (work.priority, -work.queued_at.timestamp()),  # type: ignore[union-attr]
            default=None,
        )
        if urgent is None:
            return None
        job.yields_to = urgent.id
        message = f"asked the worker to requeue it: a {urgent.kind} of priority {urgent.priority} waits"
        shown = {"for": urgent.id} if urgent.owner == job.owner else {}  # users see no work of others
        add_event(session, job, "requeue_requested", message, shown)
        return job.id, urgent.id


def _urgent(session: Session, capabilities: Capabilities, priority: int, after_s: float) -> Iterator[Job | Match]:
    """Yield the first job and the first match of this priority or a higher one that no training makes room for."""
    yielding = aliased(Job)
    for model in (Job, Match):
        found = session.scalar(
            waiting(model)
            .where(
                capabilities.condition(model),
                model.priority >= priority,
                model.queued_at < func.now() - timedelta(seconds=after_s),
                ~exists(select(yielding.id).where(yielding.yields_to == model.id)),
            )
            .order_by(model.priority.desc(), model.queued_at)
            .limit(1)
        )
        if found is not None:
            yield found
