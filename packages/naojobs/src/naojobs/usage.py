"""Use of the workers by owner and day, which stays when jobs are deleted."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date

from sqlalchemy import Date, Double, cast, func, literal, select
from sqlalchemy.dialects.postgresql import insert

from naojobs.database import Sessions
from naojobs.leases import Lease
from naojobs.models import Job, Match, OwnerUsage, WorkKind


@dataclass(frozen=True, slots=True)
class UsageSum:
    """What an owner's work has used in a period."""

    owner: str
    cpu_s: float
    """Seconds of processors that attempts were busy."""
    run_s: float
    """Seconds that attempts took."""


def add_usage(sessions: Sessions, lease: Lease, *, cpu_s: float, run_s: float) -> None:
    """Add to today's use of the owner of leased work, also if the lease was lost; deleted work counts no more."""
    model = Match if lease.kind is WorkKind.MATCH else Job
    today = cast(func.now(), Date)
    amounts = (cast(literal(amount), Double) for amount in (cpu_s, run_s))
    new = insert(OwnerUsage).from_select(
        ["owner", "day", "cpu_s", "run_s"],
        select(model.owner, today, *amounts).where(model.id == lease.job_id),
    )
    with sessions.begin() as session:
        session.execute(
            new.on_conflict_do_update(
                index_elements=[OwnerUsage.owner, OwnerUsage.day],
                set_={
                    "cpu_s": OwnerUsage.cpu_s + new.excluded.cpu_s,
                    "run_s": OwnerUsage.run_s + new.excluded.run_s,
                },
            )
        )


def usage_by_owner(
    sessions: Sessions, *, since: date | None = None, until: date | None = None, owner: str | None = None
) -> list[UsageSum]:
    """Return the sums of owners, or of one, from a day up to and including another; the largest first."""
    cpu_s = func.sum(OwnerUsage.cpu_s)
    statement = select(OwnerUsage.owner, cpu_s, func.sum(OwnerUsage.run_s)).group_by(OwnerUsage.owner)
    if since is not None:
        statement = statement.where(OwnerUsage.day >= since)
    if until is not None:
        statement = statement.where(OwnerUsage.day <= until)
    if owner is not None:
        statement = statement.where(OwnerUsage.owner == owner)
    with sessions.begin() as session:
        return [UsageSum(*row) for row in session.execute(statement.order_by(cpu_s.desc(), OwnerUsage.owner))]
