"""Retention of artifacts: which checkpoints are kept, and deletion of files that no row refers to.

A database that is empty, older or another service's refers to few or none of the files in the store. So the store says
whose it is, and since when the present generation of that database has used it: files are deleted only by their own
service, and none before that generation is as old as files have to be.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from naospec import TrainingSpec, read_stored
from pydantic import AwareDatetime, BaseModel
from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from naojobs import backups, checkpoints
from naojobs.database import Sessions
from naojobs.errors import JobError
from naojobs.leases import Lease, hold_as
from naojobs.models import (
    Checkpoint,
    Evaluation,
    Job,
    Match,
    MatchGame,
    MetricsRecord,
    PolicyVersion,
    ServiceKey,
    TeamRecord,
    generation,
)
from naojobs.store import ARTIFACTS, OWNER, PROBES, ArtifactStore, MissingArtifactError, StoreError, artifact_of

BEST_BY = "reward"
"""The column of metrics that decides which checkpoint is the best: the mean reward of the latest episodes."""

DEFAULT_AGE_S = 86_400.0
"""Seconds for which a file without a row is kept: its upload may not be complete yet."""

_REMEDY = (
    "nothing is deleted from it. If it is to be this service's, run `python -m naojobs artifacts adopt`; otherwise "
    "mend NAOSPRINT_DATABASE_URL or NAOSPRINT_ARTIFACT_URL, or restore the database"
)

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Retention:
    """Checkpoints of a job to keep, besides the best one and those in use."""

    last: int
    """The newest."""
    every: int | None = None
    """Every n-th of those that the training plans; none for no others."""


def prune_checkpoints(sessions: Sessions, lease: Lease, wanted: Retention) -> list[str]:
    """Delete the rows of a leased job's checkpoints that `wanted` does not keep; return the keys of their files.

    Kept in any case: the one with the highest mean reward, those that were evaluated or are to be, those whose policy
    another job starts from, those of registered policies, and those that open matches and studies use. The caller
    deletes the files; the sweep deletes any that remain. Raises LeaseLostError.
    """
    with sessions.begin() as session:
        # Every transaction that refers to a checkpoint locks its job's row first, so none can do so meanwhile.
        job = hold_as(session, lease, Job)
        rows = session.execute(
            select(Checkpoint.id, Checkpoint.step, Checkpoint.key)
            .where(Checkpoint.job_id == job.id)
            .order_by(Checkpoint.step.desc(), Checkpoint.attempt.desc()),
        ).all()
        candidates = rows[wanted.last :]
        if wanted.every is not None:
            spec = read_stored(TrainingSpec, job.spec)  # an older version may have stored fewer settings
            stride = wanted.every * spec.runtime.checkpoint_interval_steps
            rollout = spec.rollout_steps
            # A checkpoint is saved with the first update at or after a multiple of the interval.
            candidates = [row for row in candidates if row.step % stride >= rollout]
        spared = _spared(session, job.id)
        doomed = [row for row in candidates if row.id not in spared]
        if doomed:
            session.execute(delete(Checkpoint).where(Checkpoint.id.in_([row.id for row in doomed])))
    return [row.key for row in doomed]


def _spared(session: Session, job_id: str) -> set[str]:
    """Return the checkpoints of a job that are kept in any case."""
    of_job = Checkpoint.job_id == job_id
    best = session.scalar(
        select(Checkpoint.id)
        .join(MetricsRecord, (MetricsRecord.job_id == Checkpoint.job_id) & (MetricsRecord.step == Checkpoint.step))
        .where(of_job, MetricsRecord.values.has_key(BEST_BY))
        .order_by(MetricsRecord.values[BEST_BY].as_float().desc(), Checkpoint.step.desc())
        .limit(1),
    )
    evaluated = session.scalars(select(Evaluation.checkpoint_id).where(Evaluation.job_id == job_id))
    parents = session.scalars(
        select(Job.parent_checkpoint_id).join(Checkpoint, Checkpoint.id == Job.parent_checkpoint_id).where(of_job),
    )
    registered = session.scalars(
        select(PolicyVersion.checkpoint_id).join(Checkpoint, Checkpoint.id == PolicyVersion.checkpoint_id).where(of_job)
    )
    used = checkpoints.in_use(session)
    return {str(item) for item in (best, *evaluated, *parents, *registered, *used) if item is not None}


def delete_files(sessions: Sessions, store: ArtifactStore, prefix: str) -> int:
    """Delete the files below `prefix`, whose rows are deleted already; return how many.

    While a backup is made they stay: its copy of the database may still refer to them. The sweep deletes them later.
    Raises StoreError.
    """
    return 0 if backups.in_progress(sessions) else store.delete_prefix(prefix)


class ForeignStoreError(JobError):
    """Store that another service uses, or one of which nothing says that this service does."""


class _Owner(BaseModel):
    """What the store says: keys of its service and of the generation of that one's database, and since when."""

    service: str
    generation: str
    since: AwareDatetime


def adopt(sessions: Sessions, store: ArtifactStore, *, force: bool = False) -> datetime:
    """Note in the store that it is this service's; return since when the database's generation has used it.

    Without `force` only a store becomes this service's that is empty, or has a file that a row refers to.

    Raises:
        ForeignStoreError: it is not this service's, or nothing says so.
        StoreError: it did not answer.
    """
    with sessions() as session:
        service, current, now = session.execute(select(ServiceKey.key, generation(), func.now())).one()
    try:
        owner = _Owner.model_validate_json(store.get_bytes(OWNER))
    except MissingArtifactError:
        owner = None
    except ValueError as error:
        raise ForeignStoreError(f"{OWNER} in the store is damaged: {error}; {_REMEDY}") from None
    if owner is not None and (owner.service, owner.generation) == (service, current):
        return owner.since
    if owner is not None and owner.service != service and not force:
        raise ForeignStoreError(f"the store is another service's, {owner.service}; this one is {service}: {_REMEDY}")
    if owner is None and not force:
        there = {artifact_of(file.key) for file in store.files(ARTIFACTS)}
        with sessions() as session:
            if there and there.isdisjoint(_known(session)):
                raise ForeignStoreError(f"the database refers to none of the files in the store: {_REMEDY}")
    owner = _Owner(service=service, generation=current, since=now)
    store.put_bytes(OWNER, owner.model_dump_json().encode())
    return owner.since


def _known(session: Session) -> set[str]:
    """Return the prefixes of all files that rows refer to."""
    keys = (Checkpoint.key, Evaluation.key, MatchGame.key, TeamRecord.key)
    return {str(key) for column in keys for key in session.scalars(select(column)) if key is not None}


def find_orphans(sessions: Sessions, store: ArtifactStore, *, age_s: float = DEFAULT_AGE_S) -> list[str]:
    """Return the prefixes of files that no row refers to and that have not changed for `age_s`, sorted.

    Files of leased jobs and matches are left out regardless of their age, since a clock may be wrong. So are all files
    until the database's generation has used the store for `age_s`.

    Raises:
        ForeignStoreError: the store is not this service's.
        StoreError: it did not answer.
    """
    since = adopt(sessions, store)
    changed: dict[str, datetime] = {}
    for file in (*store.files(ARTIFACTS), *store.files(PROBES)):
        prefix = artifact_of(file.key)
        changed[prefix] = max(file.modified, changed.get(prefix, since))
    with sessions.begin() as session:
        before = session.execute(select(func.now())).scalar_one() - timedelta(seconds=age_s)  # not by a worker's clock
        old = [prefix for prefix, at in changed.items() if at < before]
        busy = {
            found
            for column, table in ((Job.id, Job), (Evaluation.job_id, Evaluation), (Match.id, Match))
            for found in session.scalars(select(column).where(table.lease_owner.is_not(None)))
        }
        known = _known(session)  # after the leases: what ends meanwhile has recorded its files
    return sorted(prefix for prefix in old if prefix not in known and prefix.split("/")[1] not in busy)


def sweep(sessions: Sessions, store: ArtifactStore, *, age_s: float = DEFAULT_AGE_S) -> Sequence[str]:
    """Delete files that no row refers to (see `find_orphans`); return their prefixes.

    Several processes may do so at once; none does while a backup is made. Raises as `find_orphans` does, and StoreError
    in the end if some files could not be deleted, which keep no others.
    """
    gone: list[str] = []
    refused: list[str] = []
    if backups.in_progress(sessions):
        return gone
    for prefix in find_orphans(sessions, store, age_s=age_s):
        try:
            count = store.delete_prefix(prefix) or store.delete_file(prefix)
        except MissingArtifactError:
            continue  # another process was faster
        except (StoreError, ValueError) as error:  # no key of ours: something else put the file there
            store.check()  # of a store that does not answer nothing can be deleted
            refused.append(f"{prefix} cannot be deleted: {error}")
            continue
        _log.info("deleted %s: %d files that nothing refers to", prefix, count)
        gone.append(prefix)
    if count := store.remove_unfinished(age_s):
        _log.info("deleted %d files whose writing was interrupted", count)
    if refused:
        raise StoreError(f"{refused[0]}" + (f"; nor can {len(refused) - 1} others" if refused[1:] else ""))
    return gone
