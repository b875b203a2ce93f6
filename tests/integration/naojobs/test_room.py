"""Room for urgent work: which training is asked for it, and what a drained worker still does."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import timedelta
from typing import Any

import pytest
from naojobs import leases, outcomes, preemption, registry, submission
from naojobs.capabilities import MATCH_QUEUE, MATCH_VERSION, Capabilities, match_task
from naojobs.leases import Lease
from naojobs.matches import ROBOT, MatchRequest, submit_match
from naojobs.models import Event, Job, Match
from naojobs.states import WorkState
from naojobs.submission import JobRequest
from sqlalchemy import delete, select, text, update
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work

Sessions = sessionmaker[Session]

CAPABLE = Capabilities({"sprint1": 1}, ["nao-0"], ["embedded"], ["ppo"])
PLAYS = Capabilities(
    {match_task(confined=False, contained=False): MATCH_VERSION, **CAPABLE.tasks},
    [ROBOT, *CAPABLE.robots],
    [MATCH_QUEUE, *CAPABLE.simulators],
    CAPABLE.algorithms,
)
"""Capabilities of a worker that plays matches, too."""


@pytest.fixture(autouse=True)
def worker(sessions: Sessions) -> Iterator[str]:
    """A registered worker; no job and no match is left of other tests."""
    with sessions.begin() as session:
        session.execute(delete(Job))
        session.execute(delete(Match))
    registry.beat(sessions, "w", host="h", pid=1, capabilities=CAPABLE, version="0")
    yield "w"
    registry.leave(sessions, "w")


def submit(sessions: Sessions, priority: int, owner: str = "alice") -> str:
    return submission.submit(sessions, JobRequest(priority=priority), owner=owner)[0].id


def play(sessions: Sessions, priority: int) -> str:
    request = MatchRequest(teams=("example", "example"), games=1, players=1, half_s=1.0, priority=priority)
    return submit_match(sessions, request, owner="alice")[0].id


def train(sessions: Sessions, worker: str, priority: int = 1) -> Lease:
    claim = claim_work(sessions, Job, submit(sessions, priority), worker)
    assert claim is not None
    outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
    return claim.lease


def make_room(sessions: Sessions, worker: str, capabilities: Capabilities = CAPABLE, after_s: float = 0) -> Any:
    return preemption.make_room(sessions, worker, capabilities, by=3, after_s=after_s)


@pytest.mark.parametrize(("priorities", "yields"), [((1, 4), 0), ((4, 1), 1), ((1, 1), 1), ((2, 1, 1, 4), 2)])
def test_the_training_of_lowest_priority_makes_room_the_last_claimed_first(
    sessions: Sessions, worker: str, priorities: tuple[int, ...], yields: int
) -> None:
    trainings = [train(sessions, worker, priority) for priority in priorities]
    urgent = submit(sessions, 9)
    assert make_room(sessions, worker) == (trainings[yields].id, urgent)


def test_only_a_priority_higher_by_the_difference_is_urgent(sessions: Sessions, worker: str) -> None:
    lease = train(sessions, worker, 4)
    submit(sessions, 6)
    assert make_room(sessions, worker) is None
    urgent = submit(sessions, 7)
    assert make_room(sessions, worker) == (lease.id, urgent)


@pytest.mark.parametrize(
    "others",
    [{"tasks": {"sprint1": 2}}, {"robots": ["nao-4"]}, {"simulators": ["server"]}, {"algorithms": ["sac"]}],
    ids=lambda others: next(iter(others)),
)
def test_a_training_makes_no_room_for_what_its_worker_cannot_run(
    sessions: Sessions, worker: str, others: dict[str, Any]
) -> None:
    lease, urgent = train(sessions, worker), submit(sessions, 9)
    assert make_room(sessions, worker, replace(CAPABLE, **others)) is None
    assert make_room(sessions, worker) == (lease.id, urgent)


def test_urgent_work_waits_for_a_free_worker_first(sessions: Sessions, worker: str) -> None:
    lease, urgent = train(sessions, worker), submit(sessions, 9)
    assert make_room(sessions, worker, after_s=60) is None
    with sessions.begin() as session:
        session.execute(update(Job).where(Job.id == urgent).values(queued_at=Job.queued_at - timedelta(seconds=60)))
    assert make_room(sessions, worker, after_s=60) == (lease.id, urgent)


@pytest.mark.parametrize(("match", "job", "first"), [(9, 8, "match"), (8, 9, "job"), (8, 8, "match")])
def test_a_training_makes_room_for_a_match(sessions: Sessions, worker: str, match: int, job: int, first: str) -> None:
    """It is for the more urgent of a match and a job, or for the one that has waited longer."""
    lease = train(sessions, worker)
    urgent = {"match": play(sessions, match), "job": submit(sessions, job)}
    assert make_room(sessions, worker, PLAYS) == (lease.id, urgent[first])


def test_of_two_workers_that_look_at_once_one_makes_room(sessions: Sessions, worker: str) -> None:
    trainings = {name: train(sessions, name).id for name in (worker, "another")}
    urgent = submit(sessions, 9)
    waiting = text(
        "SELECT count(*) FROM pg_locks JOIN pg_database ON pg_database.oid = database "
        "WHERE datname = current_database() AND NOT granted"
    )
    with ThreadPoolExecutor(2) as pool:
        with sessions() as blocking:
            blocking.execute(text("LOCK TABLE events IN SHARE MODE"))  # both have looked before one has recorded it
            made = [pool.submit(make_room, sessions, name) for name in trainings]
            while blocking.scalar(waiting) < len(made):
                assert not any(each.done() for each in made), "it did not look, or recorded nothing"
        rooms = [each.result(30) for each in made]
    with sessions() as session:
        asked = session.scalars(select(Job.id).where(Job.yields_to.is_not(None))).all()
    assert [room for room in rooms if room is not None] == [(job_id, urgent) for job_id in asked]
    assert len(asked) == 1 and asked[0] in trainings.values()


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


@pytest.mark.parametrize("owner", ["alice", "bob"])
def test_the_history_of_a_training_names_no_work_of_another_owner(sessions: Sessions, worker: str, owner: str) -> None:
    training, urgent = train(sessions, worker), submit(sessions, 9, owner)
    assert make_room(sessions, worker) == (training.id, urgent)
    with sessions() as session:
        asked = select(Event).where(Event.job_id == training.id, Event.kind == "requeue_requested")
        event = session.scalars(asked).one()
    assert event.data == ({"for": urgent} if owner == "alice" else {})
    assert urgent not in event.message
