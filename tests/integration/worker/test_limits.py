"""Limits that a worker's settings put on its child processes."""

from __future__ import annotations

from naojobs.states import WorkState
from naospec import EvaluationSpec

from tests.integration.writes import request_evaluation

from .conftest import ROLLOUT, Service


def test_a_training_that_takes_too_long_fails(service: Service) -> None:
    service.start_worker(NAOSPRINT_WORKER_TIME_LIMIT_S="0.5")
    job = service.until_state(service.submit(total_steps=10**9), WorkState.FAILED, timeout_s=20)
    assert job.error == "the trainer ran longer than its time limit of 0.5 s"
    assert job.attempt == 1


def test_an_evaluation_has_the_threads_that_are_set(service: Service) -> None:
    """Many more than processors, so that no other threads of the process can be taken for them."""
    worker = service.start_worker(NAOSPRINT_WORKER_EVALUATION_THREADS="250")
    job_id = service.submit(total_steps=10**9, checkpoint_interval_steps=2 * ROLLOUT)
    service.until_checkpoints(job_id, 1)
    training = service.until_training(worker).pid
    evaluation = request_evaluation(service.sessions, job_id, spec=EvaluationSpec(episodes=10**5, n_envs=2))
    service.wake_up(evaluation.id)
    service.until(
        lambda: any(child.pid != training and child.num_threads() >= 250 for child in worker.trainings()),
        timeout_s=20,
        what="for the threads of the evaluation",
    )
