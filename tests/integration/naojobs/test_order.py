"""Which waiting job starts next: by priority, which may change, and not before the time that its user set."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from naojobs import leases, outcomes, requests, submission
from naojobs.capabilities import Capabilities, waiting_reasons
from naojobs.errors import ConflictError
from naojobs.models import Job
from naojobs.submission import JobRequest
from sqlalchemy import func, select, update
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work
from tests.integration.writes import refusing

Sessions = sessionmaker[Session]

CAPABLE = Capabilities({"sprint1": 1}, ["nao-0"], ["embedded"], ["ppo"])


def submit(sessions: Sessions, **fields: Any) -> Job:
    return submission.submit(sessions, JobRequest(**fields), owner="alice")[0]


def claim_next(sessions: Sessions) -> str | None:
    claim = leases.claim_next(sessions, "worker-1", models=(Job,), capabilities=CAPABLE)
    return None if claim is None else claim.lease.id


def test_a_queued_jobs_priority_decides_once_it_is_changed(sessions: Sessions) -> None:
    first, second = submit(sessions), submit(sessions)
    assert submission.edit(sessions, second.id, priority=6).priority == 6
    assert [claim_next(sessions), claim_next(sessions)] == [second.id, first.id]
    ended = submit(sessions)
    requests.request_cancel(sessions, Job, ended.id)
    with pytest.raises(ConflictError, match="it is cancelled"):
        submission.edit(sessions, ended.id, priority=1)


def test_a_job_that_the_database_refuses_to_lease_keeps_none_behind_it_waiting(
    sessions: Sessions, caplog: pytest.LogCaptureFixture
) -> None:
    first, second = submit(sessions, priority=9), submit(sessions)
    with refusing(sessions, "jobs", "NEW.priority = 9"):
        assert claim_next(sessions) == second.id
        assert f"{first.id} cannot be claimed" in caplog.text
    assert claim_next(sessions) == first.id


def test_a_full_disk_of_the_database_is_tried_with_one_job(
    sessions: Sessions, caplog: pytest.LogCaptureFixture
) -> None:
    """It would refuse each of a thousand, with a traceback for each; and the worker has not run out of work."""
    jobs = [submit(sessions).id for _ in range(3)]
    with refusing(sessions, "jobs", error="disk_full"), pytest.raises(OperationalError):
        claim_next(sessions)
    assert "cannot be claimed" not in caplog.text
    assert [claim_next(sessions) for _ in jobs] == jobs


def test_a_job_starts_at_its_time_or_later(sessions: Sessions) -> None:
    """Also one whose time is further ahead than any postponed attempt's, which a clock set back would explain."""
    tomorrow = datetime.now(UTC) + timedelta(days=1)
    job = submit(sessions, not_before=tomorrow)
    assert claim_next(sessions) is None
    with sessions.begin() as session:
        reasons = waiting_reasons(session, [session.get_one(Job, job.id)], [])
    assert reasons[job.id] == f"it is to start at {tomorrow:%Y-%m-%d %H:%M} UTC or later"
    with sessions.begin() as session:
        session.execute(update(Job).where(Job.id == job.id).values(not_before=func.now() - timedelta(seconds=1)))
    assert claim_next(sessions) == job.id


@pytest.mark.parametrize("way", ["pause", "cancel"])
def test_a_job_that_is_queued_again_keeps_its_time(sessions: Sessions, way: str) -> None:
    """The user's, not that of the next attempt at a service which was gone."""
    tomorrow = datetime.now(UTC) + timedelta(days=1)
    job = submit(sessions, not_before=tomorrow)

    def again() -> datetime | None:
        if way == "pause":
            requests.request_pause(sessions, job.id)
            return requests.resume(sessions, job.id).not_before
        requests.request_cancel(sessions, Job, job.id)
        return requests.retry(sessions, Job, job.id).not_before

    assert again() == tomorrow
    assert claim_next(sessions) is None
    with sessions.begin() as session:
        session.execute(update(Job).where(Job.id == job.id).values(not_before=func.now() - timedelta(seconds=1)))
    claim = claim_work(sessions, Job, job.id, "worker-1")
    assert claim is not None
    outcomes.postpone(sessions, claim.lease, "the store was gone")
    assert claim_next(sessions) is None
    assert again() is None
    assert claim_next(sessions) == job.id


def test_the_same_key_with_another_time_is_another_request(sessions: Sessions) -> None:
    request = JobRequest(not_before=datetime(2030, 1, 1, tzinfo=UTC))
    assert request.digest() != JobRequest().digest()
    job, _ = submission.submit(sessions, request, owner="alice", idempotency_key="k")
    again, created = submission.submit(sessions, request, owner="alice", idempotency_key="k")
    assert (again.id, created) == (job.id, False)
    with sessions.begin() as session:
        assert session.scalar(select(Job.not_before).where(Job.id == job.id)) == request.not_before
