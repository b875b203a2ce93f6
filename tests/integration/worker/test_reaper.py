"""Which workers of a service look for lost work."""

from __future__ import annotations

from naojobs import lifecycle, submission
from naojobs.models import Job
from naojobs.submission import JobRequest
from naosprint_worker.reaper import LostWork
from sqlalchemy import text
from sqlalchemy.orm import Session, sessionmaker


def test_few_of_many_workers_look_for_lost_work(sessions: sessionmaker[Session]) -> None:
    job, _ = submission.submit(sessions, JobRequest(), owner="alice")
    assert lifecycle.claim(sessions, Job, job.id, "worker-1") is not None
    with sessions.begin() as session:
        session.execute(text("UPDATE jobs SET lease_expires_at = 'epoch'"))
    lost = LostWork(sessions, lease_s=0.001)
    lost.workers = 10**9
    assert not any(lost.sweep() for _ in range(100))
    lost.workers = 10
    assert [requeued.id for requeued in lost.sweep()] == [job.id]
