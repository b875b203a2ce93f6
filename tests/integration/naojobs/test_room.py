"""Room for urgent work: which training is asked for it, and what a drained worker still does."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from naojobs import leases, outcomes, preemption, registry, submission
from naojobs.capabilities import Capabilities
from naojobs.leases import Lease
from naojobs.models import Job
from naojobs.states import WorkState
from naojobs.submission import JobRequest
from sqlalchemy import delete
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work

Sessions = sessionmaker[Session]

CAPABLE = Capabilities({"sprint1": 1}, ["nao-0"], ["embedded"], ["ppo"])


@pytest.fixture(autouse=True)
def worker(sessions: Sessions) -> Iterator[str]:
    """A registered worker; no job is left of other tests."""
    with sessions.begin() as session:
        session.execute(delete(Job))
    registry.beat(sessions, "w", host="h", pid=1, capabilities=CAPABLE, version="0")
    yield "w"
    registry.leave(sessions, "w")


def submit(sessions: Sessions, priority: int) -> str:
    return submission.submit(sessions, JobRequest(priority=priority), owner="alice")[0].id


def train(sessions: Sessions, worker: str) -> Lease:
    claim = claim_work(sessions, Job, submit(sessions, 1), worker)
    assert claim is not None
    outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
    return claim.lease


def make_room(sessions: Sessions, worker: str) -> Any:
    return preemption.make_room(sessions, worker, CAPABLE, by=3, after_s=0)


def test_another_training_makes_room_if_the_first_one_has_come_to_its_evaluation(
    sessions: Sessions, worker: str
) -> None:
    trainings = {lease.id: lease for lease in (train(sessions, worker), train(sessions, worker))}
    urgent = submit(sessions, 9)
    first, _ = make_room(sessions, worker)
    assert make_room(sessions, worker) is None
    lease = trainings.pop(first)
    outcomes.transition(sessions, lease, WorkState.EVALUATING)
    assert not leases.read_requests(sessions, lease).requeue
    assert make_room(sessions, worker) == (*trainings, urgent)


def test_a_drained_worker_makes_no_room(sessions: Sessions, worker: str) -> None:
    """It would not claim what waits, and its training would have stopped for nothing."""
    lease, urgent = train(sessions, worker), submit(sessions, 9)
    registry.drain(sessions, worker)
    assert make_room(sessions, worker) is None
    registry.undrain(sessions, worker)
    assert make_room(sessions, worker) == (lease.id, urgent)


def test_a_drain_finds_what_was_being_claimed(sessions: Sessions, worker: str, monkeypatch: pytest.MonkeyPatch) -> None:
    job_id = submit(sessions, 5)
    drain = threading.Thread(target=registry.drain, args=(sessions, worker), kwargs={"requeue": True})
    waiting = leases.waiting

    def interrupted(model: Any) -> Any:
        drain.start()
        drain.join(1)
        return waiting(model)

    monkeypatch.setattr(leases, "waiting", interrupted)
    claim = leases.claim_next(sessions, worker, models=(Job,), capabilities=CAPABLE)
    drain.join(30)
    with sessions() as session:
        assert session.get_one(Job, job_id).yields_to == (worker if claim is not None else None)
    assert claim is not None and leases.read_requests(sessions, claim.lease).requeue
