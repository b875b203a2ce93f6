"""Find what was lost: jobs of dead workers, doorbells of a dead broker, processes of a dead worker."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from datetime import timedelta

from naojobs import lifecycle, records, registry
from naojobs.models import Evaluation, Job
from naojobs.states import EvaluationState, JobState
from naosim.launchers import reap_servers
from sqlalchemy import Select, func, select, text

from naosprint_worker.context import Context
from naosprint_worker.orphans import OrphanSweeper

logger = logging.getLogger(__name__)


_LONGEST_LEASES = 5
"""No worker of the same service has a lease so many times as long as this one's."""


class Reaper:
    """Sweep now and then; any number of workers may do so at once."""

    def __init__(self, context: Context, *, free_slots: Callable[[], int]) -> None:
        """Prepare; ``free_slots`` tells how many more jobs this worker could take now."""
        self._context = context
        self._free_slots = free_slots
        self._orphans = OrphanSweeper(grace_s=context.settings.worker_orphan_grace_s + 5)
        self._trouble_at: float | None = None

    def database_failed(self) -> None:
        """Note that the database did not answer this worker: it may not have answered the others' heartbeats either."""
        self._trouble_at = time.monotonic()

    def sweep(self) -> None:
        """Look once for everything."""
        for pid in self._orphans.sweep():
            logger.warning("ended process %d, whose worker is gone", pid)
        self._remove_servers()
        self._take_back()
        self._ring_again()
        registry.forget(self._context.sessions)

    def _remove_servers(self) -> None:
        """Remove the containers of servers whose training is gone."""
        try:
            removed = reap_servers(self._context.settings.simserver)
        except OSError as error:
            logger.warning("looking for servers without an owner: %s", error)
        else:
            if removed:
                logger.warning("removed %d servers, whose training is gone", removed)

    def _take_back(self) -> None:
        """Take stale leases back, but only once their owners have had time to renew them since the last outage."""
        context = self._context
        lease_s = context.settings.lease_s
        if self._trouble_at is not None and time.monotonic() - self._trouble_at < lease_s:
            return
        with context.sessions() as session:
            up_for = session.scalar(text("SELECT clock_timestamp() - pg_postmaster_start_time()"))
        # less than nothing: its clock was set back since
        if up_for is None or timedelta() <= up_for < timedelta(seconds=lease_s):
            return
        lifecycle.cut_leases(context.sessions, _LONGEST_LEASES * lease_s)
        for lost in lifecycle.requeue_stale(context.sessions):
            logger.warning("job %s was lost by its worker and is now %s", lost.job_id, lost.state)
            if lost.state is JobState.QUEUED:
                context.announce_job(lost.job_id)
        records.requeue_stale_evaluations(context.sessions)

    def _ring_again(self) -> None:
        """Announce what waits while this worker has nothing to do: its message must have been lost.

        A busy worker rings for nobody, so a long queue does not fill the broker with doubles.
        """
        context, free = self._context, self._free_slots()
        if free <= 0:
            return
        with context.sessions() as session:
            jobs = session.scalars(self._waiting_jobs().limit(free)).all()
            evaluations = session.scalars(self._waiting_evaluations().limit(free)).all()
        for job_id in jobs:
            context.announce_job(job_id)
        for evaluation_id in evaluations:
            context.announce_evaluation(evaluation_id)

    def _waiting_jobs(self) -> Select[str]:
        return (
            select(Job.id)
            .where(
                Job.state == JobState.QUEUED,
                Job.queue.in_(self._context.settings.worker_queues),
                (Job.rung_at.is_(None)) | (Job.rung_at < func.now() - self._ring_after()),
                Job.queued_at < func.now() - self._ring_after(),
            )
            .order_by(Job.priority.desc(), Job.queued_at)
        )

    def _waiting_evaluations(self) -> Select[str]:
        return (
            select(Evaluation.id)
            .where(
                Evaluation.state == EvaluationState.QUEUED,
                Evaluation.queue.in_(self._context.settings.worker_queues),
                (Evaluation.rung_at.is_(None)) | (Evaluation.rung_at < func.now() - self._ring_after()),
            )
            .order_by(Evaluation.created_at)
        )

    def _ring_after(self) -> timedelta:
        return timedelta(seconds=self._context.settings.worker_ring_s)
