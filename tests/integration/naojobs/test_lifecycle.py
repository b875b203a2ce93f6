"""The life cycle of a job in a real Postgres: allowed requests and races."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from datetime import timedelta
from typing import Any

import pytest
from naojobs import backups, checkpoints, leases, outcomes, records, requests, studies, submission
from naojobs.capabilities import Capabilities, live_workers, waiting_reasons
from naojobs.errors import ConflictError, InvalidError, LeaseLostError, NotFoundError, QuotaError
from naojobs.leases import JobClaim
from naojobs.matches import MatchRequest, submit_match
from naojobs.models import Evaluation, Event, Job, LeaseClock, Log, Match, MatchEvent, MetricsRecord
from naojobs.quotas import Quota
from naojobs.states import ENDED, LEASED, TRANSITIONS, WorkState
from naojobs.studies import StudyRequest
from naojobs.submission import GroupRequest, JobRequest
from naospec import EvaluationSpec, TrainingSpec, plugins
from naospec.search import SearchSpec
from sqlalchemy import event, func, select, text, update
from sqlalchemy.exc import IntegrityError, OperationalError
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work
from tests.integration.writes import append_metrics, record_checkpoint, record_event, refusing, request_evaluation

Sessions = sessionmaker[Session]


@pytest.fixture
def submit(sessions: Sessions) -> Callable[..., Job]:
    def submit(owner: str = "alice", **fields: Any) -> Job:
        return submission.submit(sessions, JobRequest(**fields), owner=owner)[0]

    return submit


@pytest.fixture
def running(sessions: Sessions, submit: Callable[..., Job]) -> JobClaim:
    """A job whose trainer runs."""
    claim = claim_work(sessions, Job, submit().id, "worker-1")
    assert claim is not None
    outcomes.begin(sessions, claim.lease, step=0)
    outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
    return claim


def get(sessions: Sessions, job_id: str) -> Job:
    with sessions.begin() as session:
        return session.get_one(Job, job_id)


def kinds(sessions: Sessions, job_id: str) -> list[str]:
    with sessions.begin() as session:
        return [event.kind for event in session.query(Event).where(Event.job_id == job_id).order_by(Event.id)]


def expire_lease(sessions: Sessions, job_id: str) -> None:
    """Expire the lease, as if its worker had been silent."""
    with sessions.begin() as session:
        session.execute(text("UPDATE jobs SET lease_expires_at = 'epoch' WHERE id = :id"), {"id": job_id})


def test_submit_keeps_what_was_asked_for(sessions: Sessions, submit: Callable[..., Job]) -> None:
    spec = TrainingSpec(task="sprint2", total_steps=100_000, seed=7)
    job = submit(spec=spec, evaluation=EvaluationSpec(task="sprint2"), tags=["a", "b", "a"], priority=8)
    kept = get(sessions, job.id)
    assert TrainingSpec.model_validate(kept.spec) == spec
    assert (kept.state, kept.tags, kept.priority, kept.attempt) == (WorkState.QUEUED, ["a", "b"], 8, 0)
    assert kept.total_steps == spec.planned_steps >= 100_000
    assert kept.evaluation is not None
    assert kept.evaluation["task"]["name"] == "sprint2"
    assert kinds(sessions, job.id) == ["queued"]


def test_of_many_claims_exactly_one_wins(sessions: Sessions, submit: Callable[..., Job]) -> None:
    job = submit()
    gate = threading.Barrier(8)

    def race(number: int) -> JobClaim | None:
        gate.wait()
        return claim_work(sessions, Job, job.id, f"worker-{number}")

    with ThreadPoolExecutor(8) as pool:
        claims = [claim for claim in pool.map(race, range(8)) if claim is not None]
    assert len(claims) == 1
    kept = get(sessions, job.id)
    assert (kept.state, kept.lease_owner, kept.attempt) == (WorkState.STARTING, claims[0].lease.owner, 1)


@pytest.mark.parametrize("cause", ["expired", "restored"])
def test_a_lost_lease_fences_every_write(sessions: Sessions, running: JobClaim, cause: str) -> None:
    if cause == "expired":
        expire_lease(sessions, running.lease.job_id)
    else:
        backups.renew_generation(sessions)
    states = {item.id: item.state for item in outcomes.requeue_stale(sessions)}
    assert states[running.lease.job_id] is WorkState.QUEUED
    assert get(sessions, running.lease.job_id).failures == (cause == "expired")
    with sessions.begin() as session:
        session.get_one(Job, running.lease.job_id).not_before = None
        if cause == "restored":  # the restored history gives the same number to another attempt
            session.get_one(Job, running.lease.job_id).attempt = 0
    second = claim_work(sessions, Job, running.lease.job_id, "worker-1")  # the same worker may get it again
    assert second is not None
    writes: list[Callable[[], object]] = [
        lambda: leases.heartbeat(sessions, running.lease),
        lambda: outcomes.begin(sessions, running.lease, step=0),
        lambda: outcomes.transition(sessions, running.lease, WorkState.SUCCEEDED),
        lambda: outcomes.lose(sessions, running.lease, "late"),
        lambda: append_metrics(sessions, running.lease, [{"step": 1}]),
        lambda: records.append_logs(sessions, running.lease, [records.LogLine("info", "late")]),
        lambda: record_event(sessions, running.lease, "late", "late"),
        lambda: record_checkpoint(sessions, running.lease, step=1, key="late", manifest={"files": []}),
    ]
    for write in writes:
        with pytest.raises(LeaseLostError):
            write()
    leases.heartbeat(sessions, second.lease)


def test_a_lease_of_another_timeline_fences_as_well(sessions: Sessions, running: JobClaim) -> None:
    """Recovery to a moment, or a standby that takes over, changes no row."""
    key, timeline = running.lease.generation.rsplit("-", 1)
    assert timeline == "00000001"
    with pytest.raises(LeaseLostError):
        leases.heartbeat(sessions, replace(running.lease, generation=f"{key}-00000002"))
    leases.heartbeat(sessions, running.lease)
    assert outcomes.requeue_stale(sessions) == []


def test_an_expired_lease_that_nobody_took_can_be_renewed(sessions: Sessions, running: JobClaim) -> None:
    expire_lease(sessions, running.lease.job_id)
    leases.heartbeat(sessions, running.lease)
    assert outcomes.requeue_stale(sessions) == []


def move_clock(sessions: Sessions, seconds: float) -> None:
    """Set the time of the last reading, which has the effect of setting the database's clock."""
    with sessions.begin() as session:
        session.execute(update(LeaseClock).values(read_at=LeaseClock.read_at - timedelta(seconds=seconds)))


@pytest.mark.parametrize("seconds", [3600.0, 7 * 86_400.0, -3600.0, -7 * 86_400.0])
def test_a_step_of_the_databases_clock_ends_no_lease_and_lengthens_none(
    sessions: Sessions, submit: Callable[..., Job], seconds: float
) -> None:
    """Nor does time in which the server or its machine was suspended, which looks like a step forward."""
    lost, held = (claim_work(sessions, Job, submit().id, worker, lease_s=1.5) for worker in ("lost", "held"))
    assert lost is not None
    assert held is not None

    def requeued() -> list[str]:
        found = {item.id for item in outcomes.requeue_stale(sessions, lease_s=1.5)}
        return [claim.lease.id for claim in (lost, held) if claim.lease.id in found]

    requeued()
    for lease in (lost.lease, held.lease):
        move_clock(sessions, seconds)
        leases.heartbeat(sessions, lease, lease_s=1.5)  # before anyone has read the clock since
        assert requeued() == []
    deadline = time.monotonic() + 30
    while not (ended := requeued()):
        assert time.monotonic() < deadline
        leases.heartbeat(sessions, held.lease, lease_s=1.5)
        time.sleep(0.05)
    assert ended == [lost.lease.id]
    outcomes.transition(sessions, held.lease, WorkState.CANCELLED)


def test_readings_of_many_workers_do_not_hurry_the_clock_of_leases(sessions: Sessions) -> None:
    def read(_: int) -> None:
        for _ in range(50):
            outcomes.requeue_stale(sessions, lease_s=0.3)

    with sessions() as session:
        clock = select(func.clock_timestamp(), LeaseClock.time)
        began, first = session.execute(clock).one()
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(read, range(4)))
        ended, last = session.execute(clock).one()
    assert last - first <= ended - began + timedelta(seconds=0.1)


def test_the_third_lost_worker_fails_the_job_and_retry_gives_it_three_more(
    sessions: Sessions, submit: Callable[..., Job]
) -> None:
    job = submit()
    for failures, state in ((1, WorkState.QUEUED), (2, WorkState.QUEUED), (3, WorkState.FAILED)):
        assert claim_work(sessions, Job, job.id, "w") is not None
        expire_lease(sessions, job.id)
        outcomes.requeue_stale(sessions)
        kept = get(sessions, job.id)
        assert (kept.state, kept.failures, kept.lease_owner) == (state, failures, None)
    assert kept.error is not None
    assert "attempt 3 of 3" in kept.error
    assert kept.finished_at is not None
    retried = requests.retry(sessions, Job, job.id)
    assert (retried.state, retried.failures, retried.attempt, retried.error) == (WorkState.QUEUED, 0, 3, None)
    assert retried.finished_at is None


def test_a_new_checkpoint_gives_a_job_all_its_attempts_again(sessions: Sessions, submit: Callable[..., Job]) -> None:
    """Failures count while there is no progress, such as a checkpoint of a step that was reached before."""
    job = submit(max_attempts=2)
    for round_, (step, failures) in enumerate(((0, 1), (0, 2))):
        claim = claim_work(sessions, Job, job.id, "w")
        assert claim is not None
        key = f"{job.id}/{round_}"
        record_checkpoint(sessions, claim.lease, step=step, key=key, manifest={"files": []})
        state = outcomes.lose(sessions, claim.lease, "the trainer died")
        assert get(sessions, job.id).failures == failures
    assert state is WorkState.FAILED
    requests.retry(sessions, Job, job.id)
    for step in (10, 20, 30):
        claim = claim_work(sessions, Job, job.id, "w")
        assert claim is not None
        record_checkpoint(sessions, claim.lease, step=step, key=f"{job.id}/{step}", manifest={"files": []})
        assert outcomes.lose(sessions, claim.lease, "the trainer died") is WorkState.QUEUED
        assert get(sessions, job.id).failures == 1


def test_a_service_that_is_away_costs_no_attempt_and_the_job_waits(
    sessions: Sessions, submit: Callable[..., Job]
) -> None:
    job = submit(max_attempts=1)
    for delay_s in (5.0, 10.0, 20.0):
        claim = claim_work(sessions, Job, job.id, "w")
        assert claim is not None
        assert outcomes.postpone(sessions, claim.lease, "no Docker") is WorkState.QUEUED
        assert claim_work(sessions, Job, job.id, "w") is None, "not yet"
        with sessions() as session:
            kept = session.get_one(Job, job.id)
            event = session.query(Event).where(Event.job_id == job.id).order_by(Event.id.desc()).limit(1).one()
            reason = waiting_reasons(session, [kept], live_workers(session, stale_s=30))[job.id]
        assert (kept.failures, event.data["delay_s"]) == (0, delay_s)
        assert reason.startswith("the next attempt begins in")
        assert reason.endswith("the last one ended: no Docker")
        with sessions.begin() as session:
            session.execute(text("UPDATE jobs SET not_before = now() WHERE id = :id"), {"id": job.id})
    claim = claim_work(sessions, Job, job.id, "w")
    assert claim is not None
    requests.request_cancel(sessions, Job, job.id)
    assert outcomes.postpone(sessions, claim.lease, "no Docker") is WorkState.CANCELLED
    requests.retry(sessions, Job, job.id)
    assert get(sessions, job.id).postponed == 0


def test_a_clock_that_is_set_back_holds_up_no_postponed_job(sessions: Sessions, submit: Callable[..., Job]) -> None:
    """The job was postponed by seconds while the database's clock was an hour ahead."""
    job = submit()
    claim = claim_work(sessions, Job, job.id, "w")
    assert claim is not None
    outcomes.postpone(sessions, claim.lease, "no Docker")
    with sessions.begin() as session:
        session.execute(text("UPDATE jobs SET not_before = not_before + interval '1 h' WHERE id = :id"), {"id": job.id})
    assert claim_work(sessions, Job, job.id, "w") is not None


class Intruder:
    """Another user's action, started during a deletion, between the lock and the deletion of its rows."""

    def __init__(self, sessions: Sessions, action: Callable[[], object]) -> None:
        self._sessions = sessions
        self._action = action
        self._pool = ThreadPoolExecutor(1)
        self.result: Future[object] | None = None
        self.watched: Sessions = sessionmaker(sessions.kw["bind"], expire_on_commit=False)
        """The same database, with the intrusion into the first flush."""
        event.listen(self.watched, "before_flush", self._intrude, once=True)

    def _intrude(self, *_: object) -> None:
        self.result = self._pool.submit(self._action)
        waiting = (
            "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND wait_event_type = 'Lock'"
        )
        while not self.result.done():
            with self._sessions() as session:
                if session.scalar(text(waiting)):
                    return

    def error(self) -> BaseException | None:
        """Return what the action raised, once it has ended."""
        assert self.result is not None
        return self.result.exception(30)


def test_deleting_a_job_while_its_child_is_claimed_causes_no_deadlock(
    sessions: Sessions, running: JobClaim, submit: Callable[..., Job]
) -> None:
    parent = running.lease.job_id
    record_checkpoint(sessions, running.lease, step=10, key=f"{parent}/10", manifest={"files": []})
    child = submit(parent_job_id=parent)
    requests.request_cancel(sessions, Job, child.id)
    outcomes.transition(sessions, running.lease, WorkState.CANCELLED)

    def retry_and_claim() -> None:
        requests.retry(sessions, Job, child.id)
        claim_work(sessions, Job, child.id, "w")

    intruder = Intruder(sessions, retry_and_claim)
    requests.delete(intruder.watched, parent)
    assert intruder.error() is None
    assert get(sessions, child.id).error == "the job whose policy it starts from was deleted"


def test_deleting_a_job_while_its_evaluation_ends_causes_no_deadlock(sessions: Sessions, running: JobClaim) -> None:
    job_id = running.lease.job_id
    record_checkpoint(sessions, running.lease, step=10, key=f"{job_id}/10", manifest={"files": []})
    evaluation = request_evaluation(sessions, job_id)
    claim = claim_work(sessions, Evaluation, evaluation.id, "w")
    assert claim is not None
    outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
    outcomes.transition(sessions, running.lease, WorkState.CANCELLED)
    intruder = Intruder(sessions, lambda: outcomes.transition(sessions, claim.lease, WorkState.SUCCEEDED))
    requests.delete(intruder.watched, job_id)
    assert isinstance(intruder.error(), LeaseLostError)


def test_a_training_that_begins_is_recorded_once(sessions: Sessions, running: JobClaim) -> None:
    """The first commit may have succeeded although its answer was lost."""
    outcomes.begin(sessions, running.lease, step=0)
    assert kinds(sessions, running.lease.job_id).count("started") == 1


def test_a_job_of_an_older_version_is_no_parent_and_fails_when_it_is_claimed(
    sessions: Sessions, submit: Callable[..., Job]
) -> None:
    old = submit()
    spec = '{"task": "sprint2", "robot": "nao-3", "simulator": "rcssserver3d", "n_envs": 8}'
    with sessions.begin() as session:
        session.execute(
            text("UPDATE jobs SET spec = cast(:spec AS jsonb) WHERE id = :id"), {"spec": spec, "id": old.id}
        )
    with pytest.raises(InvalidError, match="this one cannot read"):
        submission.submit(sessions, JobRequest(parent_job_id=old.id), owner="alice")
    assert claim_work(sessions, Job, old.id, "w") is None
    kept = get(sessions, old.id)
    assert kept.state is WorkState.FAILED
    assert "does not fit this version" in (kept.error or "")


def test_a_job_for_which_a_plug_in_breaks_fails_and_the_next_one_runs(
    sessions: Sessions, submit: Callable[..., Job], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise no worker would ever claim anything behind it."""
    first, second = submit(priority=9), submit(priority=9)
    load = plugins.load

    def broken(group: str, name: str) -> Any:
        monkeypatch.setattr(plugins, "load", load)  # it breaks once
        raise KeyError(name)

    monkeypatch.setattr(plugins, "load", broken)
    have = Capabilities({"sprint1": 1}, ["nao-0"], ["embedded"], ["ppo"])
    claim = leases.claim_next(sessions, "w", capabilities=have, models=[Job])
    assert claim is not None and claim.lease.id == second.id
    kept = get(sessions, first.id)
    assert kept.state is WorkState.FAILED
    assert (kept.error or "").startswith("the specification cannot be read: KeyError: ")


@pytest.mark.parametrize("count", [1, 2])
def test_a_job_whose_stages_have_candidates_runs_with_one_and_is_refused_with_several(
    sessions: Sessions, submit: Callable[..., Job], count: int
) -> None:
    old = submit(spec=TrainingSpec.model_validate({"stages": [{"steps": 8192}, {"steps": 8192}]}))
    with sessions.begin() as session:
        job = session.get_one(Job, old.id)
        stages = [job.spec["stages"][0], {**job.spec["stages"][1], "candidates": count}]
        job.spec = {**job.spec, "format": 2, "stages": stages}
    requests.request_pause(sessions, old.id)
    requests.resume(sessions, old.id)
    claim = claim_work(sessions, Job, old.id, "w")
    if count == 1:
        assert claim is not None and claim.spec == TrainingSpec(stages=[{"steps": 8192}, {"steps": 8192}])
        return
    assert claim is None
    kept = get(sessions, old.id)
    assert kept.state is WorkState.FAILED
    assert "stages.1.candidates: a stage trains one policy; run a study of seeds" in (kept.error or "")


def test_two_reapers_take_a_stale_job_once(sessions: Sessions, submit: Callable[..., Job]) -> None:
    jobs = [submit() for _ in range(10)]
    for job in jobs:
        claim_work(sessions, Job, job.id, "w")
        expire_lease(sessions, job.id)
    gate = threading.Barrier(4)

    def reap(_: int) -> list[str]:
        gate.wait()
        return [item.id for item in outcomes.requeue_stale(sessions) if item.id in {job.id for job in jobs}]

    with ThreadPoolExecutor(4) as pool:
        reaped = [job_id for part in pool.map(reap, range(4)) for job_id in part]
    assert sorted(reaped) == sorted(job.id for job in jobs)
    assert {get(sessions, job.id).failures for job in jobs} == {1}


def play(sessions: Sessions, **fields: Any) -> Match:
    wanted = MatchRequest(teams=("example", "example"), games=1, players=1, half_s=1.0, **fields)
    return submit_match(sessions, wanted, owner="alice")[0]


def test_a_row_that_cannot_be_requeued_keeps_no_other_from_it(
    sessions: Sessions, caplog: pytest.LogCaptureFixture
) -> None:
    """The row is locked, or a webhook of its owner is, for longer than a statement waits."""
    refused, lost = (play(sessions, priority=priority).id for priority in (9, 5))
    for match_id in (refused, lost):
        assert claim_work(sessions, Match, match_id, "w") is not None
    with sessions.begin() as session:
        session.execute(text("UPDATE matches SET lease_expires_at = 'epoch' WHERE id = :id"), {"id": refused})
        session.execute(text("UPDATE matches SET lease_expires_at = '2000-01-01' WHERE id = :id"), {"id": lost})
    with refusing(sessions, "matches", "NEW.priority = 9"):
        assert [item.id for item in outcomes.requeue_stale(sessions)] == [lost]
        assert f"{refused} is not requeued" in caplog.text
    assert [item.id for item in outcomes.requeue_stale(sessions)] == [refused]
    for match_id in (refused, lost):
        requests.request_cancel(sessions, Match, match_id)


def test_many_rows_that_cannot_be_requeued_keep_no_other_from_it(
    sessions: Sessions, submit: Callable[..., Job]
) -> None:
    jobs = [submit(priority=9) for _ in range(101)]
    for job in jobs:
        assert claim_work(sessions, Job, job.id, "w") is not None
    lost = submit(priority=5).id
    assert claim_work(sessions, Job, lost, "w") is not None
    with sessions.begin() as session:
        session.execute(text("UPDATE jobs SET lease_expires_at = 'epoch' WHERE priority = 9"))
        session.execute(text("UPDATE jobs SET lease_expires_at = '2000-01-01' WHERE id = :id"), {"id": lost})
    with refusing(sessions, "jobs", "NEW.priority = 9"):
        requeued = {item.id for item in outcomes.requeue_stale(sessions)}  # and what other tests have left
    assert lost in requeued and requeued.isdisjoint(job.id for job in jobs)
    with sessions.begin() as session:
        session.execute(text("DELETE FROM jobs WHERE priority = 9"))


def test_what_is_written_of_an_attempt_shows_no_internals(sessions: Sessions, running: JobClaim) -> None:
    """Its traceback shows where in a package it broke, and its end is kept where it is long."""
    output = f'{"x" * 9000}\n  File "{leases.__file__}", line 3, in f\nOSError: /srv/w/a.npz'
    outcomes.lose(sessions, running.lease, "OSError: http://store:9000/bucket [SQL: SELECT 1]", output=output)
    job = get(sessions, running.lease.id)
    assert job.error == "OSError: (address)"
    with sessions() as session:
        line = session.scalars(select(Log.message).where(Log.job_id == job.id)).one()
        event = session.scalars(select(Event).where(Event.job_id == job.id).order_by(Event.id.desc())).first()
    assert line.endswith('x\n  File "naojobs/leases.py", line 3, in f\nOSError: …/a.npz') and len(line) == 8000
    assert event is not None
    assert event.data["reason"] == "OSError: (address)"
    assert event.message.startswith("OSError: (address); queued again")


@pytest.mark.parametrize("failure", ["PERFORM pg_terminate_backend(pg_backend_pid()); RETURN NEW", "RAISE disk_full"])
def test_a_database_that_does_not_answer_ends_the_search_for_lost_work(
    sessions: Sessions, submit: Callable[..., Job], failure: str
) -> None:
    """It would be waited for with each row."""
    jobs = [submit() for _ in range(3)]
    for job in jobs:
        assert claim_work(sessions, Job, job.id, "w") is not None
        expire_lease(sessions, job.id)
    with sessions.begin() as session:
        session.execute(text(f"CREATE FUNCTION cut() RETURNS trigger AS 'BEGIN {failure}; END' LANGUAGE plpgsql"))
        session.execute(text("CREATE TRIGGER cut BEFORE UPDATE ON jobs FOR EACH ROW EXECUTE FUNCTION cut()"))
    try:
        with pytest.raises(OperationalError):
            outcomes.requeue_stale(sessions)
    finally:
        with sessions.begin() as session:
            session.execute(text("DROP FUNCTION cut CASCADE"))
    assert {item.id for item in outcomes.requeue_stale(sessions)} >= {job.id for job in jobs}


def test_a_match_that_cannot_be_read_fails_and_holds_nothing_up(sessions: Sessions, submit: Callable[..., Job]) -> None:
    match = play(sessions, priority=9)
    with sessions.begin() as session:
        session.execute(text("UPDATE matches SET spec = '{}' WHERE id = :id"), {"id": match.id})
    with sessions() as session:
        assert match.id not in checkpoints.in_use(session).values()
    assert claim_work(sessions, Match, match.id, "w") is None
    with sessions() as session:
        kept = session.get_one(Match, match.id)
    assert kept.state is WorkState.FAILED
    assert "does not fit this version" in str(kept.error)


def test_the_last_output_of_an_attempt_is_written_with_its_end(sessions: Sessions, running: JobClaim) -> None:
    """Settled again after an error of the database it is not written again, whether or not that was committed."""
    match = play(sessions)
    claim = claim_work(sessions, Match, match.id, "w")
    assert claim is not None
    for lease in (running.lease, claim.lease):
        assert outcomes.lose(sessions, lease, "it ended", output="bye") is WorkState.QUEUED
        with pytest.raises(LeaseLostError):
            outcomes.lose(sessions, lease, "it ended", output="bye")
    with sessions() as session:
        job_lines = session.scalars(select(Log.message).where(Log.job_id == running.lease.id)).all()
        lines = session.scalars(select(MatchEvent).where(MatchEvent.match_id == match.id)).all()
        assert session.get_one(Match, match.id).row_count == len(lines)
    assert job_lines == ["bye"]
    assert [line.message for line in lines if line.kind == "error"] == ["bye"]
    requests.request_cancel(sessions, Match, match.id)


def test_pausing_and_resuming_costs_no_attempt(sessions: Sessions, submit: Callable[..., Job]) -> None:
    job = submit(max_attempts=1)
    for _ in range(3):
        claim = claim_work(sessions, Job, job.id, "w")
        assert claim is not None
        outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
        assert requests.request_pause(sessions, job.id).state is WorkState.PAUSING
        assert requests.request_pause(sessions, job.id).state is WorkState.PAUSING
        assert leases.heartbeat(sessions, claim.lease).state is WorkState.PAUSING
        with pytest.raises(ConflictError, match="still pausing"):
            requests.resume(sessions, job.id)
        outcomes.transition(sessions, claim.lease, WorkState.PAUSED)
        assert get(sessions, job.id).pausing is False
        assert requests.resume(sessions, job.id).state is WorkState.QUEUED
    assert get(sessions, job.id).failures == 0


def test_a_worker_that_dies_while_pausing_leaves_a_paused_job(sessions: Sessions, running: JobClaim) -> None:
    requests.request_pause(sessions, running.lease.job_id)
    expire_lease(sessions, running.lease.job_id)
    outcomes.requeue_stale(sessions)
    assert get(sessions, running.lease.job_id).state is WorkState.PAUSED


def test_a_worker_that_dies_while_cancelling_leaves_a_cancelled_job(sessions: Sessions, running: JobClaim) -> None:
    job = requests.request_cancel(sessions, Job, running.lease.job_id)
    assert (job.state, job.cancel_requested) == (WorkState.RUNNING, True)
    assert leases.heartbeat(sessions, running.lease).cancel
    expire_lease(sessions, running.lease.job_id)
    outcomes.requeue_stale(sessions)
    kept = get(sessions, running.lease.job_id)
    assert (kept.state, kept.cancel_requested) == (WorkState.CANCELLED, False)


def test_a_waiting_job_is_cancelled_at_once_and_no_late_message_revives_it(
    sessions: Sessions, submit: Callable[..., Job]
) -> None:
    job = submit()
    assert requests.request_cancel(sessions, Job, job.id).state is WorkState.CANCELLED
    assert requests.request_cancel(sessions, Job, job.id).state is WorkState.CANCELLED
    assert claim_work(sessions, Job, job.id, "w") is None
    assert kinds(sessions, job.id) == ["queued", "cancelled"]


@pytest.mark.parametrize("state", list(WorkState))
@pytest.mark.parametrize("wish", ["request_cancel", "request_pause", "resume", "retry", "delete"])
def test_wishes_in_every_state_either_follow_the_table_or_are_refused(
    sessions: Sessions, submit: Callable[..., Job], state: WorkState, wish: str
) -> None:
    job = submit()
    with sessions.begin() as session:
        session.execute(
            text("UPDATE jobs SET state = :state, lease_owner = :owner WHERE id = :id"),
            {"state": state, "owner": "w" if state in LEASED else None, "id": job.id},
        )
    try:
        if wish in ("request_cancel", "retry"):
            getattr(requests, wish)(sessions, Job, job.id)
        else:
            getattr(requests, wish)(sessions, job.id)
    except ConflictError as error:
        assert job.id in str(error)
        assert get(sessions, job.id).state is state
        return
    if wish == "delete":
        assert state in ENDED
        with pytest.raises(NotFoundError):
            requests.delete(sessions, job.id)
        return
    after = get(sessions, job.id).state
    assert after is state or after in TRANSITIONS[state]


def test_a_worker_cannot_take_a_way_that_the_table_does_not_have(sessions: Sessions, running: JobClaim) -> None:
    requests.request_pause(sessions, running.lease.job_id)
    with pytest.raises(ConflictError, match="pausing and cannot become running"):
        outcomes.transition(sessions, running.lease, WorkState.RUNNING)


def test_the_database_refuses_a_lease_that_does_not_fit_the_state(
    sessions: Sessions, submit: Callable[..., Job]
) -> None:
    job = submit()
    with pytest.raises(IntegrityError, match="ck_jobs_lease_fits_state"), sessions.begin() as session:
        session.execute(text("UPDATE jobs SET state = 'running' WHERE id = :id"), {"id": job.id})
    with pytest.raises(IntegrityError, match="ck_jobs_state_known"), sessions.begin() as session:
        session.execute(text("UPDATE jobs SET state = 'lost' WHERE id = :id"), {"id": job.id})


def test_the_quota_holds_in_a_race(sessions: Sessions) -> None:
    gate = threading.Barrier(6)

    def race(_: int) -> bool:
        gate.wait()
        try:
            submission.submit(sessions, JobRequest(), owner="quota", limits={Quota.OPEN_JOBS: 3})
        except QuotaError:
            return False
        return True

    with ThreadPoolExecutor(6) as pool:
        assert sum(pool.map(race, range(6))) == 3


def test_a_child_starts_from_its_parents_policy_until_it_has_a_checkpoint_of_its_own(
    sessions: Sessions, running: JobClaim, submit: Callable[..., Job]
) -> None:
    parent = running.lease.job_id
    first = record_checkpoint(sessions, running.lease, step=10, key=f"{parent}/10", manifest={"files": []})
    child = submit(parent_job_id=parent, parent_checkpoint_id=first)
    other = submit(parent_job_id=parent)
    second = record_checkpoint(sessions, running.lease, step=20, key=f"{parent}/20", manifest={"files": []})

    claim = claim_work(sessions, Job, child.id, "w")
    assert claim is not None
    assert claim.initial_policy is not None
    assert claim.initial_policy.id == first
    newest = claim_work(sessions, Job, other.id, "w")
    assert newest is not None
    assert newest.initial_policy is not None
    assert newest.initial_policy.id == second
    with sessions() as session:
        assert session.get_one(Job, other.id).parent_checkpoint_id == second, "the lineage names the used checkpoint"
    record_checkpoint(sessions, running.lease, step=30, key=f"{parent}/30", manifest={"files": []})
    outcomes.transition(sessions, newest.lease, WorkState.QUEUED)
    once_more = claim_work(sessions, Job, other.id, "w")
    assert once_more is not None
    assert once_more.initial_policy is not None
    assert once_more.initial_policy.id == second, "every attempt starts from the same policy"

    record_checkpoint(sessions, claim.lease, step=5, key=f"{child.id}/5", manifest={"files": []})
    outcomes.transition(sessions, claim.lease, WorkState.QUEUED)
    again = claim_work(sessions, Job, child.id, "w")
    assert again is not None
    assert again.initial_policy is None, "it continues from its own"

    outcomes.transition(sessions, running.lease, WorkState.CANCELLED)
    with pytest.raises(ConflictError, match="starts from the policy"):
        requests.delete(sessions, parent)


@pytest.mark.parametrize(
    ("fields", "field"),
    [
        ({"parent_job_id": "job_01m7y0bdkc59pc1szgpqz7ge55"}, "parent_job_id"),
        ({"spec": TrainingSpec(algorithm={"hidden_sizes": (32,)})}, "spec.algorithm.hidden_sizes"),
        ({"spec": TrainingSpec(algorithm={"hidden_sizes": (256, 64)})}, "spec.algorithm.hidden_sizes"),
        ({"spec": TrainingSpec(algorithm={"normalize_observations": False})}, "spec.algorithm.normalize_observations"),
        ({"spec": TrainingSpec(robot="t1")}, "spec.robot"),
        ({"parent_checkpoint_id": "ckpt_01m7y0bdkc59pc1szgpqz7ge55"}, "parent_checkpoint_id"),
    ],
)
def test_a_parent_that_does_not_fit_is_refused_by_field(
    sessions: Sessions, submit: Callable[..., Job], fields: dict[str, Any], field: str
) -> None:
    parent = submit()
    with pytest.raises(InvalidError) as caught:
        submission.submit(sessions, JobRequest(**{"parent_job_id": parent.id, **fields}), owner="alice")
    assert caught.value.field == field


@pytest.mark.parametrize("spec", [{"robot": "nao-4"}, {"algorithm": {"hidden_sizes": (256, 128)}}])
def test_a_parent_may_have_another_type_of_robot_and_narrower_layers(
    sessions: Sessions, submit: Callable[..., Job], spec: dict[str, Any]
) -> None:
    parent = submit()
    request = JobRequest(parent_job_id=parent.id, spec=TrainingSpec(**spec))
    job, new = submission.submit(sessions, request, owner="alice")
    assert (job.parent_job_id, new) == (parent.id, True)


def test_anothers_job_is_no_parent(sessions: Sessions, submit: Callable[..., Job]) -> None:
    parent = submit(owner="bob")
    with pytest.raises(InvalidError, match="one of your jobs"):
        submission.submit(sessions, JobRequest(parent_job_id=parent.id), owner="alice")


def test_a_group_has_one_job_for_each_point_and_is_made_once(sessions: Sessions) -> None:
    request = GroupRequest(job=JobRequest(tags=["sweep"]), seeds=[1, 2], grid={"learning_rate": [1e-3, 1e-4]})
    group, jobs, created = submission.submit_group(sessions, request, owner="alice", idempotency_key="g")
    points = {(job.spec["seed"], job.spec["algorithm"]["learning_rate"]) for job in jobs}
    assert points == {(1, 1e-3), (1, 1e-4), (2, 1e-3), (2, 1e-4)}
    assert created
    again, same, created = submission.submit_group(sessions, request, owner="alice", idempotency_key="g")
    assert (again, {job.id for job in same}, created) == (group, {job.id for job in jobs}, False)
    for seeds in ([1], [1, 2, 3]):  # a part of it, and more than it
        with pytest.raises(ConflictError, match="use a new key"):
            submission.submit_group(sessions, replace(request, seeds=seeds), owner="alice", idempotency_key="g")


def test_a_group_with_one_bad_point_makes_no_job(sessions: Sessions) -> None:
    with sessions.begin() as session:
        before = session.query(Job).count()
    request = GroupRequest(job=JobRequest(), grid={"clip_range": [0.1, 3.0]})
    with pytest.raises(InvalidError, match=r"clip_range=3\.0") as caught:
        submission.submit_group(sessions, request, owner="alice")
    assert caught.value.field == "grid.clip_range"
    with sessions.begin() as session:
        assert session.query(Job).count() == before


def test_what_is_left_of_a_group_is_returned_and_nothing_queued_again(sessions: Sessions) -> None:
    request = GroupRequest(JobRequest(TrainingSpec(), name="g"), seeds=(1, 2, 3))
    group, jobs, _ = submission.submit_group(sessions, request, owner="alice", idempotency_key="k")
    requests.request_cancel(sessions, Job, jobs[0].id)
    requests.delete(sessions, jobs[0].id)
    again, left, created = submission.submit_group(sessions, request, owner="alice", idempotency_key="k")
    assert (again, [job.id for job in left], created) == (group, [job.id for job in jobs[1:]], False)
    with sessions() as session:
        assert (
            session.scalar(select(func.count(Job.id)).where(Job.group_id.is_not(None), Job.name.startswith("g-"))) == 2
        )


def test_what_an_owner_has_is_counted_once_for_a_group(sessions: Sessions) -> None:
    """Other requests of the owner wait for it, so its jobs cost little more than their rows."""
    statements: list[str] = []
    limits = dict.fromkeys(Quota, 10**9)
    counts = []

    def note(*arguments: Any) -> None:
        statements.append(arguments[2])

    event.listen(sessions.kw["bind"], "before_cursor_execute", note)
    try:
        for size in (2, 22):
            statements.clear()
            request = GroupRequest(JobRequest(TrainingSpec(), name=f"g{size}"), seeds=range(size))
            submission.submit_group(sessions, request, owner="alice", limits=limits, idempotency_key=f"k{size}")
            counts.append(len(statements))
    finally:
        event.remove(sessions.kw["bind"], "before_cursor_execute", note)
    per_job = (counts[1] - counts[0]) / 20
    assert per_job <= 5, per_job


def test_a_broker_that_is_down_is_recorded_and_the_job_can_be_claimed(
    sessions: Sessions, submit: Callable[..., Job]
) -> None:
    job = submit()
    outcomes.record_notification_failure(sessions, job.id, "ConnectionError: refused")
    assert kinds(sessions, job.id) == ["queued", "notification_failed"]
    assert claim_work(sessions, Job, job.id, "w") is not None


def test_success_clears_the_errors_of_lost_attempts(sessions: Sessions, running: JobClaim) -> None:
    assert outcomes.lose(sessions, running.lease, "the trainer died") is WorkState.QUEUED
    assert get(sessions, running.lease.job_id).error == "the trainer died"
    claim = claim_work(sessions, Job, running.lease.job_id, "w")
    assert claim is not None
    for state in (WorkState.RUNNING, WorkState.EVALUATING, WorkState.SUCCEEDED):
        outcomes.transition(sessions, claim.lease, state)
    kept = get(sessions, running.lease.job_id)
    assert (kept.state, kept.error, kept.failures, kept.lease_owner) == (WorkState.SUCCEEDED, None, 0, None)
    assert kept.finished_at is not None


def test_deleting_a_job_leaves_no_row_of_it(sessions: Sessions, running: JobClaim) -> None:
    job_id = running.lease.job_id
    append_metrics(sessions, running.lease, [{"step": 1, "reward": 2.0}])
    records.append_logs(sessions, running.lease, [records.LogLine("info", "x")])
    record_checkpoint(sessions, running.lease, step=1, key=f"{job_id}/1", manifest={"files": []})
    request_evaluation(sessions, job_id)
    outcomes.transition(sessions, running.lease, WorkState.CANCELLED)
    requests.delete(sessions, job_id)
    with sessions.begin() as session:
        for table in ("metrics", "logs", "events", "checkpoints", "evaluations"):
            left = session.execute(
                text(f"SELECT count(*) FROM {table} WHERE job_id = :id"),
                {"id": job_id},
            ).scalar_one()
            assert left == 0, table


def test_a_child_waits_for_the_first_policy_of_its_parent(sessions: Sessions, submit: Callable[..., Job]) -> None:
    """The checkpoint of step 0 has random weights: no job starts from it."""
    parent = submit()
    child = submit(parent_job_id=parent.id)
    claim = claim_work(sessions, Job, parent.id, "w")
    assert claim is not None
    assert claim_work(sessions, Job, child.id, "w") is None
    record_checkpoint(sessions, claim.lease, step=0, key=f"{parent.id}/0", manifest={"files": []})
    assert claim_work(sessions, Job, child.id, "w") is None
    assert get(sessions, child.id).state is WorkState.QUEUED
    with sessions() as session:
        reasons = waiting_reasons(session, [get(sessions, child.id)], live_workers(session, stale_s=30))
    assert reasons == {child.id: f"job {parent.id}, whose policy it starts from, has no trained checkpoint yet"}
    first = record_checkpoint(sessions, claim.lease, step=9, key=f"{parent.id}/9", manifest={"files": []})
    got = claim_work(sessions, Job, child.id, "w")
    assert got is not None
    assert got.initial_policy is not None
    assert got.initial_policy.id == first


def test_a_child_whose_parent_ended_without_a_policy_fails(sessions: Sessions, submit: Callable[..., Job]) -> None:
    """It fails with the reason, and the next job is claimed instead."""
    parent = submit()
    child = submit(parent_job_id=parent.id, priority=9)
    requests.request_cancel(sessions, Job, parent.id)
    other = submit(priority=9)
    have = Capabilities({"sprint1": 1}, ["nao-0"], ["embedded"], ["ppo"])
    claim = leases.claim_next(sessions, "w", capabilities=have, models=[Job])
    assert claim is not None
    assert claim.lease.id == other.id
    kept = get(sessions, child.id)
    assert (kept.state, kept.attempt) == (WorkState.FAILED, 0)
    assert kept.error == f"job {parent.id}, whose policy it starts from, ended without a trained checkpoint"


def test_no_job_can_start_from_one_that_ended_without_a_policy(sessions: Sessions, running: JobClaim) -> None:
    """The checkpoint of step 0 has random weights; one that is named or trained can be started from."""
    parent = running.lease.job_id
    first = record_checkpoint(sessions, running.lease, step=0, key=f"{parent}/0", manifest={"files": []})
    outcomes.transition(sessions, running.lease, WorkState.CANCELLED)
    by_job = JobRequest(parent_job_id=parent)
    search = SearchSpec.model_validate({"space": {"learning_rate": {"type": "float", "low": 1e-4, "high": 1e-3}}})
    for refused in (
        lambda: submission.submit(sessions, by_job, owner="alice"),
        lambda: submission.submit_group(sessions, GroupRequest(by_job, seeds=[1, 2]), owner="alice"),
        lambda: studies.submit_study(sessions, StudyRequest(by_job, search), owner="alice"),
    ):
        with pytest.raises(InvalidError, match="is cancelled and has no trained checkpoint") as error:
            refused()
        assert error.value.field is not None
        assert error.value.field.endswith("parent_job_id")
    submission.submit(sessions, replace(by_job, parent_checkpoint_id=first), owner="alice")
    requests.retry(sessions, Job, parent)
    submission.submit(sessions, by_job, owner="alice")


def test_a_child_whose_parent_was_deleted_never_starts_from_random_weights(
    sessions: Sessions, running: JobClaim, submit: Callable[..., Job]
) -> None:
    parent = running.lease.job_id
    record_checkpoint(sessions, running.lease, step=10, key=f"{parent}/10", manifest={"files": []})
    child = submit(parent_job_id=parent)
    requests.request_cancel(sessions, Job, child.id)
    outcomes.transition(sessions, running.lease, WorkState.CANCELLED)
    requests.delete(sessions, parent)
    requests.retry(sessions, Job, child.id)
    assert claim_work(sessions, Job, child.id, "w") is None
    kept = get(sessions, child.id)
    assert kept.state is WorkState.FAILED
    assert kept.error == "the job whose policy it starts from was deleted"


def test_metrics_are_kept_until_a_new_checkpoint_supersedes_them(sessions: Sessions, running: JobClaim) -> None:
    append_metrics(sessions, running.lease, [{"step": step, "reward": 1.0} for step in (10, 20, 30, 40)])
    checkpoint = record_checkpoint(
        sessions, running.lease, step=20, key=f"{running.lease.job_id}/20", manifest={"files": []}
    )
    outcomes.lose(sessions, running.lease, "the trainer died")
    claim = claim_work(sessions, Job, running.lease.job_id, "w")
    assert claim is not None
    outcomes.begin(sessions, claim.lease, step=20, resumed_from=checkpoint)
    kept = get(sessions, running.lease.job_id)
    assert (kept.progress_step, kept.latest_metrics["step"]) == (20, 20)
    append_metrics(sessions, claim.lease, [{"step": step, "reward": 2.0} for step in (25, 35)])

    def rows() -> list[tuple[int, int]]:
        with sessions.begin() as session:
            found = (
                session.query(MetricsRecord)
                .where(MetricsRecord.job_id == running.lease.job_id)
                .order_by(MetricsRecord.step)
            )
            return [(row.step, row.attempt) for row in found]

    assert rows() == [(10, 1), (20, 1), (25, 2), (30, 1), (35, 2), (40, 1)]
    key = f"{running.lease.job_id}/35"
    record_checkpoint(sessions, claim.lease, step=35, key=key, manifest={"files": []})
    assert rows() == [(10, 1), (20, 1), (25, 2), (35, 2)]
    assert "resumed" in kinds(sessions, running.lease.job_id)
