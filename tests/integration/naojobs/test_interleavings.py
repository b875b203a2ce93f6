"""Requests of users, workers and their deaths in any order: the table of transitions holds, and a cancel is kept."""

from __future__ import annotations

import contextlib
import itertools
import re
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from random import Random
from typing import Any

import pytest
from naojobs import leases, matches, outcomes, policies, requests, studies, submission
from naojobs.capabilities import Capabilities
from naojobs.database import Sessions
from naojobs.errors import ConflictError, LeaseLostError, NotFoundError
from naojobs.leases import JobClaim
from naojobs.matches import MatchRequest
from naojobs.models import Evaluation, Event, Job
from naojobs.quotas import Quota
from naojobs.settings import ServiceSettings
from naojobs.states import LEASED, WorkState
from naojobs.studies import StudyRequest
from naojobs.submission import EvaluationRequest, GroupRequest, JobRequest
from naospec.search import SearchSpec
from naosprint_worker.context import WorkerContext
from naosprint_worker.memory import MemoryBudget
from naosprint_worker.outcome import SERVICE_UNAVAILABLE, Outcome, TrainerExitCode
from naosprint_worker.runs import Run
from naosprint_worker.settings import WorkerSettings
from naosprint_worker.supervisor import Ending, Intent
from sqlalchemy import Engine, event, func, select, text, update

from tests.integration.attempts import claim_work
from tests.integration.history import states_of, violations
from tests.integration.writes import record_checkpoint, refusing, request_evaluation

REQUESTS = ("cancel", "pause", "resume", "retry", "delete")
ENDS = ("finished", "crashed", "failed", "unavailable", "stalled", "memory", "crowded", "time_limit")
"""How a child may end by itself, beside by a stop that it was asked for."""
ACTIONS = ("request", "request", "run", "evaluate", "checkpoint", "look", "shut down", "end", "expire")
"""What may happen next to a job; requests twice as often."""


def ending(how: str, intent: Intent) -> Ending:
    """Return the end of a child whose supervisor had noted ``intent``."""
    codes = {
        "finished": TrainerExitCode.FINISHED,
        "stopped": TrainerExitCode.STOPPED,
        "failed": TrainerExitCode.PERMANENT,
    }
    intents = {
        "stalled": Intent.STALLED,
        "memory": Intent.MEMORY,
        "crowded": Intent.CROWDED,
        "time_limit": Intent.TIME_LIMIT,
    }
    outcome = None
    if how == "unavailable":
        outcome = Outcome(TrainerExitCode.TRANSIENT, SERVICE_UNAVAILABLE, "the store did not answer")
    elif how in codes:
        outcome = Outcome(codes[how], how, f"the training {how}")
    code = -9 if outcome is None else outcome.code
    return Ending(max(intent, intents.get(how, intent)), code, outcome, False, 0, False, "")


class Attempt:
    """What a worker and its child do in one attempt, one transaction at a time, without the training."""

    def __init__(self, context: WorkerContext, claim: JobClaim, steps: itertools.count[int]) -> None:
        self._context, self.lease, self._steps = context, claim.lease, steps
        self._run = Run(context, claim)
        self.intent = Intent.NONE
        self.ended = False

    @property
    def _state(self) -> WorkState:
        return leases.read_requests(self._context.sessions, self.lease).state

    def do(self, action: str, random: Random) -> None:
        """Do the next step of an attempt, where its state allows it. Raises LeaseLostError."""
        sessions, state = self._context.sessions, self._state
        if action == "run" and state in (WorkState.STARTING, WorkState.PAUSING):
            with contextlib.suppress(ConflictError):  # a pause was requested first
                outcomes.transition(sessions, self.lease, WorkState.RUNNING)
        elif action == "evaluate" and state in (WorkState.RUNNING, WorkState.PAUSING):
            outcomes.transition(sessions, self.lease, WorkState.EVALUATING)
        elif action == "checkpoint":
            step = next(self._steps)
            key = f"jobs/{self.lease.job_id}/checkpoints/{step}"
            record_checkpoint(sessions, self.lease, step=step, key=key, manifest={"files": []})
        elif action == "look":
            requests = leases.read_requests(sessions, self.lease)
            if requests.cancel:
                self.intent = max(self.intent, Intent.CANCEL)
            elif requests.state is WorkState.PAUSING:
                self.intent = max(self.intent, Intent.PAUSE)
        elif action == "shut down":
            self.intent = max(self.intent, Intent.SHUTDOWN)
        elif action == "end":
            ways = ENDS if self.intent is Intent.NONE else ("stopped", *ENDS)
            how = random.choice(ways)
            self.end("crashed" if how == "finished" and state is WorkState.STARTING else how)

    def end(self, how: str) -> None:
        """Settle as the worker does."""
        self.ended = True
        self._run._settle(ending(how, self.intent))


class World:
    """A job, and what can happen to it."""

    def __init__(self, context: WorkerContext) -> None:
        self.sessions = context.sessions
        self._context = context
        self.job_id = submission.submit(self.sessions, JobRequest(), owner="tester")[0].id
        self._steps = itertools.count(1)

    def request(self, name: str) -> bool:
        """Do what a user asks for; return whether it was acknowledged."""
        calls: dict[str, Callable[[], object]] = {
            "cancel": lambda: requests.request_cancel(self.sessions, Job, self.job_id),
            "pause": lambda: requests.request_pause(self.sessions, self.job_id),
            "resume": lambda: requests.resume(self.sessions, self.job_id),
            "retry": lambda: requests.retry(self.sessions, Job, self.job_id),
            "delete": lambda: requests.delete(self.sessions, self.job_id),
        }
        try:
            calls[name]()
        except (ConflictError, NotFoundError):
            return False
        return True

    def claim(self) -> Attempt | None:
        with self.sessions.begin() as session:  # a delay after an outage is of no interest here
            session.execute(update(Job).where(Job.id == self.job_id).values(not_before=None))
        claim = claim_work(self.sessions, Job, self.job_id, self._context.worker_id)
        return None if claim is None else Attempt(self._context, claim, self._steps)

    def expire(self) -> None:
        """Expire the lease, as if its worker had died."""
        with self.sessions.begin() as session:
            leased = (Job.id == self.job_id, Job.lease_owner.is_not(None))
            session.execute(update(Job).where(*leased).values(lease_expires_at=text("'epoch'")))
        outcomes.requeue_stale(self.sessions)

    def check(self) -> WorkState | None:
        """Check the job's history; return its state, none if it was deleted."""
        with self.sessions() as session:
            job = session.get(Job, self.job_id)
            kinds = session.scalars(select(Event.kind).where(Event.job_id == self.job_id).order_by(Event.id)).all()
        if job is None:
            return None
        assert violations(kinds) == [], kinds
        assert list(states_of(kinds))[-1] is job.state, (job.state, kinds)
        assert not (job.cancel_requested and job.state not in LEASED), (job.state, kinds)
        return job.state


@pytest.fixture
def context(service_settings: ServiceSettings, sessions: Sessions, tmp_path: Path) -> WorkerContext:
    """A worker's context."""
    everything = Capabilities({"sprint1": 1}, ["nao-0"], ["embedded"], ["ppo"])
    settings = WorkerSettings.model_validate(service_settings.model_dump())
    return WorkerContext(settings, sessions, "worker", everything, tmp_path, MemoryBudget(1 << 40))


@pytest.mark.parametrize("seed", range(3))
def test_any_order_of_transactions_follows_the_table(context: WorkerContext, seed: int) -> None:
    random = Random(seed)
    world, attempt = World(context), None
    for _ in range(150):
        if attempt is None:
            attempt = world.claim()
        action = random.choice(
            ["request", "request", "run", "evaluate", "checkpoint", "look", "shut down", "end", "expire"]
        )
        try:
            if action == "request":
                world.request(random.choice(REQUESTS))
            elif action == "expire":
                world.expire()
            elif attempt is not None:
                attempt.do(action, random)
        except LeaseLostError:
            attempt = None
        if attempt is not None and attempt.ended:
            attempt = None
        if world.check() is None:
            world, attempt = World(context), None


def test_an_end_that_cannot_be_written_keeps_its_lease(context: WorkerContext) -> None:
    """The database's disk is full: it takes no new rows, but what workers renew is written in place."""
    sessions, lease_s = context.sessions, 0.5
    job = submission.submit(sessions, JobRequest(max_attempts=1), owner="tester")[0]
    claim = claim_work(sessions, Job, job.id, context.worker_id, lease_s=lease_s)
    assert claim is not None
    run = Run(replace(context, settings=context.settings.model_copy(update={"lease_s": lease_s})), claim)

    def lease_end() -> datetime:
        with sessions.begin() as session:
            leases.read_lease_clock(session, lease_s)
            found = session.scalars(select(Job.lease_expires_at).where(Job.id == job.id)).one()
        assert found is not None
        return found

    first, until = lease_end(), time.monotonic() + 10
    with ThreadPoolExecutor(1) as pool:
        with refusing(sessions, "events", changes="INSERT", error="disk_full"):
            settled = pool.submit(run._patiently, lambda: run._settle(ending("unavailable", Intent.NONE)))
            while lease_end() < first + timedelta(seconds=2 * lease_s):
                assert time.monotonic() < until, "the lease is not renewed"
                assert wait([settled], timeout=0.05).not_done
        settled.result()
    with sessions() as session:
        found = session.get_one(Job, job.id)
    assert (found.state, found.failures, found.postponed) == (WorkState.QUEUED, 0, 1)


@pytest.mark.parametrize("seed", range(20))
def test_requests_within_milliseconds_of_each_other_follow_the_table(context: WorkerContext, seed: int) -> None:
    """Two users and a worker that does an attempt act at once."""
    random = Random(seed)
    world = World(context)
    plans = [[(random.uniform(0, 0.02), random.choice(REQUESTS)) for _ in range(2)] for _ in range(2)]
    pauses, ways = [random.uniform(0, 0.02) for _ in range(4)], Random(seed)
    cancelled = threading.Event()

    def use(plan: list[tuple[float, str]]) -> None:
        for pause_s, name in plan:
            time.sleep(pause_s)
            if world.request(name) and name == "cancel":
                cancelled.set()

    def work() -> None:
        attempt = world.claim()
        if attempt is None:
            return
        with contextlib.suppress(LeaseLostError):
            for action, pause_s in zip(("run", "checkpoint", "look", "end"), pauses, strict=True):
                time.sleep(pause_s)
                attempt.do(action, ways)

    with ThreadPoolExecutor(3) as pool:
        acting = [pool.submit(work), *(pool.submit(use, plan) for plan in plans)]
    for future in acting:
        future.result()
    state = world.check()
    names = {name for plan in plans for _, name in plan}
    if cancelled.is_set() and state is not None and not names & {"resume", "retry"}:
        assert state is WorkState.CANCELLED


def test_evaluation_that_gives_way_to_a_training_waits_and_counts_no_attempt(context: WorkerContext) -> None:
    world = World(context)
    attempt = world.claim()
    assert attempt is not None
    attempt.do("checkpoint", Random(0))
    asked = request_evaluation(context.sessions, world.job_id).id
    claim = claim_work(context.sessions, Evaluation, asked, "worker")
    assert claim is not None
    run = Run(context, claim)
    with context.memory.share(run.kind) as run._share:
        run._share.crowded = True
        run._settle(ending("crowded", Intent.NONE))
    with context.sessions() as session:
        row = session.get_one(Evaluation, asked)
    assert (row.state, row.failures) == (WorkState.QUEUED, 0)
    assert row.not_before is not None


def test_attempt_that_the_database_outlived_counts_and_one_that_ended_with_it_does_not(context: WorkerContext) -> None:
    world = World(context)
    for restarted, failures in ((True, 0), (False, 1)):
        assert world.claim() is not None
        if restarted:
            with world.sessions.begin() as session:
                before = func.pg_postmaster_start_time() - timedelta(seconds=1)
                session.execute(update(Job).where(Job.id == world.job_id).values(heartbeat_at=before))
        world.expire()
        with world.sessions() as session:
            job = session.get_one(Job, world.job_id)
        assert (job.state, job.failures) == (WorkState.QUEUED, failures), job.error


@pytest.mark.parametrize("how", ENDS)
def test_a_cancel_that_was_acknowledged_is_kept_however_the_child_ends(context: WorkerContext, how: str) -> None:
    """The request comes after the supervisor's last look."""
    world = World(context)
    attempt = world.claim()
    assert attempt is not None
    attempt.do("run", Random(0))
    assert world.request("cancel")
    attempt.end(how)
    assert world.check() is WorkState.CANCELLED


def test_quotas_and_names_are_waited_for_before_rows_are_locked(sessions: Sessions) -> None:
    """One order for all: what had locked a row and waited for a quota was awaited by what had the quota already.

    So it was with names: a pass over a population submits several jobs, each with a parent, in one transaction.
    """
    limits = dict.fromkeys(Quota, 1_000_000)
    seen: list[str] = []

    def note(_connection: object, _cursor: object, statement: str, parameters: Any, *_: object) -> None:
        if "pg_advisory_xact_lock" in statement:
            seen.extend(re.findall("quota [A-Z_]+|name:", str(parameters)))
        elif re.search("FOR (NO KEY )?(UPDATE|KEY SHARE|SHARE)|^INSERT|^UPDATE", statement):
            seen.append("row")

    def job(**fields: Any) -> str:
        return submission.submit(sessions, JobRequest(**fields), owner="alice", limits=limits)[0].id

    def group(parent: str) -> object:
        wanted = GroupRequest(JobRequest(parent_job_id=parent), seeds=[1, 2])
        return submission.submit_group(sessions, wanted, owner="alice", limits=limits)

    def study() -> str:
        space = {"learning_rate": {"type": "float", "low": 1e-4, "high": 1e-3}}
        request = StudyRequest(JobRequest(), SearchSpec.model_validate({"space": space}))
        return studies.submit_study(sessions, request, owner="alice", limits=limits)[0].id

    def match() -> object:
        wanted = MatchRequest(teams=("example", "example"), games=1, players=1, half_s=1.0)
        return matches.submit_match(sessions, wanted, owner="alice", limits=limits)

    parent, ended, paused, trained, tuned = job(), job(), job(), job(), study()
    requests.request_cancel(sessions, Job, ended)
    requests.request_pause(sessions, paused)
    claim = claim_work(sessions, Job, trained, "w")
    assert claim is not None
    outcomes.begin(sessions, claim.lease, step=0)
    outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
    record_checkpoint(sessions, claim.lease, step=10, key=f"jobs/{trained}/checkpoints/10", manifest={"files": []})
    wanted = policies.Registration(trained, notes="fast")
    actions: dict[str, Callable[[], object]] = {
        "submit": lambda: job(parent_job_id=parent),
        "group": lambda: group(parent),
        "retry": lambda: requests.retry(sessions, Job, ended, limits=limits),
        "resume": lambda: requests.resume(sessions, paused, limits=limits),
        "edit": lambda: submission.edit(sessions, parent, name="slow", notes="slow", priority=7, limits=limits),
        "evaluate": lambda: submission.submit_evaluation(sessions, trained, EvaluationRequest(), limits=limits),
        "register": lambda: policies.register(sessions, "quick", wanted, limits=limits),
        "study": study,
        "match": match,
        "extend": lambda: studies.extend_study(sessions, tuned, 30, limits=limits),
    }
    event.listen(Engine, "before_cursor_execute", note)
    try:
        for name, action in actions.items():
            seen.clear()
            action()
            first = seen.index("row")
            assert first > 0, name
            assert {each for each in seen[first:] if each != "row"} <= set(seen[:first]), name
            names = seen.index("name:") if "name:" in seen else first
            assert {each for each in seen[names:first] if each != "name:"} <= set(seen[:names]), name
    finally:
        event.remove(Engine, "before_cursor_execute", note)
