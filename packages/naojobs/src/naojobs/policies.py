"""Registered policies: checkpoints of users' jobs under a name, with versions and aliases.

`NAME` is the newest version of a policy, `NAME@3` one version, `NAME@best` the version with an alias. Names of bundled
policies are not free.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import naopolicies
from naospec import stored
from sqlalchemy import ColumnElement, delete, func, select
from sqlalchemy.dialects.postgresql import insert
from sqlalchemy.orm import Session

from naojobs import promotion
from naojobs.changes import add_event, lock
from naojobs.checkpoints import in_use, trained_checkpoint
from naojobs.database import Sessions, storable
from naojobs.errors import ConflictError, InvalidError, NotFoundError
from naojobs.idempotency import earlier
from naojobs.ids import new_id
from naojobs.lineage import lineage_of, trained_by
from naojobs.models import Checkpoint, Job, PolicyAlias, PolicyRecord, PolicyVersion
from naojobs.promotion import Requirement
from naojobs.quotas import NO_LIMITS, Limits, Quota, require_room, wait_for_turn

LATEST = "latest"
"""Alias of the newest version, which no user sets."""


@dataclass(frozen=True, slots=True)
class Registration:
    """Version to register."""

    job_id: str
    checkpoint_id: str | None = None
    """None for the job's newest."""
    aliases: Sequence[str] = ()
    notes: str = ""

    def digest(self) -> str:
        """Return the SHA-256 that equal requests share."""
        return hashlib.sha256(json.dumps(asdict(self)).encode()).hexdigest()


def check_alias(alias: str) -> str:
    """Return an alias that users may set. Raises ValueError for `latest`."""
    if alias == LATEST:
        raise ValueError(f"{alias!r} always names the newest version; use another alias")
    return alias


def split(reference: str) -> tuple[str, str]:
    """Return the name and the version or alias of a reference: `NAME` or `NAME@VERSION`."""
    name, _, version = reference.partition("@")
    return name, version or LATEST


def register(
    sessions: Sessions,
    name: str,
    wanted: Registration,
    *,
    idempotency_key: str | None = None,
    limits: Limits = NO_LIMITS,
) -> tuple[PolicyVersion, bool]:
    """Register a checkpoint as the next version of the policy `name` of its job's owner.

    Return the version and whether it is new: the same `idempotency_key` with the same request returns the existing one.

    Raises:
        NotFoundError: there is no such job or checkpoint.
        ConflictError: the job has no checkpoint yet, the policy has this one already, the key was used before, or the
            version has not what one of its aliases requires.
        InvalidError: the name is a bundled policy's, or this version cannot read the job's specification.
        QuotaError: the owner has as many versions, or as long notes, as `limits` allow.
    """
    if name in naopolicies.names():
        raise InvalidError(f"{name} is a bundled policy; use another name", "name")
    digest = wanted.digest() if idempotency_key is not None else None
    with sessions.begin() as session:
        owner = session.scalar(select(Job.owner).where(Job.id == wanted.job_id))
        wait_for_turn(session, owner, limits, Quota.VERSIONS, Quota.ROWS, Quota.NOTES)
        # Locked so that nothing deletes the checkpoint meanwhile, then the policy so that numbers ascend.
        job = lock(session, Job, wanted.job_id)
        if job is None:
            raise NotFoundError(f"no job {wanted.job_id}")
        session.execute(
            insert(PolicyRecord)
            .values(id=new_id("policy"), owner=job.owner, name=name)
            .on_conflict_do_nothing(index_elements=[PolicyRecord.owner, PolicyRecord.name])
        )
        policy = session.scalars(
            select(PolicyRecord).where(PolicyRecord.owner == job.owner, PolicyRecord.name == name).with_for_update()
        ).one()
        of_policy = PolicyVersion.policy_id == policy.id
        if (made := earlier(session, PolicyVersion, of_policy, idempotency_key, digest)) is not None:
            return made, False
        checkpoint = _checkpoint(session, wanted)
        same = session.scalar(
            select(PolicyVersion.number).where(of_policy, PolicyVersion.checkpoint_id == checkpoint.id)
        )
        if same is not None:
            raise ConflictError(
                f"{name}@{same} is this checkpoint already; set aliases of that version", "checkpoint_id"
            )
        require_room(session, job.owner, limits, Quota.VERSIONS, Quota.ROWS)
        if wanted.notes:
            require_room(session, job.owner, limits, Quota.NOTES, more=len(storable(wanted.notes).encode()))
        spec = trained_by(job)
        if spec is None:
            raise InvalidError(f"this version cannot read the specification of job {job.id}; use a newer job", "job_id")
        policy.last_number += 1
        version = PolicyVersion(
            policy_id=policy.id,
            number=policy.last_number,
            checkpoint_id=checkpoint.id,
            notes=wanted.notes,
            spec=stored(spec),
            spec_sha256=spec.digest(),
            lineage=lineage_of(session, checkpoint),
            idempotency_key=idempotency_key,
            idempotency_digest=digest,
        )
        session.add(version)
        session.flush()
        for alias in wanted.aliases:
            _point(session, policy, alias, version)
        reference = f"{name}@{version.number}"
        data = {"policy": reference, "checkpoint_id": checkpoint.id, "step": checkpoint.step}
        add_event(session, job, "registered", f"step {checkpoint.step} is policy {reference}", data)
        session.refresh(version)
    return version, True


def _checkpoint(session: Session, wanted: Registration) -> Checkpoint:
    if wanted.checkpoint_id is None:
        newest = trained_checkpoint(session, wanted.job_id)
        if newest is None:
            raise ConflictError(f"job {wanted.job_id} has no trained checkpoint yet; wait for the first", "job_id")
        return newest
    checkpoint = session.get(Checkpoint, wanted.checkpoint_id)
    if checkpoint is None or checkpoint.job_id != wanted.job_id:
        raise NotFoundError(f"job {wanted.job_id} has no checkpoint {wanted.checkpoint_id}")
    return checkpoint


def _point(session: Session, policy: PolicyRecord, alias: str, version: PolicyVersion) -> None:
    promotion.check(session, policy, alias, version)
    others = PolicyAlias.policy_id == policy.id, PolicyAlias.name != alias
    if (session.scalar(select(func.count()).where(*others)) or 0) >= promotion.MAX_ALIASES:
        raise ConflictError(f"policy {policy.name} has {promotion.MAX_ALIASES} aliases; remove one", "alias")
    statement = insert(PolicyAlias).values(policy_id=policy.id, name=alias, number=version.number)
    session.execute(
        statement.on_conflict_do_update(
            index_elements=[PolicyAlias.policy_id, PolicyAlias.name], set_={"number": statement.excluded.number}
        )
    )


def find(
    session: Session, owned: ColumnElement[bool], reference: str, *, keep: bool = False
) -> tuple[PolicyRecord, PolicyVersion]:
    """Return a registered policy and the version that a reference names.

    Args:
        session: the database.
        owned: condition on `Policy` that selects whose policies count.
        reference: `NAME`, `NAME@3` or `NAME@alias`.
        keep: whether a deletion of the version waits until the transaction has ended.

    Raises:
        NotFoundError: there is none.
        ConflictError: several owners have a policy of this name.
    """
    name, wanted = split(reference)
    found = session.scalars(
        select(PolicyRecord)
        .where(PolicyRecord.name == name, owned, PolicyRecord.id.in_(select(PolicyVersion.policy_id)))
        .order_by(PolicyRecord.owner)
    ).all()
    if not found:
        raise NotFoundError(f"there is no policy {name!r}")
    if len(found) > 1:
        owners = ", ".join(policy.owner for policy in found[:5])
        raise ConflictError(f"several owners have a policy {name!r}: {owners}; name one of them", "owner")
    (policy,) = found
    if keep:
        session.execute(
            select(PolicyRecord.id).where(PolicyRecord.id == policy.id).with_for_update(read=True, key_share=True)
        )
    statement = select(PolicyVersion).where(PolicyVersion.policy_id == policy.id)
    if wanted == LATEST:
        statement = statement.order_by(PolicyVersion.number.desc()).limit(1)
    elif wanted.isdecimal():
        # Beyond the range of the column there is none either.
        statement = statement.where(PolicyVersion.number == min(int(wanted), 2**31 - 1))
    else:
        statement = statement.join(
            PolicyAlias,
            (PolicyAlias.policy_id == PolicyVersion.policy_id) & (PolicyAlias.number == PolicyVersion.number),
        ).where(PolicyAlias.name == wanted)
    version = session.scalar(statement)
    if version is None:
        aliases = ", ".join([LATEST, *sorted(aliases_of(session, [policy.id]).get(policy.id, {}))])
        raise NotFoundError(f"policy {name} has no version {wanted!r}; its aliases are {aliases}")
    return policy, version


def aliases_of(session: Session, policy_ids: Sequence[str]) -> dict[str, dict[str, int]]:
    """Return the number of the version by alias for each of some policies."""
    found: dict[str, dict[str, int]] = {}
    rows = select(PolicyAlias).where(PolicyAlias.policy_id.in_(policy_ids)).order_by(PolicyAlias.name)
    for row in session.scalars(rows):
        found.setdefault(row.policy_id, {})[row.name] = row.number
    return found


def promote(sessions: Sessions, policy_id: str, alias: str, number: int) -> None:
    """Point an alias at a version; it leaves the one that it named before.

    Raises NotFoundError, and ConflictError if the version has not what the alias requires.
    """
    with sessions.begin() as session:
        policy = _locked(session, policy_id)
        version = session.get(PolicyVersion, (policy_id, number))
        if version is None:
            raise NotFoundError(f"policy {policy.name} has no version {number}")
        _point(session, policy, alias, version)


def require(sessions: Sessions, policy_id: str, alias: str, requirements: Sequence[Requirement]) -> None:
    """Replace what an alias requires of the versions that it will name; it keeps the one that it names now.

    Raises NotFoundError, and InvalidError if the policy's task has not the settings of a condition.
    """
    with sessions.begin() as session:
        promotion.require(session, _locked(session, policy_id), alias, requirements)


def remove_alias(sessions: Sessions, policy_id: str, alias: str) -> None:
    """Remove an alias; its version stays. Raises NotFoundError."""
    with sessions.begin() as session:
        policy = _locked(session, policy_id)
        row = session.get(PolicyAlias, (policy_id, alias))
        if row is None:
            raise NotFoundError(f"policy {policy.name} has no alias {alias!r}")
        session.delete(row)


def delete_version(sessions: Sessions, policy_id: str, number: int) -> None:
    """Delete a version, and the policy with its last one; the checkpoint stays with its job.

    Raises NotFoundError, and ConflictError if the version has an alias or is in use.
    """
    with sessions.begin() as session:
        policy = _locked(session, policy_id)
        version = session.get(PolicyVersion, (policy_id, number))
        if version is None:
            raise NotFoundError(f"policy {policy.name} has no version {number}")
        _require_unused(session, policy, version)
        held = [alias for alias, at in aliases_of(session, [policy_id]).get(policy_id, {}).items() if at == number]
        if held:
            message = f"{policy.name}@{number} has the aliases {', '.join(held)}; move or remove them first"
            raise ConflictError(message, "aliases")
        session.delete(version)
        session.flush()
        if session.scalar(select(PolicyVersion.number).where(PolicyVersion.policy_id == policy_id).limit(1)) is None:
            policy.requirements = {}


def delete_policy(sessions: Sessions, policy_id: str) -> None:
    """Delete a policy with all versions and aliases; the checkpoints stay with their jobs.

    Raises NotFoundError, and ConflictError if a version is in use.
    """
    with sessions.begin() as session:
        policy = _locked(session, policy_id)
        versions = select(PolicyVersion).where(PolicyVersion.policy_id == policy_id).order_by(PolicyVersion.number)
        _require_unused(session, policy, *session.scalars(versions))
        for model in (PolicyAlias, PolicyVersion):
            session.execute(delete(model).where(model.policy_id == policy_id))
        policy.requirements = {}


def _require_unused(session: Session, policy: PolicyRecord, *versions: PolicyVersion) -> None:
    """Raise ConflictError if a running study or an open match uses one of these versions of a locked policy."""
    users = in_use(session, policy.owner)
    for version in versions:
        if (user := users.get(version.checkpoint_id)) is not None:
            raise ConflictError(f"{user} uses {policy.name}@{version.number}; wait for its end, or cancel it")


def _locked(session: Session, policy_id: str) -> PolicyRecord:
    policy = session.scalar(select(PolicyRecord).where(PolicyRecord.id == policy_id).with_for_update())
    if policy is None:
        raise NotFoundError("the policy was deleted just now")
    return policy
