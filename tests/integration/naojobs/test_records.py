"""Records of workers: in order, once, and only with a lease."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from naojobs import leases, outcomes, records, registry, requests, submission
from naojobs.capabilities import Capabilities, live_workers
from naojobs.changes import MAX_LOG_CHARS
from naojobs.errors import ConflictError, LeaseLostError, NotFoundError
from naojobs.health import has_live_worker
from naojobs.leases import Lease
from naojobs.models import Checkpoint, Evaluation, Event, Job, Log, MetricsRecord
from naojobs.settings import ServiceSettings
from naojobs.states import ENDED, EVALUATION_STATES, LEASED, TRANSITIONS, WorkState
from naojobs.submission import JobRequest
from naospec import EvaluationSpec
from sqlalchemy import text
from sqlalchemy.exc import DataError, IntegrityError
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work
from tests.integration.writes import append_metrics, record_checkpoint, record_event, request_evaluation

Sessions = sessionmaker[Session]

HOST: dict[str, Any] = {
    "host": "h",
    "capabilities": Capabilities({"sprint1": 1}, ["nao-0"], ["embedded"], ["ppo"]),
}


@pytest.fixture
def lease(sessions: Sessions) -> Lease:
    """The lease of a running job."""
    job, _ = submission.submit(sessions, JobRequest(), owner="alice")
    claim = claim_work(sessions, Job, job.id, "worker-1")
    assert claim is not None
    outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
    return claim.lease


def rows(sessions: Sessions, model: Any, job_id: str) -> list[Any]:
    order = model.step if model is MetricsRecord else model.id
    with sessions.begin() as session:
        return session.query(model).where(model.job_id == job_id).order_by(order).all()


def test_metrics_written_twice_are_there_once(sessions: Sessions, lease: Lease) -> None:
    batch = [{"step": 10, "time_s": 1.5, "reward": 1.0}, {"step": 20, "reward": 2.0}]
    append_metrics(sessions, lease, batch)
    append_metrics(sessions, lease, batch)
    append_metrics(sessions, lease, [{"step": 20, "reward": 3.0}])
    found = rows(sessions, MetricsRecord, lease.job_id)
    assert [(row.step, row.time_s, row.values["reward"]) for row in found] == [(10, 1.5, 1.0), (20, None, 3.0)]
    assert found[1].seq > found[0].seq
    with sessions.begin() as session:
        job = session.get_one(Job, lease.job_id)
    assert (job.progress_step, job.latest_metrics) == (20, {"step": 20.0, "reward": 3.0})


def test_figures_that_are_no_numbers_are_left_out(sessions: Sessions, lease: Lease) -> None:
    append_metrics(sessions, lease, [{"step": 1, "a": float("nan"), "b": float("inf"), "c": 1.0}])
    assert rows(sessions, MetricsRecord, lease.job_id)[0].values == {"step": 1.0, "c": 1.0}
    with pytest.raises(ValueError, match="without step"):
        append_metrics(sessions, lease, [{"reward": 1.0}])


def test_logs_keep_their_order_and_any_text(sessions: Sessions, lease: Lease) -> None:
    lines = [records.LogLine("INFO", f"line {number}") for number in range(50)]
    lines += [records.LogLine("error", "zero \x00 byte"), records.LogLine("info", "x" * 100_000)]
    records.append_logs(sessions, lease, lines)
    found = rows(sessions, Log, lease.job_id)
    assert [row.message for row in found[:50]] == [line.message for line in lines[:50]]
    assert found[50].message == "zero \N{REPLACEMENT CHARACTER} byte"
    assert len(found[51].message) == MAX_LOG_CHARS
    assert {row.level for row in found} == {"info", "error"}


def test_a_log_line_has_the_time_of_the_databases_clock_at_which_it_was_made(
    sessions: Sessions, lease: Lease, clock_ahead: timedelta
) -> None:
    """As events have it: a worker's clock may be wrong, and a line may wait for a database that does not answer."""
    records.append_logs(sessions, lease, [records.LogLine("info", "late", time.monotonic() - 600.0)])
    records.append_logs(sessions, lease, [records.LogLine("info", "at once")])
    late, at_once = (datetime.now(UTC) + clock_ahead - row.at for row in rows(sessions, Log, lease.job_id))
    assert timedelta(seconds=-60) < at_once < timedelta(seconds=60)
    assert timedelta(seconds=540) < late < timedelta(seconds=660)


@pytest.mark.parametrize("bad", ["\x00", "\udc80", "\ud800", "\\u0000\x00"], ids=ascii)
def test_text_that_the_server_cannot_hold_is_replaced_everywhere(sessions: Sessions, lease: Lease, bad: str) -> None:
    good = bad.replace("\\u0000", "-").replace("\x00", "?").replace("\udc80", "?").replace("\ud800", "?")

    def stored(text: str) -> str:
        return text.replace("\\u0000", "-").replace("\N{REPLACEMENT CHARACTER}", "?")

    append_metrics(sessions, lease, [{"step": 1, f"m{bad}": 1.0, "reward": 2.0}])
    records.append_logs(sessions, lease, [records.LogLine("error", f"l{bad}"), records.LogLine("info", "fine")])
    record_event(sessions, lease, "report", f"e{bad}", {"paths": [f"p{bad}"], f"k{bad}": {"x": f"v{bad}"}})
    submission.edit(sessions, lease.job_id, notes=f"o{bad}", tags=[f"t{bad}"])
    outcomes.transition(sessions, lease, WorkState.FAILED, error=f"f{bad}")
    (metric,) = rows(sessions, MetricsRecord, lease.job_id)
    assert [stored(name) for name in sorted(metric.values)] == [f"m{good}", "reward", "step"]
    assert [stored(line.message) for line in rows(sessions, Log, lease.job_id)] == [f"l{good}", "fine"]
    (event,) = [event for event in rows(sessions, Event, lease.job_id) if event.kind == "report"]
    assert stored(event.message) == f"e{good}"
    assert {stored(key): value for key, value in event.data.items()}.keys() == {"paths", f"k{good}"}
    assert stored(event.data["paths"][0]) == f"p{good}"
    with sessions.begin() as session:
        job = session.get_one(Job, lease.job_id)
        session.refresh(job)
        texts = [stored(text) for text in (job.notes, *job.tags, str(job.error))]
    assert texts == [f"o{good}", f"t{good}", f"f{good}"]


def test_a_checkpoint_recorded_twice_is_there_once(sessions: Sessions, lease: Lease) -> None:
    key = f"jobs/{lease.job_id}/checkpoints/1"
    first = record_checkpoint(sessions, lease, step=1, key=key, manifest={"files": []})
    assert record_checkpoint(sessions, lease, step=1, key=key, manifest={"files": []}) == first
    events = [event for event in rows(sessions, Event, lease.job_id) if event.kind == "checkpoint"]
    assert [event.data["checkpoint_id"] for event in events] == [first]


def test_a_batch_written_twice_is_there_once(sessions: Sessions, lease: Lease) -> None:
    """The first commit may have succeeded although its answer was lost."""
    batch = records.Batch(
        metrics=[records.MetricsRow(10, {"step": 10.0})],
        logs=[records.LogLine("info", "once")],
        events=[records.EventRecord("test", "once")],
        checkpoints=[records.StoredCheckpoint(10, f"{lease.job_id}/once", {"files": []})],
    )
    assert records.write(sessions, lease, batch) == records.write(sessions, lease, batch)
    assert [row.message for row in rows(sessions, Log, lease.job_id)] == ["once"]
    assert [row.message for row in rows(sessions, Event, lease.job_id)].count("once") == 1
    assert [row.step for row in rows(sessions, MetricsRecord, lease.job_id)] == [10]
    records.write(sessions, lease, records.Batch(logs=[records.LogLine("info", "once")]))
    assert len(rows(sessions, Log, lease.job_id)) == 2, "another batch"


def test_ids_ascend_in_the_order_of_commits(sessions: Sessions, lease: Lease) -> None:
    """A follower reads after the last id it saw, so it would miss a lower id that is committed later."""

    def write(number: int) -> None:
        record_event(sessions, lease, "test", str(number))

    seen: list[int] = []
    with ThreadPoolExecutor(6) as pool:
        futures = [pool.submit(write, number) for number in range(60)]
        while not all(future.done() for future in futures):
            with sessions.begin() as session:
                last = seen[-1] if seen else 0
                seen += session.scalars(
                    text("SELECT id FROM events WHERE job_id = :job AND id > :last ORDER BY id"),
                    {"job": lease.job_id, "last": last},
                )
        for future in futures:
            future.result()
    everything = [event.id for event in rows(sessions, Event, lease.job_id)]
    assert seen == everything[: len(seen)]
    assert len(everything) >= 60


def test_an_evaluation_at_the_end_of_a_job(sessions: Sessions, lease: Lease) -> None:
    checkpoint = record_checkpoint(sessions, lease, step=1, key=f"{lease.job_id}/c", manifest={"files": []})
    evaluation = records.record_evaluation(
        sessions,
        lease,
        checkpoint_id=checkpoint,
        spec=EvaluationSpec(episodes=10),
        summary={"speed_mps": 1.0},
        key="k",
        manifest={"files": []},
    )
    (found,) = rows(sessions, Evaluation, lease.job_id)
    assert (found.id, found.state, found.summary) == (evaluation, WorkState.SUCCEEDED, {"speed_mps": 1.0})


def test_an_evaluation_on_request_from_claim_to_figures(sessions: Sessions, lease: Lease) -> None:
    with pytest.raises(ConflictError, match="no checkpoint yet"):
        request_evaluation(sessions, lease.job_id)
    record_checkpoint(sessions, lease, step=1, key=f"{lease.job_id}/1", manifest={"files": []})
    newest = record_checkpoint(sessions, lease, step=2, key=f"{lease.job_id}/2", manifest={"files": []})
    evaluation = request_evaluation(sessions, lease.job_id, spec=EvaluationSpec(episodes=5))
    assert (evaluation.checkpoint_id, evaluation.state) == (newest, WorkState.QUEUED)

    with ThreadPoolExecutor(4) as pool:
        claims = [
            claim
            for claim in pool.map(lambda n: claim_work(sessions, Evaluation, evaluation.id, f"w{n}"), range(4))
            if claim is not None
        ]
    assert len(claims) == 1
    leases.heartbeat(sessions, claims[0].lease)
    outcomes.transition(sessions, claims[0].lease, WorkState.RUNNING)
    records.record_result(sessions, claims[0].lease, summary={"speed_mps": 2.0}, key="k", manifest={"files": []})
    outcomes.transition(sessions, claims[0].lease, WorkState.SUCCEEDED)
    (found,) = rows(sessions, Evaluation, lease.job_id)
    assert (found.state, found.summary, found.lease_owner) == (WorkState.SUCCEEDED, {"speed_mps": 2.0}, None)
    with pytest.raises(LeaseLostError):
        outcomes.transition(sessions, claims[0].lease, WorkState.FAILED, error="late")


def test_an_evaluation_whose_workers_die_fails_at_last(sessions: Sessions, lease: Lease) -> None:
    record_checkpoint(sessions, lease, step=1, key=f"{lease.job_id}/1", manifest={"files": []})
    evaluation = request_evaluation(sessions, lease.job_id)
    for _ in range(3):
        claim = claim_work(sessions, Evaluation, evaluation.id, "w")
        assert claim is not None
        with sessions.begin() as session:
            session.execute(text("UPDATE evaluations SET lease_expires_at = 'epoch'"))
        outcomes.requeue_stale(sessions)
        with pytest.raises(LeaseLostError):
            leases.heartbeat(sessions, claim.lease)
    (found,) = rows(sessions, Evaluation, lease.job_id)
    assert found.state is WorkState.FAILED
    assert "attempt 3 of 3" in found.error


def test_a_checkpoint_of_another_job_is_not_evaluated(sessions: Sessions, lease: Lease) -> None:
    foreign = record_checkpoint(sessions, lease, step=1, key=f"{lease.job_id}/1", manifest={"files": []})
    other, _ = submission.submit(sessions, JobRequest(), owner="alice")
    with pytest.raises(NotFoundError):
        request_evaluation(sessions, other.id, checkpoint_id=foreign)


def test_an_attempt_with_other_software_says_so(sessions: Sessions) -> None:
    """The first attempt has nothing to compare with, and a repeated write adds nothing."""
    job, _ = submission.submit(sessions, JobRequest(max_attempts=10), owner="alice")
    ran = [{"naosprint": "1", "numpy": "2.0"}, {"naosprint": "2", "numpy": "2.0", "commit": "abc"}]
    for software in (ran[0], ran[0], ran[1]):
        claim = claim_work(sessions, Job, job.id, "worker-1")
        assert claim is not None
        for _ in range(2):
            outcomes.begin(sessions, claim.lease, step=0, software=software)
        outcomes.lose(sessions, claim.lease, "the worker is gone")
    changes = [event for event in rows(sessions, Event, job.id) if event.kind == "software_changed"]
    assert [(event.attempt, event.data) for event in changes] == [(3, {"before": ran[0]})]
    assert "commit none -> abc, naosprint 1 -> 2" in changes[0].message
    with sessions() as session:
        assert session.get_one(Job, job.id).software == ran[1]


@pytest.mark.parametrize("silent_since", ["1 minute", "-1 hour"])
def test_the_registry_lists_who_is_alive_and_what_each_has_leased(
    sessions: Sessions, lease: Lease, service_settings: ServiceSettings, silent_since: str
) -> None:
    """A heartbeat in the future was before the database's clock was set back."""
    registry.beat(sessions, "worker-1", pid=1, version="1", **HOST)
    registry.beat(sessions, "worker-2", pid=2, version="1", **HOST)
    with sessions.begin() as session:
        silent = text("UPDATE workers SET heartbeat_at = now() - CAST(:since AS interval) WHERE id = 'worker-2'")
        session.execute(silent, {"since": silent_since})
        assert [worker.id for worker in live_workers(session, stale_s=30)] == ["worker-1"]
    found = {worker.row.id: worker for worker in registry.workers(sessions)}
    assert found["worker-1"].alive
    assert lease.job_id in found["worker-1"].jobs
    assert not found["worker-2"].alive
    assert registry.beat(sessions, "worker-1", pid=1, version="1", **HOST) == 1
    registry.leave(sessions, "worker-1")
    assert not has_live_worker(service_settings, HOST["host"])
    assert registry.beat(sessions, "worker-2", pid=2, version="2", **HOST) == 1
    assert has_live_worker(service_settings, HOST["host"])
    assert registry.beat(sessions, "worker-1", pid=1, version="1", **HOST) == 2
    assert {worker.row.id: worker for worker in registry.workers(sessions)}["worker-2"].alive
    registry.leave(sessions, "worker-1")
    assert [worker.row.id for worker in registry.workers(sessions)] == ["worker-2"]
    registry.forget(sessions, after_s=-1)
    assert registry.workers(sessions) == []


def test_a_batch_is_written_as_a_whole_or_not_at_all(sessions: Sessions, lease: Lease) -> None:
    batch = records.Batch(
        metrics=[records.MetricsRow(10, {"step": 10, "reward": 1.0})],
        logs=[records.LogLine("info", "a line")],
        events=[records.EventRecord("test", "an event")],
        checkpoints=[records.StoredCheckpoint(10, f"{lease.job_id}/10", {"files": []})],
    )
    broken = replace(batch, events=[records.EventRecord("k" * 41, "longer than its column")])
    counts = {model: len(rows(sessions, model, lease.job_id)) for model in (MetricsRecord, Log, Event, Checkpoint)}
    with pytest.raises(DataError):
        records.write(sessions, lease, broken)
    for model, count in counts.items():
        assert len(rows(sessions, model, lease.job_id)) == count, model
    with sessions() as session:
        assert session.get_one(Job, lease.job_id).progress_step == 0
    ids = records.write(sessions, lease, batch)
    assert [row.id for row in rows(sessions, Checkpoint, lease.job_id)] == [ids[10]]
    assert records.write(sessions, lease, batch) == ids, "a repeated write keeps the checkpoint"
    assert len(rows(sessions, MetricsRecord, lease.job_id)) == 1


@pytest.fixture
def evaluation(sessions: Sessions, lease: Lease) -> Evaluation:
    """An evaluation that waits."""
    record_checkpoint(sessions, lease, step=1, key=f"{lease.job_id}/1", manifest={"files": []})
    return request_evaluation(sessions, lease.job_id, time_limit_s=7.0)


def test_an_evaluation_has_the_life_cycle_of_a_job(sessions: Sessions, evaluation: Evaluation) -> None:
    for failures in (1, 2):
        claim = claim_work(sessions, Evaluation, evaluation.id, "w")
        assert claim is not None
        assert (claim.lease.attempt, claim.time_limit_s) == (failures, 7.0)
        with pytest.raises(ConflictError, match="starting and cannot become succeeded"):
            outcomes.transition(sessions, claim.lease, WorkState.SUCCEEDED)
        outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
        assert outcomes.lose(sessions, claim.lease, "the evaluator died") is WorkState.QUEUED
    claim = claim_work(sessions, Evaluation, evaluation.id, "w")
    assert claim is not None
    outcomes.transition(sessions, claim.lease, WorkState.QUEUED, message="the worker shuts down")
    claim = claim_work(sessions, Evaluation, evaluation.id, "w")
    assert claim is not None
    outcomes.transition(sessions, claim.lease, WorkState.FAILED, error="time limit")
    (found,) = rows(sessions, Evaluation, evaluation.job_id)
    assert (found.state, found.failures, found.attempt, found.error) == (WorkState.FAILED, 2, 4, "time limit")
    events = [event for event in rows(sessions, Event, evaluation.job_id) if event.kind == "evaluation"]
    assert {event.data["evaluation_id"] for event in events} == {evaluation.id}
    states = [event.data["state"] for event in events]
    assert states == ["queued", "running", "queued", "running", "queued", "queued", "failed"]


def test_an_evaluation_is_cancelled_while_it_waits_or_when_its_worker_stops(
    sessions: Sessions, lease: Lease, evaluation: Evaluation
) -> None:
    running = request_evaluation(sessions, lease.job_id)
    assert requests.request_cancel(sessions, Evaluation, evaluation.id).state is WorkState.CANCELLED
    assert claim_work(sessions, Evaluation, evaluation.id, "w") is None
    claim = claim_work(sessions, Evaluation, running.id, "w")
    assert claim is not None
    for _ in range(2):
        assert requests.request_cancel(sessions, Evaluation, running.id).cancel_requested
    assert leases.read_requests(sessions, claim.lease).cancel
    assert outcomes.lose(sessions, claim.lease, "the evaluator died") is WorkState.CANCELLED
    with pytest.raises(NotFoundError):
        requests.request_cancel(sessions, Evaluation, lease.job_id)


def test_deleting_a_job_ends_the_leases_of_its_evaluations(
    sessions: Sessions, lease: Lease, evaluation: Evaluation
) -> None:
    claim = claim_work(sessions, Evaluation, evaluation.id, "w")
    assert claim is not None
    outcomes.transition(sessions, lease, WorkState.CANCELLED)
    requests.delete(sessions, lease.job_id)
    for late in (
        lambda: leases.heartbeat(sessions, claim.lease),
        lambda: outcomes.lose(sessions, claim.lease, "late"),
        lambda: records.record_result(sessions, claim.lease, summary={}, key="k", manifest={}),
    ):
        with pytest.raises(LeaseLostError):
            late()


@pytest.mark.parametrize("state", sorted(EVALUATION_STATES))
def test_the_database_and_the_table_agree_on_the_states_of_an_evaluation(
    sessions: Sessions, evaluation: Evaluation, state: WorkState
) -> None:
    values = {"state": state, "owner": "w" if state in LEASED else None, "id": evaluation.id}
    with sessions.begin() as session:
        # the result is there, without which no evaluation has succeeded
        result = "summary = '{}', key = 'k', manifest = '{}'"
        session.execute(
            text(f"UPDATE evaluations SET state = :state, lease_owner = :owner, {result} WHERE id = :id"), values
        )
    try:
        after = requests.request_cancel(sessions, Evaluation, evaluation.id).state
    except ConflictError:
        assert state in ENDED
    else:
        assert after is state or after in TRANSITIONS[state]
    with pytest.raises(IntegrityError, match="state_known"), sessions.begin() as session:
        session.execute(text("UPDATE evaluations SET state = 'paused', lease_owner = NULL"))
