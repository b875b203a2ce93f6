"""A worker runs jobs: train, evaluate, cancel, pause, resume, start from another's policy."""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path

import naopolicies
import numpy as np
import pytest
from naojobs import requests
from naojobs.capabilities import live_workers, match_task, waiting_reasons
from naojobs.models import Checkpoint, Evaluation, Job, Worker
from naojobs.states import WorkState
from naojobs.store import StoreManifest, artifact_of
from naospec import EvaluationSpec, plugins

from tests.integration.writes import request_evaluation

from .conftest import ROLLOUT, Service, WorkerProcess


def assert_metrics_whole(service: Service, job_id: str) -> None:
    """Every update has one row, from the first to the last."""
    job = service.job(job_id)
    assert [row.step for row in service.metrics(job_id)] == list(range(ROLLOUT, job.total_steps + 1, ROLLOUT))
    assert job.progress_step == job.total_steps
    assert all(row.values["memory_mb"] > 10 and row.values["cpus"] >= 0 for row in service.metrics(job_id))


def test_a_worker_without_work_ends_if_it_may(service: Service) -> None:
    worker = service.start_worker(NAOSPRINT_WORKER_IDLE_EXIT_S="0.5")
    assert worker.process.wait(60) == 0
    assert "ends: it had no work for 0.5 s" in worker.output()
    with service.sessions() as session:
        assert session.query(Worker).count() == 0


def test_a_worker_that_may_end_finishes_its_work_first(service: Service) -> None:
    job_id = service.submit(total_steps=ROLLOUT * 20, evaluate=False)
    worker = service.start_worker(NAOSPRINT_WORKER_IDLE_EXIT_S="0.5")
    assert worker.process.wait(120) == 0
    assert service.job(job_id).state is WorkState.SUCCEEDED


def test_job_is_trained_evaluated_and_stored(shared: Service, finished: str, tmp_path: Path) -> None:
    assert_metrics_whole(shared, finished)
    job = shared.job(finished)
    assert (job.attempt, job.failures, job.error, job.lease_owner) == (1, 0, None, None)
    stored = shared.checkpoints(finished)
    assert [checkpoint.step for checkpoint in stored] == [0, ROLLOUT * 10, ROLLOUT * 20]
    for checkpoint in stored:
        folder = tmp_path / checkpoint.id
        shared.store.get_directory(checkpoint.key, folder, StoreManifest.model_validate(checkpoint.manifest))
        assert json.loads((folder / "checkpoint.json").read_text())["steps"] == checkpoint.step

    with shared.sessions() as session:
        evaluation = session.query(Evaluation).where(Evaluation.job_id == finished).one()
    assert evaluation.checkpoint_id == stored[-1].id
    assert evaluation.state is WorkState.SUCCEEDED
    assert evaluation.key is not None
    kept = json.loads(shared.store.get_bytes(f"{evaluation.key}/evaluation.json"))
    assert kept == evaluation.summary
    assert shared.store.get_bytes(f"{evaluation.key}/trajectories.npz").startswith(b"PK")
    assert_report(shared, evaluation, updates=20, film=False)

    kinds = [kind for kind in shared.kinds(finished) if kind != "checkpoint"]
    assert kinds == ["queued", "claimed", "started", "running", "evaluating", "evaluation", "succeeded"]


def assert_report(service: Service, evaluation: Evaluation, *, updates: int, film: bool) -> None:
    """A self-contained page, plots with their data, and a film if requested, are stored with the evaluation."""
    names = {entry.name for entry in StoreManifest.model_validate(evaluation.manifest).files}
    assert {"report.html", "report.json", "learning-curve.csv"} <= names
    page = service.store.get_bytes(f"{evaluation.key}/report.html").decode()
    assert service.job(evaluation.job_id).name in page
    assert ("data:video/mp4;base64," in page) is film
    assert ({"run.mp4", "run.gif"} <= names) is film
    if film:
        assert service.store.get_bytes(f"{evaluation.key}/run.mp4")[4:8] == b"ftyp"
    table = service.store.get_bytes(f"{evaluation.key}/learning-curve.csv").decode().splitlines()
    assert len(table) == 1 + updates


def test_report_with_a_film(service: Service) -> None:
    service.start_worker(NAOSPRINT_WORKER_REPORT="film")
    job_id = service.submit(total_steps=ROLLOUT)
    service.until_state(job_id, WorkState.SUCCEEDED)
    with service.sessions() as session:
        evaluation = session.query(Evaluation).where(Evaluation.job_id == job_id).one()
    assert_report(service, evaluation, updates=1, film=True)


def test_message_delivered_many_times_to_many_workers_has_one_owner(service: Service) -> None:
    workers = [service.start_worker(), service.start_worker()]
    for worker in workers:
        service.until(lambda worker=worker: "is ready" in worker.output(), what="for a worker to be ready")
    job_id = service.submit(announce=False, evaluate=False, total_steps=ROLLOUT * 4)
    for _ in range(10):
        service.wake_up(job_id)
    service.until_state(job_id, WorkState.SUCCEEDED)
    service.wake_up(job_id)
    next_job = service.submit(evaluate=False, total_steps=ROLLOUT * 4)
    service.until_state(next_job, WorkState.SUCCEEDED)
    assert service.kinds(job_id).count("claimed") == 1
    assert service.job(job_id).attempt == 1
    assert_metrics_whole(service, job_id)


@pytest.mark.parametrize("announced", [True, False])
def test_urgent_job_goes_before_one_that_came_earlier(service: Service, worker: WorkerProcess, announced: bool) -> None:
    """With and without their messages in the broker."""
    busy = service.submit(evaluate=False, total_steps=10**9)
    service.until(lambda: service.job(busy).attempt, what="for the worker to be busy")
    low, high, middle = (
        service.submit(announce=announced, total_steps=10**9, priority=priority) for priority in (1, 9, 5)
    )
    requests.request_cancel(service.sessions, Job, busy)
    service.until(lambda: any(service.job(job_id).attempt for job_id in (low, high, middle)), what="for the next claim")
    assert [service.job(job_id).attempt for job_id in (low, high, middle)] == [0, 1, 0]


def test_cancelled_job_stops_with_what_it_has(shared: Service) -> None:
    job_id = shared.submit(total_steps=10**9, checkpoint_interval_steps=10**9)
    shared.until_step(job_id, ROLLOUT * 4)
    training = shared.workers[0].trainings()[0]
    requests.request_cancel(shared.sessions, Job, job_id)
    job = shared.until_state(job_id, WorkState.CANCELLED)
    assert not training.is_running()
    assert job.lease_owner is None
    last = shared.checkpoints(job_id)[-1].step
    assert last == shared.metrics(job_id)[-1].step > 0
    assert shared.events(job_id)[-1].message == "cancelled as requested"


def test_paused_job_goes_on_where_it_was(shared: Service) -> None:
    job_id = shared.submit(evaluate=False, total_steps=10**9, checkpoint_interval_steps=10**9)
    shared.until_step(job_id, ROLLOUT * 4)
    requests.request_pause(shared.sessions, job_id)
    shared.until_state(job_id, WorkState.PAUSED)
    at = shared.checkpoints(job_id)[-1].step
    assert at > 0
    assert shared.workers[0].trainings() == []

    steps = shared.shorten(job_id)
    requests.resume(shared.sessions, job_id)
    shared.wake_up(job_id)
    job = shared.until_state(job_id, WorkState.SUCCEEDED)
    assert (job.attempt, job.failures) == (2, 0)
    assert_metrics_whole(shared, job_id)
    resumed = next(event for event in shared.events(job_id) if event.kind == "resumed")
    assert resumed.data["step"] == at
    assert [checkpoint.step for checkpoint in shared.checkpoints(job_id)] == [0, at, steps]


def test_job_starts_from_anothers_policy(shared: Service, finished: str) -> None:
    child = shared.submit(task="sprint1", evaluate=False, total_steps=ROLLOUT * 4, parent_job_id=finished)
    shared.until_state(child, WorkState.SUCCEEDED)
    note = next(event for event in shared.events(child) if event.kind == "initial_policy")
    newest = shared.checkpoints(finished)[-1]
    assert note.data == {"job_id": finished, "checkpoint_id": newest.id, "step": newest.step}
    assert_metrics_whole(shared, child)


def test_job_starts_from_a_bundled_policy(shared: Service) -> None:
    shape = {"task": "sprint1", "hidden_sizes": [64, 64], "symmetric_policy": True, "checkpoint_interval_steps": 1}
    child = shared.submit(evaluate=False, total_steps=ROLLOUT, parent_policy="sprint", **shape)
    shared.until_state(child, WorkState.SUCCEEDED)
    note = next(event for event in shared.events(child) if event.kind == "initial_policy")
    assert note.data == {"policy": "sprint"}
    first = shared.checkpoints(child)[0]
    mine = np.load(BytesIO(shared.store.get_bytes(f"{first.key}/policy.npz")))
    theirs = np.load(naopolicies.folder("sprint") / naopolicies.WEIGHTS)
    np.testing.assert_array_equal(mine["action_net.weight"], theirs["action_net.weight"])


def test_damaged_checkpoint_is_not_resumed_from(shared: Service) -> None:
    job_id = shared.submit(evaluate=False, total_steps=10**9, checkpoint_interval_steps=ROLLOUT * 10)
    shared.until_checkpoints(job_id, 2)
    requests.request_pause(shared.sessions, job_id)
    shared.until_state(job_id, WorkState.PAUSED)
    *_, earlier, newest = shared.checkpoints(job_id)
    damaged = next((shared.artifacts / newest.key).glob("*.npz"))
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"!")

    shared.shorten(job_id)
    requests.resume(shared.sessions, job_id)
    shared.wake_up(job_id)
    shared.until_state(job_id, WorkState.SUCCEEDED)
    notes = {event.kind: event.data for event in shared.events(job_id)}
    assert notes["checkpoint_unusable"]["checkpoint_id"] == newest.id
    assert notes["resumed"]["checkpoint_id"] == earlier.id
    assert_metrics_whole(shared, job_id)


def test_a_whole_checkpoint_that_cannot_be_resumed_from_is_passed_over(shared: Service) -> None:
    """Its files match its row, but it is of another training; the one before it is used."""
    job_id = shared.submit(evaluate=False, total_steps=10**9, checkpoint_interval_steps=ROLLOUT * 10)
    shared.until_checkpoints(job_id, 2)
    requests.request_pause(shared.sessions, job_id)
    shared.until_state(job_id, WorkState.PAUSED)
    *_, earlier, newest = shared.checkpoints(job_id)
    folder = shared.folder / "other-format"
    shared.store.get_directory(newest.key, folder)
    manifest = folder / "checkpoint.json"
    manifest.write_text(manifest.read_text().replace('"format": ', '"format": 9'))
    stored = shared.store.put_directory(f"jobs/{job_id}/checkpoints/other-format", folder)
    with shared.sessions.begin() as session:
        row = session.get_one(Checkpoint, newest.id)
        row.key, row.manifest = f"jobs/{job_id}/checkpoints/other-format", stored.model_dump(mode="json")

    shared.shorten(job_id)
    requests.resume(shared.sessions, job_id)
    shared.wake_up(job_id)
    shared.until_state(job_id, WorkState.SUCCEEDED)
    (note,) = [event.data for event in shared.events(job_id) if event.kind == "checkpoint_unusable"]
    assert note["checkpoint_id"] == newest.id
    resumed = [event.data["checkpoint_id"] for event in shared.events(job_id) if event.kind == "resumed"]
    assert resumed == [newest.id, earlier.id]
    assert_metrics_whole(shared, job_id)


def test_job_without_a_usable_checkpoint_fails_and_keeps_its_metrics(shared: Service) -> None:
    """Its files are moved away while it is paused; once they are back, a retry resumes where it was."""
    job_id = shared.submit(evaluate=False, total_steps=10**9, checkpoint_interval_steps=ROLLOUT * 10)
    shared.until_checkpoints(job_id, 2)
    requests.request_pause(shared.sessions, job_id)
    shared.until_state(job_id, WorkState.PAUSED)
    known = [row.step for row in shared.metrics(job_id)]
    newest = shared.checkpoints(job_id)[-1].step
    folder, aside = shared.artifacts / "jobs" / job_id, shared.folder / "aside"
    folder.rename(aside)

    requests.resume(shared.sessions, job_id)
    shared.wake_up(job_id)
    job = shared.until_state(job_id, WorkState.FAILED)
    assert f"none of its {len(shared.checkpoints(job_id))} checkpoints can be used" in (job.error or "")
    assert [row.step for row in shared.metrics(job_id)] == known

    aside.rename(folder)
    shared.shorten(job_id)
    requests.retry(shared.sessions, Job, job_id)
    shared.wake_up(job_id)
    shared.until_state(job_id, WorkState.SUCCEEDED)
    resumed = [event.data["step"] for event in shared.events(job_id) if event.kind == "resumed"]
    assert resumed == [newest]
    assert_metrics_whole(shared, job_id)


def test_only_the_checkpoints_that_are_worth_it_are_kept(service: Service) -> None:
    service.start_worker(NAOSPRINT_WORKER_KEEP_LAST="2", NAOSPRINT_WORKER_KEEP_EVERY="4")
    job_id = service.submit(evaluate=False, total_steps=ROLLOUT * 22, checkpoint_interval_steps=ROLLOUT * 2)
    service.until_state(job_id, WorkState.SUCCEEDED)
    stored = service.checkpoints(job_id)
    steps = {checkpoint.step // ROLLOUT for checkpoint in stored}
    rewards = {row.step // ROLLOUT: row.values["reward"] for row in service.metrics(job_id) if "reward" in row.values}
    saved = {step: reward for step, reward in rewards.items() if step % 2 == 0}
    # Which one was the best changes while it trains; each was removed only once another was better.
    best = {step for step in saved if saved[step] == max(saved.values())}
    assert {0, 8, 16, 20, 22} <= steps
    assert steps <= {0, 8, 16, 20, 22} | best
    assert not saved or steps & best
    assert {artifact_of(key) for key in service.store.list("jobs")} == {checkpoint.key for checkpoint in stored}


def test_training_that_diverges_fails_at_once_and_says_so(shared: Service) -> None:
    job_id = shared.submit(
        total_steps=10**6, preset="paper", learning_rate=0.1, entropy_coefficient=1.0, n_epochs=50, max_grad_norm=None
    )
    job = shared.until_state(job_id, WorkState.FAILED)
    assert job.attempt == 1
    assert "TrainingDivergedError" in (job.error or "")
    assert shared.events(job_id)[-1].data["kind"] == "diverged"


@pytest.mark.parametrize("limit", ["MEMORY_MB", "MEMORY_TOTAL_MB"])
def test_training_that_needs_too_much_memory_fails_and_says_so(service: Service, limit: str) -> None:
    service.start_worker(**{f"NAOSPRINT_WORKER_{limit}": "128"})
    job = service.until_state(service.submit(total_steps=10**9), WorkState.FAILED)
    assert "more than the worker's limit of 128 MiB" in (job.error or "")
    assert f"raise NAOSPRINT_WORKER_{limit}" in (job.error or "")


def test_evaluations_on_request(shared: Service, finished: str) -> None:
    """One of a complete checkpoint, and one of a checkpoint that lacks a file."""
    first, _, newest = shared.checkpoints(finished)
    next((shared.artifacts / first.key).glob("*.npz")).unlink()
    spec = EvaluationSpec(episodes=3, n_envs=2, bootstrap_resamples=100)
    asked = [
        request_evaluation(shared.sessions, finished, checkpoint_id=checkpoint.id, spec=spec).id
        for checkpoint in (newest, first)
    ]
    for evaluation_id in asked * 3:
        assert shared.notifier.wake_up(evaluation_id, "embedded") is None

    def ended() -> list[Evaluation] | None:
        with shared.sessions() as session:
            rows = [session.get_one(Evaluation, evaluation_id) for evaluation_id in asked]
        return rows if all(row.finished_at for row in rows) else None

    rows = shared.until(ended)
    assert rows is not None
    whole, broken = rows
    assert (whole.state, whole.attempt, whole.error) == (WorkState.SUCCEEDED, 1, None)
    assert json.loads(shared.store.get_bytes(f"{whole.key}/evaluation.json")) == whole.summary
    assert_report(shared, whole, updates=20, film=False)
    assert (broken.state, broken.attempt) == (WorkState.FAILED, 1)
    assert "no such file" in (broken.error or "")


def test_a_checkpoint_is_evaluated_while_its_job_keeps_the_only_slot_busy(service: Service) -> None:
    service.start_worker()
    job_id = service.submit(total_steps=10**9, checkpoint_interval_steps=2 * ROLLOUT)
    checkpoint = service.until(lambda: service.checkpoints(job_id)[:1], what="for a checkpoint")[0]
    spec = EvaluationSpec(episodes=2, n_envs=2, bootstrap_resamples=100)
    wanted = {"checkpoint_id": checkpoint.id, "spec": spec, "report": "pictures"}  # the worker draws none by itself
    asked = request_evaluation(service.sessions, job_id, **wanted).id
    assert service.notifier.wake_up(asked, "embedded") is None

    def ended() -> Evaluation | None:
        with service.sessions() as session:
            row = session.get_one(Evaluation, asked)
        return row if row.finished_at else None

    row = service.until(ended, what="for the evaluation")
    assert (row.state, row.attempt, row.error) == (WorkState.SUCCEEDED, 1, None)
    names = {file["name"] for file in (row.manifest or {})["files"]}
    assert "report.html" in names and "run.mp4" not in names
    job = service.job(job_id)
    assert (job.state, job.attempt) == (WorkState.RUNNING, 1)


def test_messages_for_jobs_that_do_not_wait_do_nothing(service: Service) -> None:
    """The worker starts when they no longer wait: one that is at work takes any job that does, message or not."""
    cancelled, paused = service.submit(announce=False), service.submit(announce=False)
    requests.request_cancel(service.sessions, Job, cancelled)
    requests.request_pause(service.sessions, paused)
    marker = service.submit(announce=False, evaluate=False, total_steps=ROLLOUT)
    for job_id in (cancelled, paused, "job_00000000000000000000000000", marker):
        assert service.notifier.wake_up(job_id, "embedded") is None
    service.start_worker()
    service.until_state(marker, WorkState.SUCCEEDED)
    assert (service.job(cancelled).state, service.job(cancelled).attempt) == (WorkState.CANCELLED, 0)
    assert (service.job(paused).state, service.job(paused).attempt) == (WorkState.PAUSED, 0)


def test_a_worker_leaves_work_that_it_cannot_run_to_others(service: Service) -> None:
    """It registers what it can run, and skips an urgent job of a newer version of its task."""
    job_id = service.submit(evaluate=False, total_steps=ROLLOUT)
    newer = service.submit(evaluate=False, total_steps=ROLLOUT, priority=9)
    with service.sessions.begin() as session:
        session.get_one(Job, newer).task_version = 2
    service.start_worker()
    service.until_state(job_id, WorkState.SUCCEEDED)
    job = service.job(newer)
    assert (job.state, job.attempt) == (WorkState.QUEUED, 0)
    with service.sessions() as session:
        worker = session.query(Worker).one()
        reasons = waiting_reasons(session, [job], live_workers(session, stale_s=30))
    plain, confined = (match_task(confined=confined, contained=False) for confined in (False, True))
    matches = {name for name in worker.tasks if name in (plain, confined)}  # what this kernel can confine
    assert plain in matches
    assert worker.tasks == dict.fromkeys((*plugins.names(plugins.TASKS), *matches), 1)
    assert (worker.robots, worker.simulators) == (list(plugins.names(plugins.ROBOTS)), ["embedded", "match"])
    assert reasons == {newer: "no worker has task 'sprint2' version 2 (workers have version 1)"}
