"""Which workers of a service look for lost work."""

from __future__ import annotations

from naojobs.models import Job
from naosprint_worker.reaper import LostWork
from sqlalchemy import text

from tests.integration.attempts import claim_work

from .conftest import Service


def test_few_of_many_workers_look_for_lost_work(service: Service) -> None:
    job_id = service.submit(announce=False)
    assert claim_work(service.sessions, Job, job_id, "worker-1") is not None
    with service.sessions.begin() as session:
        session.execute(text("UPDATE jobs SET lease_expires_at = 'epoch'"))
    lost = LostWork(service.sessions, lease_s=0.001)
    lost.workers = 10**9
    assert not any(lost.sweep() for _ in range(100))
    lost.workers = 10
    assert [requeued.id for requeued in lost.sweep()] == [job_id]
