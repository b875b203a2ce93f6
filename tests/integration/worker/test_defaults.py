"""With a worker's default intervals: detection within a minute, outages of half a minute."""

from __future__ import annotations

import os
import signal
from datetime import datetime, timedelta

import pytest
from naojobs import requests
from naojobs.models import Job
from naojobs.states import WorkState
from naosprint_worker.settings import WorkerSettings
from sqlalchemy import func, select

from tests.integration.conftest import S3Server

from .conftest import FAST, ROLLOUT, Service
from .test_outages import lose_the_store

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(400)]

DEFAULTS = {
    name: str(WorkerSettings.model_fields[name.removeprefix("NAOSPRINT_").lower()].default)
    for name in FAST
    if name not in ("NAOSPRINT_MODE", "NAOSPRINT_WORKER_CHECKPOINT_S", "NAOSPRINT_WORKER_KEEP_LAST")
}
"""The settings that the other tests shorten, as they are, but every checkpoint is written and kept."""


def database_time(service: Service) -> datetime:
    with service.sessions() as session:
        return session.execute(select(func.clock_timestamp())).scalar_one()


@pytest.mark.parametrize("with_trainer", [True, False])
def test_job_of_a_dead_worker_is_somebody_elses_within_a_minute(service: Service, with_trainer: bool) -> None:
    """Whether its training process died with it (its lease must expire) or requeued the job."""
    worker = service.start_worker(**DEFAULTS)
    job_id = service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    service.until_checkpoints(job_id, 2)
    service.start_worker(**DEFAULTS)
    training = service.until_training(worker)
    died = database_time(service)
    if with_trainer:
        os.killpg(training.pid, signal.SIGKILL)
    os.killpg(worker.pid, signal.SIGKILL)
    worker.process.wait()
    service.until(lambda: service.job(job_id).attempt == 2, what="for another worker to take the job")
    claimed = [event.at for event in service.events(job_id) if event.kind == "claimed"][1]
    assert claimed - died < timedelta(seconds=60)
    service.until(lambda: "resumed" in service.kinds(job_id), what="for it to resume")
    requests.request_cancel(service.sessions, Job, job_id)
    service.until_state(job_id, WorkState.CANCELLED)


def test_s3_server_that_is_away_for_half_a_minute(s3_service: Service, s3_server: S3Server) -> None:
    s3_service.start_worker(**DEFAULTS)
    job_id = s3_service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    lose_the_store(s3_service, s3_server, job_id, 30)
