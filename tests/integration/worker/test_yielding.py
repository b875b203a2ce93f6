"""Trainings that make room: for urgent work, and on a worker that is drained; what they have used stays counted."""

from __future__ import annotations

import platform
import threading

import pytest
import torch
from naojobs import registry, requests, usage
from naojobs.capabilities import live_workers, waiting_reasons
from naojobs.models import Job
from naojobs.states import WorkState
from naosprint_worker.settings import WorkerSettings
from naosprint_worker.worker import WorkLoop

from .conftest import ROLLOUT, Service, WorkerProcess
from .test_jobs import assert_metrics_whole


def test_a_training_makes_room_for_an_urgent_one_and_resumes_from_the_same_step(
    service: Service, worker: WorkerProcess
) -> None:
    low = service.submit(evaluate=False, total_steps=10**9, checkpoint_interval_steps=10**9, priority=4)
    service.until_step(low, ROLLOUT * 4)
    equal = service.submit(evaluate=False, total_steps=ROLLOUT * 4, priority=6)
    urgent = service.submit(evaluate=False, total_steps=ROLLOUT * 4, priority=7)
    service.until(lambda: service.job(low).state is WorkState.QUEUED, what="for the training to make room")
    steps = service.shorten(low)
    requests.request_cancel(service.sessions, Job, equal)
    service.until_state(urgent, WorkState.SUCCEEDED)
    job = service.until_state(low, WorkState.SUCCEEDED)
    assert (job.attempt, job.failures, job.progress_step) == (2, 0, steps)
    asked = [event for event in service.events(low) if event.kind == "requeue_requested"]
    assert [event.data["for"] for event in asked] == [urgent]  # the other one is not urgent enough
    resumed = next(event for event in service.events(low) if event.kind == "resumed")
    assert 0 < resumed.data["step"] < steps
    assert resumed.data["step"] in [checkpoint.step for checkpoint in service.checkpoints(low)]
    assert_metrics_whole(service, low)


def test_settings_and_a_full_disk_keep_a_training_from_making_room(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker without space would not claim what waits."""
    for name, value in service.environment.items():
        monkeypatch.setenv(name, value)
    settings = WorkerSettings()
    loop = WorkLoop(settings)
    try:
        low = service.submit(announce=False, total_steps=10**9, priority=0)
        loop._look_for_work()
        urgent = service.submit(announce=False, priority=9)
        service.move_clock(60)
        for change in ({"worker_preempt_by": 0}, {"worker_min_free_mb": 10**9}, {"worker_claim_s": 600.0}):
            loop._settings = settings.model_copy(update=change)
            loop._look_for_work()
            assert service.job(low).yields_to is None, change
        loop._settings = settings
        loop._look_for_work()
        asked = [event.data["for"] for event in service.events(low) if event.kind == "requeue_requested"]
        assert asked == [urgent]
    finally:
        loop.close()


def test_a_run_that_gets_no_thread_leaves_its_slot_free(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container with too few processes allowed: threads count, too."""
    for name, value in service.environment.items():
        monkeypatch.setenv(name, value)
    loop = WorkLoop(WorkerSettings())
    try:
        service.submit(announce=False, total_steps=10**9)
        before = threading.stack_size(1 << 40)  # of which no thread can be made
        try:
            with pytest.raises(RuntimeError, match="can't start new thread"):
                loop._look_for_work()
        finally:
            threading.stack_size(before)
        second = service.submit(announce=False, total_steps=10**9)
        loop._look_for_work()
        assert service.job(second).lease_owner == loop.id
    finally:
        loop.close()


def test_a_drained_worker_hands_its_training_to_another(service: Service, worker: WorkerProcess) -> None:
    job_id = service.submit(evaluate=False, total_steps=10**9, checkpoint_interval_steps=10**9)
    service.until_step(job_id, ROLLOUT * 4)
    first = str(service.job(job_id).lease_owner)
    registry.drain(service.sessions, first, requeue=True)
    service.until(lambda: service.job(job_id).state is WorkState.QUEUED, what="for the training to be requeued")
    service.shorten(job_id)
    with service.sessions() as session:
        workers = live_workers(session, stale_s=30)
        assert waiting_reasons(session, [session.get_one(Job, job_id)], workers) == {job_id: "all workers are drained"}
    service.start_worker()
    job = service.until_state(job_id, WorkState.SUCCEEDED)
    (claims,) = ([event.data["worker"] for event in service.events(job_id) if event.kind == "claimed"],)
    assert claims[0] == first != claims[1]
    assert (job.failures, worker.process.poll()) == (0, None)
    assert_metrics_whole(service, job_id)
    registry.undrain(service.sessions, first)
    (status,) = registry.workers(service.sessions, only=first)
    assert status.row.drained_at is None


def test_what_a_training_uses_and_runs_with_is_recorded(service: Service, worker: WorkerProcess) -> None:
    job_id = service.submit(evaluate=False, total_steps=10**9)
    service.until_step(job_id, ROLLOUT * 8)
    requests.request_cancel(service.sessions, Job, job_id)
    job = service.until_state(job_id, WorkState.CANCELLED)
    assert job.software["python"] == platform.python_version()
    assert job.software["torch"] == str(torch.__version__)
    assert {"naosprint", "naosim", "numpy", "mujoco"} <= job.software.keys()
    requests.delete(service.sessions, job_id)
    (used,) = usage.usage_by_owner(service.sessions)
    assert used.owner == "tester"
    assert used.cpu_s > 0.1
    assert used.run_s > 0.1
