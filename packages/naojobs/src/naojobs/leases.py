"""Leases of workers on work: claims, heartbeats, and the check that every write of a worker begins with.

Each function is one small transaction, or part of its caller's. A lease expires by a clock of its own, which stands
still while the database is down (`naojobs.models.lease_time`).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, TypeAlias, cast

import naopolicies
from naospec import EvaluationSpec, TrainingSpec, plugins, read_stored, validation_words
from pydantic import ValidationError
from sqlalchemy import ColumnElement, Row, ScalarSelect, and_, false, func, or_, select, update
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from naojobs.capabilities import Capabilities
from naojobs.changes import W, add_event, announce, change, lock
from naojobs.checkpoints import CheckpointRef, awaits_policy, newest_checkpoint, trained_checkpoint
from naojobs.database import Sessions, is_due, is_outage, notify, one_statement, schema_mismatch
from naojobs.errors import LeaseLostError, OtherSchemaError
from naojobs.models import (
    WORK,
    AnyWork,
    Checkpoint,
    Evaluation,
    Job,
    LeaseClock,
    Match,
    MatchGame,
    ServiceKey,
    TeamRecord,
    Worker,
    WorkKind,
    generation,
    lease_time,
)
from naojobs.states import WorkState
from naojobs.teams import MatchSpec

logger = logging.getLogger(__name__)

DEFAULT_LEASE_S = 30.0
"""Seconds after a heartbeat at which a lease expires."""

LONGEST_POSTPONE_S = 300.0
"""Most seconds until the next attempt at work that was postponed."""

_MAX_REASON = 500


@dataclass(frozen=True, slots=True)
class Lease:
    """Right of a worker to write to a piece of work.

    `attempt` fences it off once another worker has claimed the work, `generation` once the database was restored.
    """

    kind: WorkKind
    id: str
    job_id: str
    """The job that it belongs to; a job's or a match's own id."""
    owner: str
    attempt: int
    generation: str
    """Generation of the database that gave it, see `naojobs.models.generation`."""
    service: str
    """Key of the service."""

    def __str__(self) -> str:
        """Return the work and its holder for messages."""
        return f"{self.kind} {self.id} of {self.owner} (attempt {self.attempt})"


@dataclass(frozen=True, slots=True)
class JobClaim:
    """Lease on a job with what to do and where to start from."""

    lease: Lease
    name: str
    spec: TrainingSpec
    evaluation: EvaluationSpec | None
    initial_policy: CheckpointRef | None
    """The checkpoint of another job to take the initial policy from; none when there is something to resume."""
    bundled_policy: str | None = None
    """The bundled policy to start from; none when there is something to resume."""


@dataclass(frozen=True, slots=True)
class EvaluationClaim:
    """Lease on an evaluation with what to evaluate."""

    lease: Lease
    spec: EvaluationSpec
    checkpoint: CheckpointRef
    time_limit_s: float
    report: str | None
    """Report to draw with it: film, pictures or off; none for what the worker is set to."""


@dataclass(frozen=True, slots=True)
class ArtifactRef:
    """Artifact in the store."""

    key: str
    manifest: dict[str, Any]


@dataclass(frozen=True, slots=True)
class MatchClaim:
    """Lease on a match with what its teams are made of, and what is over."""

    lease: Lease
    spec: MatchSpec
    checkpoints: dict[str, CheckpointRef]
    """The checkpoints of both teams' policies by id."""
    archives: dict[str, ArtifactRef]
    """Archives of uploaded teams by the teams' ids."""
    games: dict[int, ArtifactRef]
    """Logs of the games that are over."""


Claim: TypeAlias = JobClaim | EvaluationClaim | MatchClaim


@dataclass(frozen=True, slots=True)
class Requests:
    """State of leased work and what users request of it."""

    state: WorkState
    cancel: bool
    requeue: bool = False
    """Whether a training is to write a checkpoint and wait again, for other work or another worker."""


def claim_next(
    sessions: Sessions,
    worker: str,
    *,
    models: Iterable[type[AnyWork]] = tuple(WORK.values()),
    capabilities: Capabilities,
    lease_s: float = DEFAULT_LEASE_S,
) -> Claim | None:
    """Claim the work of highest priority, the oldest first, that `worker` can run.

    Several workers may look at once: each skips the rows that another is claiming. A drained worker claims nothing.
    Work whose row the database refuses to change waits for the next call, and keeps none behind it from being claimed.

    Raises:
        OtherSchemaError: the database has the schema of another version, whose work may not be readable here.
    """
    models = tuple(models)
    refused: list[str] = []
    while True:
        chosen = None
        try:
            with sessions.begin() as session:
                if mismatch := schema_mismatch(session):
                    raise OtherSchemaError(f"{mismatch}: this worker claims no work; run the same version on all hosts")
                # The lock lets a drain wait, which then finds what is claimed here.
                row = select(Worker.drained_at).where(Worker.id == worker).with_for_update(read=True)
                if session.scalar(row) is not None:
                    return None
                found: list[AnyWork] = []
                for model in models:
                    first = (
                        waiting(model)
                        .where(capabilities.condition(model), *([model.id.not_in(refused)] if refused else []))
                        .order_by(model.priority.desc(), model.queued_at)
                        .limit(1)
                    )
                    work = session.scalar(first.with_for_update(skip_locked=True))
                    found += [] if work is None else [work]
                if not found:
                    return None
                work = min(found, key=lambda work: (-work.priority, work.queued_at))
                chosen = work.id
                taken = take(session, work, worker, lease_s)
        except SQLAlchemyError as error:
            if chosen is None or is_outage(error):
                raise
            logger.exception("%s cannot be claimed", chosen)
            refused.append(chosen)
            continue
        if taken is not None:  # else it is no longer queued, and its row has the reason
            return taken


def waiting(model: type[AnyWork]) -> Any:
    """Return the query of the work of a kind that waits for a worker."""
    postponed = and_(model.postponed > 0, is_due(model.not_before, LONGEST_POSTPONE_S))
    due = or_(model.not_before.is_(None), model.not_before <= func.now(), postponed)
    waiting = select(model).where(model.state == WorkState.QUEUED, due)
    return waiting.where(~awaits_policy()) if model is Job else waiting


class _RefusedError(Exception):
    """Work that no worker can begin; the message is the reason."""


def take(session: Session, work: AnyWork, worker: str, lease_s: float) -> Claim | None:
    """Lease a locked row to `worker`; the new attempt fences off every earlier worker.

    Work fails whose specification this version cannot read, or that lacks a policy or a team that it starts with; then
    None is returned. So does work for which a plug-in fails: otherwise nothing behind it would ever be claimed.
    """
    database, service = session.execute(select(generation(), ServiceKey.key)).one()
    lease = Lease(work.kind, work.id, work.job_id, worker, work.attempt + 1, database, service)
    try:
        match work:
            case Job():
                claim: Claim = _job_claim(session, work, lease)
            case Evaluation():
                checkpoint = CheckpointRef.of(session.get_one(Checkpoint, work.checkpoint_id))
                spec = read_stored(EvaluationSpec, work.spec)
                claim = EvaluationClaim(lease, spec, checkpoint, work.time_limit_s, work.report)
            case Match():
                claim = _match_claim(session, work, lease)
    except _RefusedError as error:
        _refuse(session, work, str(error))
        return None
    except (ValidationError, plugins.BrokenPluginError) as error:
        words = validation_words(error.errors()) if isinstance(error, ValidationError) else str(error)
        _refuse(session, work, f"the specification does not fit this version: {words}")
        return None
    except SQLAlchemyError:
        raise
    except Exception as error:
        logger.exception("%s cannot be begun", work.id)
        _refuse(session, work, f"the specification cannot be read: {type(error).__name__}: {error}"[:_MAX_REASON])
        return None
    change(work, WorkState.STARTING)
    work.attempt += 1
    work.lease_owner = worker
    work.lease_generation = lease.generation
    work.lease_expires_at = _lease_end(lease_s)
    work.heartbeat_at = func.now()
    work.started_at = func.coalesce(type(work).started_at, func.now())
    if isinstance(work, Evaluation):
        notify(session, work.job_id)  # no event: the job's row is not locked
    else:
        add_event(session, work, "claimed", f"claimed by {worker}", {"worker": worker})
    return claim


def _job_claim(session: Session, job: Job, lease: Lease) -> JobClaim:
    """Return what a locked job does and starts from. Raises ValidationError, _RefusedError."""
    spec = read_stored(TrainingSpec, job.spec)
    evaluation = read_stored(EvaluationSpec, job.evaluation) if job.evaluation else None
    parent = bundled = None
    if job.needs_policy and newest_checkpoint(session, job.id) is None:
        bundled = job.parent_policy if job.parent_policy in naopolicies.names() else None
        parent = _parent_policy(session, job) if bundled is None else None
        if parent is None and bundled is None:
            raise _RefusedError(_missing_policy(job))
    return JobClaim(
        lease=lease,
        name=job.name,
        spec=spec,
        evaluation=evaluation,
        initial_policy=CheckpointRef.of(parent) if parent else None,
        bundled_policy=bundled,
    )


def _match_claim(session: Session, match: Match, lease: Lease) -> MatchClaim:
    """Return what the teams of a locked match are made of. Raises ValidationError, _RefusedError."""
    spec = MatchSpec.model_validate(match.spec)
    checkpoints, archives = {}, {}
    for team in spec.teams:
        for skill, policy in team.policies.items():
            if policy in naopolicies.names():
                continue
            if (checkpoint := session.get(Checkpoint, policy)) is None:
                raise _RefusedError(f"team {team.name}: the policy of its skill {skill} was deleted")
            checkpoints[policy] = CheckpointRef.of(checkpoint)
        if team.team_id is not None:
            if (record := session.get(TeamRecord, team.team_id)) is None:
                raise _RefusedError(f"team {team.name} was deleted")
            archives[record.id] = ArtifactRef(record.key, record.manifest)
    over = session.scalars(select(MatchGame).where(MatchGame.match_id == match.id))
    games = {game.number: ArtifactRef(game.key, game.manifest) for game in over}
    return MatchClaim(lease, spec, checkpoints, archives, games)


def _refuse(session: Session, work: AnyWork, reason: str) -> None:
    """End queued work that no worker can begin."""
    work.error = reason
    change(work, WorkState.FAILED)
    if not isinstance(work, Evaluation):
        add_event(session, work, "failed", reason)
    else:
        notify(session, work.job_id)  # no event: the job's row is not locked
        announce(session, work, "failed")


def _parent_policy(session: Session, job: Job) -> Checkpoint | None:
    """Return the checkpoint whose policy a locked job starts from; none if there no longer is one."""
    if job.parent_checkpoint_id is not None:
        return session.get(Checkpoint, job.parent_checkpoint_id)
    if job.parent_job_id is None:
        return None
    # From now on this checkpoint is the parent's, for every attempt: the lock and the reference keep it from being
    # pruned by the parent job, which may still run.
    session.execute(select(Job.id).where(Job.id == job.parent_job_id).with_for_update(key_share=True))
    parent = trained_checkpoint(session, job.parent_job_id)
    job.parent_checkpoint_id = parent.id if parent is not None else None
    return parent


def _missing_policy(job: Job) -> str:
    if job.parent_policy is not None and "@" not in job.parent_policy:
        return f"this version has no policy {job.parent_policy!r}, which it starts from"
    if job.parent_job_id is None:
        return "the job whose policy it starts from was deleted"
    return f"job {job.parent_job_id}, whose policy it starts from, ended without a trained checkpoint"


def heartbeat(sessions: Sessions, lease: Lease, *, lease_s: float = DEFAULT_LEASE_S) -> Requests:
    """Renew `lease` and return the users' requests.

    Raises LeaseLostError if the work was requeued, deleted, or claimed by another worker.
    """
    model = WORK[lease.kind]
    with one_statement(sessions) as session:
        row = session.execute(
            update(model)
            .where(held_by(lease))
            .values(heartbeat_at=func.now(), lease_expires_at=_lease_end(lease_s))
            .returning(*_requested(model)),
        ).one_or_none()
    return _requests(lease, row)


def read_requests(sessions: Sessions, lease: Lease) -> Requests:
    """Return the users' requests without renewing `lease`. Raises LeaseLostError."""
    model = WORK[lease.kind]
    with one_statement(sessions) as session:
        row = session.execute(select(*_requested(model)).where(held_by(lease))).one_or_none()
    return _requests(lease, row)


def _requested(model: type[AnyWork]) -> tuple[ColumnElement[Any], ...]:
    """Return the columns of `Requests`."""
    requeue = Job.yields_to.is_not(None) if model is Job else false()
    return model.state, model.cancel_requested, requeue  # type: ignore[return-value]


def _requests(lease: Lease, row: Row[Any] | None) -> Requests:
    if row is None:
        raise lost(lease)
    state, cancel, requeue = tuple(row)
    return Requests(state, cancel=cancel, requeue=requeue)


def held_by(lease: Lease) -> ColumnElement[bool]:
    """Return the condition under which `lease` is still valid."""
    model = WORK[lease.kind]
    return and_(
        model.id == lease.id,
        model.lease_owner == lease.owner,
        model.attempt == lease.attempt,
        generation() == lease.generation,
    )


def lost(lease: Lease) -> LeaseLostError:
    """Return the error of a write under a lease that is no longer valid."""
    return LeaseLostError(f"{lease.kind} {lease.id} is no longer leased to {lease.owner} (attempt {lease.attempt})")


def hold(session: Session, lease: Lease) -> AnyWork:
    """Lock leased work for the rest of the transaction. Raises LeaseLostError."""
    work = lock(session, cast("type[Job]", WORK[lease.kind]), lease.id, held_by(lease))
    if work is None:
        raise lost(lease)
    return work


def hold_as(session: Session, lease: Lease, model: type[W]) -> W:
    """Lock leased work of one kind for the rest of the transaction. Raises LeaseLostError."""
    work = hold(session, lease)
    assert isinstance(work, model), f"{lease} is not a lease on a {model.kind}"
    return work


def _lease_end(lease_s: float) -> ScalarSelect[datetime]:
    """Return the query of the time at which a lease of now expires."""
    return select(lease_time(lease_s) + timedelta(seconds=lease_s)).scalar_subquery()


def read_lease_clock(session: Session, lease_s: float) -> None:
    """Advance the clock of leases; of many workers that call this at once, one changes its row."""
    unread = func.clock_timestamp() - LeaseClock.read_at
    due = or_(unread < timedelta(), unread > timedelta(seconds=lease_s / 30))
    session.execute(
        update(LeaseClock)
        .where(due)
        .values(time=lease_time(lease_s), read_at=func.clock_timestamp())
        .execution_options(synchronize_session=False)
    )
