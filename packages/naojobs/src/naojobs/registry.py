"""The workers that are there, and when they were last heard of."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta

from sqlalchemy import delete, func, select
from sqlalchemy.dialects.postgresql import insert

from naojobs.lifecycle import Sessions
from naojobs.models import Job, Worker
from naojobs.schemas import WorkerPublic


def beat(sessions: Sessions, worker_id: str, *, host: str, pid: int, queues: Sequence[str], version: str) -> None:
    """Enter a worker into the registry, or say that it is still there."""
    with sessions.begin() as session:
        session.execute(
            insert(Worker)
            .values(id=worker_id, host=host, pid=pid, queues=list(queues), version=version)
            .on_conflict_do_update(
                index_elements=[Worker.id],
                set_={"heartbeat_at": func.now(), "queues": list(queues), "version": version},
            ),
        )


def leave(sessions: Sessions, worker_id: str) -> None:
    """Take a worker that ends out of the registry."""
    with sessions.begin() as session:
        session.execute(delete(Worker).where(Worker.id == worker_id))


def forget(sessions: Sessions, *, after_s: float = 86_400.0) -> None:
    """Take workers out of the registry that were not heard of for `after_s`."""
    with sessions.begin() as session:
        session.execute(delete(Worker).where(Worker.heartbeat_at < func.now() - timedelta(seconds=after_s)))


def workers(sessions: Sessions, *, stale_s: float = 30.0) -> list[WorkerPublic]:
    """Return all workers with the jobs that each holds; `alive` by the database's clock."""
    with sessions.begin() as session:
        alive = Worker.heartbeat_at > func.now() - timedelta(seconds=stale_s)
        rows = session.execute(select(Worker, alive).order_by(Worker.started_at, Worker.id)).all()
        held: dict[str, list[str]] = {}
        for owner, job_id in session.execute(select(Job.lease_owner, Job.id).where(Job.lease_owner.is_not(None))):
            held.setdefault(str(owner), []).append(job_id)
        return [
            WorkerPublic(
                id=worker.id,
                host=worker.host,
                pid=worker.pid,
                queues=worker.queues,
                version=worker.version,
                started_at=worker.started_at,
                heartbeat_at=worker.heartbeat_at,
                alive=is_alive,
                jobs=sorted(held.get(worker.id, [])),
            )
            for worker, is_alive in rows
        ]


def leased_jobs_of(sessions: Sessions, owner: str) -> frozenset[str]:
    """Return the jobs of `owner` that some worker holds."""
    with sessions.begin() as session:
        return frozenset(session.scalars(select(Job.id).where(Job.owner == owner, Job.lease_owner.is_not(None))))
