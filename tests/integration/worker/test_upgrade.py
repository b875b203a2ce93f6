"""The data of the release before, run on this version: `release` has its database and its artifacts.

There is no release yet; the data is of the last state before formats had numbers.
"""

from __future__ import annotations

import json
import lzma
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest
from naojobs import requests
from naojobs.archive import import_artifacts
from naojobs.database import REVISION, upgrade
from naojobs.models import Evaluation, Job
from naojobs.roles import create_roles
from naojobs.states import WorkState
from naojobs.store import StoreManifest
from naospec import EvaluationSpec, TrainingSpec, formats
from sqlalchemy import select, text

from tests.integration.conftest import PG_PROGRAMS
from tests.integration.writes import request_evaluation

from .conftest import MIGRATIONS, ROLLOUT, Broker, Postgres, Service, opened

RELEASE = Path(__file__).parent / "release"
BEFORE = "0013"
"""The migration that the release ended with."""


@pytest.fixture
def before(postgres: Postgres, broker: Broker, tmp_path: Path) -> Iterator[Service]:
    """The release's data, not upgraded yet."""
    folder = tmp_path / "service"
    folder.mkdir()
    with opened(postgres, broker, "template0", folder) as service:
        url = service.settings.libpq_url
        create_roles(url, {})
        upgrade(service.settings.sqlalchemy_url, MIGRATIONS, BEFORE)
        with psycopg.connect(url) as connection:
            connection.execute("DELETE FROM alembic_version")
        load = [PG_PROGRAMS / "psql", "--no-psqlrc", "--quiet", "--set=ON_ERROR_STOP=1", url]
        with (RELEASE / "database.sql").open("rb") as data:
            subprocess.run(load, stdin=data, stdout=subprocess.DEVNULL, check=True)
        with lzma.open(RELEASE / "artifacts.tar.xz") as archive:
            import_artifacts(service.store, archive)
        yield service


def job_named(service: Service, name: str) -> str:
    with service.sessions() as session:
        return session.scalars(select(Job.id).where(Job.name == name)).one()


def test_jobs_of_the_release_before_run_on(before: Service) -> None:
    """One waited, one was paused, one ran, one had finished."""
    service = before
    assert migrate(service).returncode == 0
    queued, paused, running, finished = (
        job_named(service, name) for name in ("queued", "paused", "running", "finished")
    )
    saved = {job_id: service.checkpoints(job_id)[-1].step for job_id in (paused, running)}
    with service.sessions.begin() as session:
        row = session.get_one(Job, running)
        row.total_steps = saved[running] + 4096
        row.spec = {**row.spec, "total_steps": row.total_steps}
    spec = EvaluationSpec(episodes=2, n_envs=2, bootstrap_resamples=100)
    evaluation = request_evaluation(service.sessions, finished, spec=spec)
    requests.resume(service.sessions, paused)
    service.start_worker(NAOSPRINT_WORKER_CONCURRENCY="2")
    for job_id in (queued, paused, running):
        service.until_state(job_id, WorkState.SUCCEEDED)
    for job_id, step in saved.items():
        (resumed,) = [event for event in service.events(job_id) if event.kind == "resumed"][-1:]
        assert resumed.data["step"] == step
    assert "the service was upgraded" in {event.data.get("reason") for event in service.events(running)}
    assert service.job(running).failures == 0

    def evaluated() -> bool:
        with service.sessions() as session:
            return session.get_one(Evaluation, evaluation.id).state is WorkState.SUCCEEDED

    service.until(evaluated, what="for the evaluation")
    with service.sessions() as session:
        others = (Evaluation.job_id == finished, Evaluation.id != evaluation.id)
        kept = session.scalars(select(Evaluation).where(*others)).one()
    document = json.loads(service.store.get_bytes(f"{kept.key}/evaluation.json"))
    summary = formats.current(formats.Kind.RESULT, document)
    assert TrainingSpec.model_validate(summary["training"]).total_steps == 10_240
    assert StoreManifest.model_validate_json(service.store.get_bytes(f"{kept.key}/manifest.json")).files


def revision(service: Service) -> str:
    with service.sessions() as session:
        return str(session.scalar(text("SELECT version_num FROM alembic_version")))


def migrate(service: Service, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "naojobs", "migrate", "--directory", str(MIGRATIONS), *words]
    environment = {**service.environment, "NAOSPRINT_DATABASE_URL": service.settings.database_url.get_secret_value()}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)


def test_an_upgrade_that_would_lose_work_changes_nothing(before: Service) -> None:
    job_id = job_named(before, "paused")
    with before.sessions.begin() as session:
        session.execute(text("UPDATE jobs SET spec = spec || '{\"format\": 0}' WHERE id = :id"), {"id": job_id})
    refused = migrate(before)
    assert refused.returncode == 1
    assert refused.stderr.startswith("nothing was changed: this version cannot read open work")
    assert f"{job_id}: " in refused.stderr and "format 0 of this training specification is too old" in refused.stderr
    assert "Traceback" not in refused.stderr
    assert revision(before) == BEFORE
    assert migrate(before, "--force").returncode == 0
    assert revision(before) == REVISION
    with before.sessions.begin() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    newer = migrate(before)
    assert newer.returncode == 1
    assert newer.stderr.startswith("a newer version of naosprint has migrated this database (revision 9999")
    assert newer.stderr.count("\n") == 1


def test_a_worker_of_another_version_claims_no_work(service: Service) -> None:
    """It may be unable to read what waits, and work that it cannot read fails."""
    with service.sessions.begin() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    worker = service.start_worker()
    job_id = service.submit(evaluate=False, total_steps=ROLLOUT)
    service.until(lambda: "this worker claims no work" in worker.output(), what="for the worker's reason")
    assert service.job(job_id).state is WorkState.QUEUED
    assert "Traceback" not in worker.output()
    with service.sessions.begin() as session:
        session.execute(text("UPDATE alembic_version SET version_num = :own"), {"own": REVISION})
    service.until_state(job_id, WorkState.SUCCEEDED)
