"""Registry of workers with their capabilities and heartbeats."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import asdict, dataclass
from typing import Any

from sqlalchemy import delete, func, select, union_all, update
from sqlalchemy.dialects.postgresql import insert
from sqlalchemy.orm import Session

from naojobs.capabilities import Capabilities
from naojobs.changes import add_event
from naojobs.database import Sessions, one_statement
from naojobs.errors import NotFoundError
from naojobs.leases import read_lease_clock
from naojobs.models import Evaluation, Job, Match, Worker
from naojobs.preemption import YIELDING


@dataclass(frozen=True, slots=True)
class WorkerStatus:
    """Registered worker, whether it is alive by the database's clock, and the ids of the work that it has leased."""

    row: Worker
    alive: bool
    jobs: tuple[str, ...]
    evaluations: tuple[str, ...]
    matches: tuple[str, ...]


def beat(
    sessions: Sessions,
    worker_id: str,
    *,
    host: str,
    pid: int,
    capabilities: Capabilities,
    version: str,
    disk_free_bytes: int | None = None,
    stale_s: float = 30.0,
) -> int:
    """Register a worker, or renew its heartbeat; return how many workers have one in the last `stale_s` seconds."""
    current = {"version": version, "disk_free_bytes": disk_free_bytes, **asdict(capabilities)}
    with one_statement(sessions) as session:
        session.execute(
            insert(Worker)
            .values(id=worker_id, host=host, pid=pid, **current)
            .on_conflict_do_update(index_elements=[Worker.id], set_={"heartbeat_at": func.now(), **current}),
        )
        read_lease_clock(session, stale_s)
        alive = Worker.heard_within(stale_s)
        return session.execute(select(func.count()).select_from(Worker).where(alive)).scalar_one()


def leave(sessions: Sessions, worker_id: str) -> None:
    """Remove a worker that shuts down."""
    with one_statement(sessions) as session:
        session.execute(delete(Worker).where(Worker.id == worker_id))


def drain(sessions: Sessions, worker_id: str, *, requeue: bool = False) -> None:
    """Keep a worker from claiming work; with `requeue` its trainings write a checkpoint and wait for another worker.

    Evaluations, matches and what is evaluating end first. Raises NotFoundError.
    """
    with sessions.begin() as session:
        _set_drained(session, worker_id, func.coalesce(Worker.drained_at, func.now()))
        if not requeue:
            return
        held = select(Job).where(Job.lease_owner == worker_id, *YIELDING).order_by(Job.id).with_for_update()
        for job in session.scalars(held):
            job.yields_to = worker_id
            add_event(session, job, "requeue_requested", "asked the worker to requeue it: the worker is drained")


def undrain(sessions: Sessions, worker_id: str) -> None:
    """Allow a worker to claim work again. Raises NotFoundError."""
    with sessions.begin() as session:
        _set_drained(session, worker_id, None)


def _set_drained(session: Session, worker_id: str, value: Any) -> None:
    changed = update(Worker).where(Worker.id == worker_id).values(drained_at=value).returning(Worker.id)
    if session.scalar(changed) is None:
        raise NotFoundError(f"no worker {worker_id}; `naoctl workers` lists them")


def forget(sessions: Sessions, *, after_s: float = 86_400.0) -> None:
    """Remove workers whose last heartbeat is older than `after_s`."""
    with sessions.begin() as session:
        session.execute(delete(Worker).where(~Worker.heard_within(after_s)))


def workers(
    sessions: Sessions,
    *,
    stale_s: float = 30.0,
    limit: int | None = None,
    after: str | None = None,
    only: str | None = None,
) -> list[WorkerStatus]:
    """Return all workers by id, or `limit` of them after `after`, or the worker `only`.

    A worker whose last heartbeat is older than `stale_s` is not alive.
    """
    with sessions.begin() as session:
        alive = Worker.heard_within(stale_s)
        statement = select(Worker, alive).order_by(Worker.id).limit(limit)
        if after is not None:
            statement = statement.where(Worker.id > after)
        if only is not None:
            statement = statement.where(Worker.id == only)
        rows = session.execute(statement).all()
        jobs, evaluations, matches = (_held(session, model) for model in (Job, Evaluation, Match))
        return [
            WorkerStatus(worker, is_alive, jobs[worker.id], evaluations[worker.id], matches[worker.id])
            for worker, is_alive in rows
        ]


def _held(session: Session, model: type[Job | Evaluation | Match]) -> defaultdict[str, tuple[str, ...]]:
    """Return the ids of leased work by worker, in order."""
    held: defaultdict[str, tuple[str, ...]] = defaultdict(tuple)
    rows = select(model.lease_owner, model.id).where(model.lease_owner.is_not(None)).order_by(model.id)
    for worker, work_id in session.execute(rows):
        held[str(worker)] += (work_id,)
    return held


def leased_of(sessions: Sessions, owner: str) -> frozenset[str]:
    """Return the ids of the jobs, evaluations and matches of `owner` that a worker has leased."""
    evaluations = select(Evaluation.id).join(Job, Job.id == Evaluation.job_id).where(Job.owner == owner)
    wanted = (
        select(Job.id).where(Job.owner == owner, Job.lease_owner.is_not(None)),
        evaluations.where(Evaluation.lease_owner.is_not(None)),
        select(Match.id).where(Match.owner == owner, Match.lease_owner.is_not(None)),
    )
    with sessions.begin() as session:
        return frozenset(session.scalars(union_all(*wanted)))
