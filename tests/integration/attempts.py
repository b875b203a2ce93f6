"""Claims of one chosen piece of work, where a worker would take the next one."""

from __future__ import annotations

from typing import overload

from naojobs import leases
from naojobs.capabilities import Capabilities
from naojobs.database import Sessions
from naojobs.leases import Claim, EvaluationClaim, JobClaim, MatchClaim
from naojobs.models import AnyWork, Evaluation, Job, Match


@overload
def claim_work(
    sessions: Sessions,
    model: type[Job],
    work_id: str,
    worker: str,
    *,
    capabilities: Capabilities | None = None,
    lease_s: float = leases.DEFAULT_LEASE_S,
) -> JobClaim | None: ...
@overload
def claim_work(
    sessions: Sessions,
    model: type[Evaluation],
    work_id: str,
    worker: str,
    *,
    capabilities: Capabilities | None = None,
    lease_s: float = leases.DEFAULT_LEASE_S,
) -> EvaluationClaim | None: ...
@overload
def claim_work(
    sessions: Sessions,
    model: type[Match],
    work_id: str,
    worker: str,
    *,
    capabilities: Capabilities | None = None,
    lease_s: float = leases.DEFAULT_LEASE_S,
) -> MatchClaim | None: ...
def claim_work(
    sessions: Sessions,
    model: type[AnyWork],
    work_id: str,
    worker: str,
    *,
    capabilities: Capabilities | None = None,
    lease_s: float = leases.DEFAULT_LEASE_S,
) -> Claim | None:
    """Claim one piece of work, with the product's own statements; None if it does not wait for such a worker."""
    with sessions.begin() as session:
        waiting = leases.waiting(model).where(model.id == work_id)
        if capabilities is not None:
            waiting = waiting.where(capabilities.condition(model))
        work = session.scalar(waiting.with_for_update())
        return None if work is None else leases.take(session, work, worker, lease_s)
