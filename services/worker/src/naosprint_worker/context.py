"""What the parts of one worker share, and how it announces work to all workers."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from naojobs.doorbell import Doorbell
from naojobs.lifecycle import Sessions
from naojobs.models import Evaluation, Job
from naojobs.states import EvaluationState, JobState
from sqlalchemy import func, select, update

from naosprint_worker.settings import WorkerSettings

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Context:
    """Settings, services and identity of a worker."""

    settings: WorkerSettings
    sessions: Sessions
    doorbell: Doorbell
    worker_id: str
    #: Where the working folders of this worker's attempts lie.
    folder: Path

    def announce_job(self, job_id: str) -> None:
        """Ring for a queued job and note it. A broker that is away is no error: the job is announced again later."""
        with self.sessions() as session:
            row = session.execute(select(Job.queue, Job.priority).where(Job.id == job_id)).one_or_none()
        if row is None or self.doorbell.ring_job(job_id, row.queue, row.priority) is not None:
            return
        with self.sessions.begin() as session:
            session.execute(
                update(Job).where(Job.id == job_id, Job.state == JobState.QUEUED).values(rung_at=func.now())
            )

    def announce_evaluation(self, evaluation_id: str) -> None:
        """Ring for a queued evaluation and note it."""
        with self.sessions() as session:
            queue = session.scalar(select(Evaluation.queue).where(Evaluation.id == evaluation_id))
        if queue is None or self.doorbell.ring_evaluation(evaluation_id, queue) is not None:
            return
        with self.sessions.begin() as session:
            session.execute(
                update(Evaluation)
                .where(Evaluation.id == evaluation_id, Evaluation.state == EvaluationState.QUEUED)
                .values(rung_at=func.now())
            )
