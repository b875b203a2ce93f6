"""A worker claims only work that it can run, in the order of priority and waiting time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import pytest
from naojobs import leases, registry, submission
from naojobs.capabilities import Capabilities, live_workers, waiting_reasons
from naojobs.leases import Claim
from naojobs.models import Evaluation, Job
from naojobs.states import WorkState
from naojobs.submission import JobRequest
from naospec import EvaluationSpec, TrainingSpec
from naospec.flat import nest
from sqlalchemy import delete, update
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work
from tests.integration.writes import record_checkpoint, request_evaluation

Sessions = sessionmaker[Session]

ALL = Capabilities({"sprint1": 1, "sprint2": 1}, ["nao-0", "nao-1"], ["embedded", "server"], ["ppo"])


@pytest.fixture(autouse=True)
def empty(sessions: Sessions) -> Iterator[None]:
    """No work waits before and after a test."""
    yield
    with sessions.begin() as session:
        session.execute(delete(Job))
    registry.forget(sessions, after_s=-1)


@pytest.fixture
def submit(sessions: Sessions) -> Callable[..., str]:
    def submit(priority: int = 5, **spec: Any) -> str:
        request = JobRequest(TrainingSpec.model_validate(nest(spec)), priority=priority)
        return submission.submit(sessions, request, owner="alice")[0].id

    return submit


def claim_next(sessions: Sessions, capabilities: Capabilities = ALL, **options: Any) -> Claim | None:
    return leases.claim_next(sessions, "w", **{"capabilities": capabilities, **options})


def claimed(sessions: Sessions, capabilities: Capabilities = ALL, **options: Any) -> str | None:
    claim = claim_next(sessions, capabilities, **options)
    return None if claim is None else claim.lease.id


@pytest.mark.parametrize(
    "less",
    [
        Capabilities({"sprint1": 1}, ["nao-1"], ["embedded"], ["ppo"]),
        Capabilities({"sprint2": 2}, ["nao-1"], ["embedded"], ["ppo"]),
        Capabilities({"sprint2": 1}, ["nao-0"], ["embedded"], ["ppo"]),
        Capabilities({"sprint2": 1}, ["nao-1"], ["server"], ["ppo"]),
        Capabilities({"sprint2": 1}, ["nao-1"], ["embedded"], ["sac"]),
        Capabilities({}, [], [], []),
    ],
)
def test_a_worker_that_lacks_something_leaves_the_job_to_others(
    sessions: Sessions, submit: Callable[..., str], less: Capabilities
) -> None:
    job_id = submit(task="sprint2", robot="nao-1")
    assert claim_work(sessions, Job, job_id, "w", capabilities=less) is None
    assert claimed(sessions, less) is None
    other = submit(task="sprint1") if "sprint1" in less.tasks and "nao-0" in less.robots else None
    assert claimed(sessions, less) == other
    assert claimed(sessions, Capabilities({"sprint2": 1}, ["nao-1"], ["embedded"], ["ppo"])) == job_id


def test_a_job_of_another_task_version_waits_for_a_worker_that_has_it(
    sessions: Sessions, submit: Callable[..., str]
) -> None:
    job_id = submit()
    with sessions.begin() as session:
        session.execute(update(Job).values(task_version=2))
    assert claimed(sessions) is None
    assert claimed(sessions, Capabilities({"sprint1": 2}, ["nao-0"], ["embedded"], ["ppo"])) == job_id


def test_work_is_claimed_by_priority_and_waiting_time_in_the_simulators_of_a_worker(
    sessions: Sessions, submit: Callable[..., str]
) -> None:
    low, first, second, urgent = submit(1), submit(), submit(), submit(9, simulator="server")
    assert claimed(sessions, replace(ALL, simulators=["embedded"])) == first
    assert [claimed(sessions) for _ in range(4)] == [urgent, second, low, None]


def test_evaluations_are_claimed_beside_jobs(sessions: Sessions, submit: Callable[..., str]) -> None:
    trained = claim_work(sessions, Job, submit(), "w")
    assert trained is not None
    record_checkpoint(sessions, trained.lease, step=1, key=trained.lease.id, manifest={"files": []})
    waiting = submit()
    spec = EvaluationSpec(task="sprint2")
    evaluation = request_evaluation(sessions, trained.lease.job_id, spec=spec).id
    assert (
        claimed(sessions, Capabilities({"sprint1": 1}, ["nao-0"], ["embedded"], ["ppo"]), models=[Evaluation]) is None
    )
    assert claimed(sessions, models=[Evaluation]) == evaluation
    assert claimed(sessions, models=[Evaluation]) is None
    assert claimed(sessions) == waiting


def test_many_workers_that_look_at_once_share_the_work(sessions: Sessions, submit: Callable[..., str]) -> None:
    jobs = [submit() for _ in range(12)]

    def work(_: int) -> list[str]:
        found = []
        while (job_id := claimed(sessions)) is not None:
            found.append(job_id)
        return found

    with ThreadPoolExecutor(4) as pool:
        shares = list(pool.map(work, range(4)))
    assert sorted(job_id for share in shares for job_id in share) == sorted(jobs)


def test_the_reason_for_waiting_names_what_no_worker_has(sessions: Sessions, submit: Callable[..., str]) -> None:
    job_id = submit(task="sprint2", robot="nao-1", simulator="server")

    def reason(stale_s: float = 30.0) -> str | None:
        with sessions() as session:
            return waiting_reasons(session, [session.get_one(Job, job_id)], live_workers(session, stale_s=stale_s)).get(
                job_id
            )

    def beat(worker: str, *capabilities: Any) -> None:
        has = Capabilities(*capabilities[:3], capabilities[3] if len(capabilities) > 3 else ["ppo"])
        registry.beat(sessions, worker, host="h", pid=1, capabilities=has, version="1")

    assert reason() == "no worker is running"
    beat("a", {"sprint1": 1}, ["nao-0"], ["embedded"])
    assert reason() == "no worker has simulator 'server'"
    beat("a", {"sprint1": 1}, ["nao-0"], ["server"])
    assert reason() == "no worker has robot 'nao-1'"
    beat("a", {"sprint2": 1}, ["nao-1"], ["server"], ["sac"])
    assert reason() == "no worker has algorithm 'ppo'"
    beat("a", {"sprint1": 1}, ["nao-1"], ["server"])
    assert reason() == "no worker has task 'sprint2' version 1"
    beat("a", {"sprint2": 2}, ["nao-1"], ["server"])
    assert reason() == "no worker has task 'sprint2' version 1 (workers have version 2)"
    beat("b", {"sprint2": 1}, ["nao-0"], ["server"])
    assert (reason() or "").startswith("no single worker has task 'sprint2' version 1, robot 'nao-1'")
    beat("b", {"sprint2": 1}, ["nao-1"], ["server"])
    assert reason() is None
    assert reason(stale_s=-1) == "no worker is running"
    assert claimed(sessions) == job_id
    with sessions() as session:
        job = session.get_one(Job, job_id)
        assert job.state is WorkState.STARTING
        assert waiting_reasons(session, [job], live_workers(session, stale_s=-1)) == {}
