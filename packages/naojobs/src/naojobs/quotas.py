"""Quotas: what an owner may have at most, and what to do about it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import timedelta
from enum import Enum
from typing import Any, TypeAlias

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from naojobs.errors import QuotaError
from naojobs.models import (
    Checkpoint,
    Evaluation,
    Job,
    Match,
    PolicyRecord,
    PolicyVersion,
    Study,
    TeamRecord,
    Token,
    Webhook,
)
from naojobs.states import OPEN, WorkState


@dataclass(frozen=True, slots=True)
class _Kind:
    what: str
    remedy: str
    """What gives the owner room again."""
    amounts: Callable[[str], tuple[Any, ...]]
    """Queries, by owner, of amounts that add up."""


def _sum(column: Any) -> Any:
    return func.coalesce(func.sum(column), 0)


def _sizes(owner: str) -> tuple[Any, ...]:
    tables = (Checkpoint, Evaluation)
    of_jobs = (select(_sum(table.size)).join(Job, Job.id == table.job_id).where(Job.owner == owner) for table in tables)
    return (*of_jobs, *(select(_sum(table.size)).where(table.owner == owner) for table in (Match, TeamRecord)))


def _numbers(owner: str, states: Iterable[WorkState]) -> tuple[Any, ...]:
    return tuple(
        select(func.count(table.id)).where(table.owner == owner, table.state.in_(states)) for table in (Job, Match)
    )


def _versions(what: Any, owner: str) -> Any:
    return (
        select(what).join(PolicyRecord, PolicyRecord.id == PolicyVersion.policy_id).where(PolicyRecord.owner == owner)
    )


class Quota(Enum):
    """Quota of an owner."""

    OPEN_JOBS = _Kind(
        "open jobs and matches",
        "wait until some finish, or cancel some",
        lambda owner: _numbers(owner, OPEN),
    )
    JOBS = _Kind(
        "jobs and matches, open and ended",
        "delete ended ones",
        lambda owner: _numbers(owner, WorkState),
    )
    EVALUATIONS = _Kind(
        "evaluations",
        "delete jobs",
        lambda owner: (
            select(func.count(Evaluation.id)).join(Job, Job.id == Evaluation.job_id).where(Job.owner == owner),
        ),
    )
    STUDIES = _Kind(
        "studies", "delete ended ones", lambda owner: (select(func.count(Study.id)).where(Study.owner == owner),)
    )
    NOTES = _Kind(
        "bytes of notes",
        "shorten some, or delete jobs or versions of policies",
        lambda owner: (
            select(_sum(func.octet_length(Job.notes))).where(Job.owner == owner),
            _versions(_sum(func.octet_length(PolicyVersion.notes)), owner),
        ),
    )
    """Bytes of the notes of jobs and of versions of policies."""
    TOKENS = _Kind(
        "tokens that are valid or less than a day old",
        "revoke older ones, or try again tomorrow",
        lambda owner: (
            select(func.count(Token.id)).where(
                Token.owner == owner,
                (Token.revoked_at.is_(None) & (Token.expires_at.is_(None) | (Token.expires_at > func.now())))
                | (Token.created_at > func.now() - timedelta(days=1)),
            ),
        ),
    )
    """Revoked tokens stay in the table for a month, so those of the last day count, too: that bounds how fast it
    grows.
    """
    WEBHOOKS = _Kind(
        "webhooks", "delete some", lambda owner: (select(func.count(Webhook.id)).where(Webhook.owner == owner),)
    )
    VERSIONS = _Kind(
        "versions of policies", "delete some", lambda owner: (_versions(func.count(PolicyVersion.number), owner),)
    )
    BYTES = _Kind("bytes in the store", "delete jobs, matches or teams", _sizes)
    ROWS = _Kind(
        "rows in the database",
        "delete jobs or matches",
        lambda owner: tuple(select(_sum(table.row_count)).where(table.owner == owner) for table in (Job, Match)),
    )
    """Rows of metrics, logs and events of jobs and matches."""


SPACE = (Quota.BYTES, Quota.ROWS)
"""What fills up while work runs: all that queues work requires room in it."""

Limits: TypeAlias = Mapping[Quota, int]
"""What each owner may have at most; a quota that is left out has no limit."""
NO_LIMITS: Limits = {}


def wait_for_turn(session: Session, owner: str | None, limits: Limits, *quotas: Quota) -> None:
    """Wait until no other transaction uses these quotas of an owner, before rows are locked: that prevents deadlocks.

    Args:
        session: the database.
        owner: none for a row that is gone, for which nothing is awaited.
        limits: quotas without a limit are left out.
        quotas: all that the transaction will require.
    """
    limited = [quota for quota in Quota if quota in quotas and quota in limits]  # one order prevents deadlocks, too
    if owner is not None and limited:
        keys = (func.hashtextextended(f"quota {quota.name} {owner}", 0) for quota in limited)
        session.execute(select(*map(func.pg_advisory_xact_lock, keys)))


def require_room(session: Session, owner: str, limits: Limits, *quotas: Quota, more: int = 1) -> None:
    """Raise QuotaError if `owner` has no room for `more` in one of `quotas`.

    Others that require the same of this owner wait until the transaction has ended: two concurrent requests must not
    both see the last free place. A transaction that has locked rows before has to begin with `wait_for_turn`.
    """
    wait_for_turn(session, owner, limits, *quotas)
    for quota in quotas:
        if (most := limits.get(quota)) is None:
            continue
        kind = quota.value
        count = session.scalar(select(sum(query.scalar_subquery() for query in kind.amounts(owner)))) or 0
        if count + more > most:
            adding = f" and would get {more:,} more" if more > 1 else ""
            raise QuotaError(f"{owner} has {count:,} {kind.what}{adding}, of {most:,} that are allowed; {kind.remedy}")
