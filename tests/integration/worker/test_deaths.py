"""Jobs survive the death of training processes and workers."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
from base64 import b64decode
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import naosprint_worker
import psutil
import pytest
from naojobs import registry, requests
from naojobs.models import Evaluation, Job, Log
from naojobs.states import WorkState
from naospec import EvaluationSpec
from naospec.processes import ProcessIdentity
from naosprint_worker.orphans import FOLDER_VARIABLE, OWNER_VARIABLE
from sqlalchemy import select, text, update
from sqlalchemy.exc import IntegrityError

from tests.integration.writes import request_evaluation

from .conftest import ROLLOUT, Service, WorkerProcess

INTERVAL = ROLLOUT * 10


def start_job(service: Service, **fields: object) -> str:
    """Submit a job and wait until it has a checkpoint and steps beyond it."""
    job_id = service.submit(
        **{"evaluate": False, "total_steps": 10**9, "checkpoint_interval_steps": INTERVAL, **fields}
    )
    service.until_checkpoints(job_id, 2)
    return job_id


def assert_resumed_and_whole(service: Service, job_id: str, steps: int) -> None:
    """Check that the job resumed from a checkpoint beyond its start, without gaps or duplicates in its metrics."""
    resumed = [event for event in service.events(job_id) if event.kind == "resumed"]
    assert resumed
    assert all(event.data["step"] >= INTERVAL for event in resumed)
    assert_whole(service, job_id, steps)


def assert_whole(service: Service, job_id: str, steps: int) -> None:
    """Check that the metrics of a job have no gaps or duplicates."""
    rows = service.metrics(job_id)
    assert [row.step for row in rows] == list(range(ROLLOUT, steps + 1, ROLLOUT))
    assert [row.attempt for row in rows] == sorted(row.attempt for row in rows)
    assert service.job(job_id).error is None


@contextlib.contextmanager
def sleeping(environment: Mapping[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    """Run a process that only waits."""
    with subprocess.Popen(["sleep", "600"], env={**os.environ, **environment}) as process:
        try:
            yield process
        finally:
            process.kill()


def step_clock(worker: WorkerProcess, folder: Path, seconds: int) -> None:
    """Set the clock for a worker in a mount namespace: the boot time that the kernel gives moves with it."""
    text = Path("/proc/stat").read_text(encoding="ascii")
    (line,) = (line for line in text.splitlines() if line.startswith("btime"))
    fake = folder / "stat"
    fake.write_text(text.replace(line, f"btime {int(line.split()[1]) + seconds}"), encoding="ascii")
    account = ["--user", "--preserve-credentials"] if os.geteuid() else []
    inside = ["nsenter", "--target", str(worker.pid), "--mount", *account]
    subprocess.run([*inside, "mount", "--bind", str(fake), "/proc/stat"], check=True)


def wait_gone(process: psutil.Process) -> None:
    """Wait until a process has ended."""
    psutil.wait_procs([process], timeout=30)
    assert not process.is_running() or process.status() == psutil.STATUS_ZOMBIE


def test_killed_trainer(service: Service, worker: WorkerProcess) -> None:
    """The first loss is retried; the second without a new checkpoint fails the job, which a user can then retry."""
    job_id = start_job(service, max_attempts=2)
    with service.sessions.begin() as session:  # of the next attempt: no checkpoint before its end
        job = session.get_one(Job, job_id, with_for_update=True)
        job.spec = {**job.spec, "runtime": {**job.spec["runtime"], "checkpoint_interval_steps": 10**9}}
    service.until_training(worker).kill()
    service.until(lambda: "resumed" in service.kinds(job_id), what="for the second attempt")
    assert any("signal 9 (SIGKILL)" in event.message for event in service.events(job_id))
    steps = service.shorten(job_id)
    service.until_training(worker).kill()
    job = service.until_state(job_id, WorkState.FAILED)
    assert "signal 9 (SIGKILL)" in (job.error or "")
    assert "attempt 2 of 2" in (job.error or "")

    requests.retry(service.sessions, Job, job_id)
    service.wake_up(job_id)
    job = service.until_state(job_id, WorkState.SUCCEEDED)
    assert job.attempt == 3
    assert_resumed_and_whole(service, job_id, steps)


def test_killed_worker(service: Service, worker: WorkerProcess) -> None:
    job_id = start_job(service)
    training = service.until_training(worker)
    worker.process.kill()
    worker.process.wait()
    wait_gone(training)
    left = list((service.folder / "work").iterdir())
    job = service.job(job_id)
    # The orphan has saved a checkpoint and requeued the job before it ended.
    assert (job.state, job.failures) == (WorkState.QUEUED, 1)
    saved = service.checkpoints(job_id)[-1].step
    assert saved == service.metrics(job_id)[-1].step

    steps = service.shorten(job_id)
    service.start_worker()
    service.until_state(job_id, WorkState.SUCCEEDED)
    assert_resumed_and_whole(service, job_id, steps)
    assert next(event for event in service.events(job_id) if event.kind == "resumed").data["step"] == saved
    assert len(left) == 1
    assert not left[0].exists()


def test_a_worker_that_starts_leaves_the_files_of_a_dead_ones_training_until_it_has_ended(service: Service) -> None:
    """The training needs them for its last checkpoint; afterwards nothing of them stays."""
    lease = {"NAOSPRINT_LEASE_S": "60"}
    worker = service.start_worker(**lease)
    job_id = start_job(service)
    training = service.until_training(worker)
    training.suspend()
    saved = service.checkpoints(job_id)[-1].step
    worker.process.kill()
    worker.process.wait()
    (left,) = service.folder.glob("work/*/owner")
    other = service.start_worker(**lease)
    with service.sessions() as session:
        service.until(lambda: session.scalar(text("SELECT count(*) FROM workers")) == 2, what="for the other worker")
    steps = service.shorten(job_id)
    training.resume()
    wait_gone(training)
    service.until(lambda: not left.parent.exists(), what="for the files to be removed")
    service.until_state(job_id, WorkState.SUCCEEDED)
    assert any(f"{worker.pid}:" in event.message and "died" in event.message for event in service.events(job_id))
    (resumed,) = [event.data["step"] for event in service.events(job_id) if event.kind == "resumed"]
    assert resumed > saved
    assert_resumed_and_whole(service, job_id, steps)
    assert other.process.poll() is None


def test_a_worker_that_cannot_start_a_training_uses_up_no_attempt(service: Service, worker: WorkerProcess) -> None:
    """It would take the job again at once, until it has failed."""
    (mark,) = service.until(lambda: [*service.folder.glob("work/*/owner")], what="for the worker's folder")
    service.until(lambda: "is ready for" in worker.output(), what="for the worker")
    mark.unlink()
    mark.parent.rmdir()
    mark.parent.write_text("in the way: no attempt can have a folder below this name")
    job_id = service.submit(max_attempts=1)
    service.until(lambda: service.job(job_id).postponed > 0, what="for the first attempt to end")
    job = service.job(job_id)
    assert (job.state, job.failures) == (WorkState.QUEUED, 0)
    assert "the trainer could not be started: NotADirectoryError" in str(job.error)


def test_worker_and_trainer_killed_together(service: Service, worker: WorkerProcess) -> None:
    job_id = start_job(service)
    other = service.start_worker(NAOSPRINT_WORKER_CLAIM_S="600")  # it hears of the requeued job by a message only
    training = service.until_training(worker)
    steps = service.shorten(job_id)
    os.killpg(worker.pid, signal.SIGKILL)
    os.killpg(training.pid, signal.SIGKILL)
    worker.process.wait()
    wait_gone(training)
    service.until_state(job_id, WorkState.SUCCEEDED)
    assert_resumed_and_whole(service, job_id, steps)
    assert any("expired" in event.message for event in service.events(job_id))
    assert other.process.poll() is None


@pytest.mark.parametrize("on_its_host", [True, False])
def test_worker_killed_between_the_evaluation_and_the_end(
    service: Service, worker: WorkerProcess, on_its_host: bool
) -> None:
    """It is frozen, so that training completes but the job is not settled; then it is killed.

    The next worker finds on the same host that all is done, and elsewhere does what is left in another attempt.
    """
    steps = ROLLOUT * 20
    job_id = service.submit(total_steps=steps)
    training = service.until_training(worker)
    worker.process.send_signal(signal.SIGSTOP)

    def evaluations() -> list[Evaluation]:
        with service.sessions() as session:
            return list(session.scalars(select(Evaluation).where(Evaluation.job_id == job_id)))

    (first,) = service.until(evaluations, what="for the evaluation")
    # Its frozen parent cannot reap it.
    service.until(lambda: training.status() == psutil.STATUS_ZOMBIE, what="for the trainer to end")
    assert service.job(job_id).state is WorkState.EVALUATING
    worker.process.kill()
    worker.process.wait()
    if not on_its_host:
        shutil.rmtree(service.settings.worker_dir)
    service.start_worker()
    assert service.until_state(job_id, WorkState.SUCCEEDED).attempt == (1 if on_its_host else 2)
    (only,) = evaluations()
    assert (only.id, only.key, only.finished_at) == (first.id, first.key, first.finished_at)
    assert service.kinds(job_id).count("evaluation") == 1
    if on_its_host:
        assert "resumed" not in service.kinds(job_id)
        assert_whole(service, job_id, steps)
    else:
        assert_resumed_and_whole(service, job_id, steps)


def test_a_step_of_the_clock_ends_no_training(service: Service) -> None:
    """The worker neither takes its own training for one of a dead worker, nor that of another service."""
    unshare = ["unshare", "--mount", *(["--map-root-user"] if os.geteuid() else [])]
    if subprocess.run([*unshare, "true"], check=False, capture_output=True).returncode:
        pytest.skip("the clock can be set for one process only where it may have namespaces")
    worker = service.start_worker(*unshare, NAOSPRINT_WORKER_ORPHAN_GRACE_S="0")
    gone = replace(ProcessIdentity.current(), ticks=1)  # seen from the worker
    marks = {OWNER_VARIABLE: str(gone), FOLDER_VARIABLE: str(service.settings.worker_dir.resolve())}
    with sleeping(marks) as orphan, sleeping({**marks, FOLDER_VARIABLE: "/another"}) as stranger:
        job_id = start_job(service)
        service.until(lambda: orphan.poll() is not None, what="for the end of the orphan")
        step_clock(worker, service.folder, 2)
        with sleeping(marks) as later:
            # The worker ends it once it has seen it for longer than its own training needed to be taken for an orphan.
            service.until(lambda: later.poll() is not None, what="for the end of a later orphan")
        assert stranger.poll() is None
    steps = service.shorten(job_id)
    assert service.job(job_id).attempt == 1, service.report()
    requests.request_pause(service.sessions, job_id)
    service.until_state(job_id, WorkState.PAUSED)
    requests.resume(service.sessions, job_id)
    service.until_state(job_id, WorkState.SUCCEEDED)
    assert_resumed_and_whole(service, job_id, steps)
    assert worker.terminate() == 0
    assert "whose worker is gone" in worker.output()


def test_worker_told_to_end(service: Service, worker: WorkerProcess) -> None:
    job_id = start_job(service)
    assert [entry.row.pid for entry in registry.workers(service.sessions) if entry.alive] == [worker.pid]
    assert service.health() == (0, "")
    assert worker.terminate() == 0
    status, reason = service.health()
    assert (status, "no heartbeat of a worker on" in reason) == (1, True), reason
    assert registry.workers(service.sessions) == []
    assert list((service.folder / "work").iterdir()) == []
    job = service.job(job_id)
    assert (job.state, job.failures) == (WorkState.QUEUED, 0)
    with service.celery.connection_for_read() as broker:
        (message,) = broker.default_channel.client.lrange("embedded", 0, -1)
    assert job_id in b64decode(json.loads(message)["body"]).decode()
    saved = service.checkpoints(job_id)[-1].step
    assert saved == service.metrics(job_id)[-1].step
    steps = service.shorten(job_id)
    service.start_worker()
    service.until_state(job_id, WorkState.SUCCEEDED)
    assert_resumed_and_whole(service, job_id, steps)
    assert next(event for event in service.events(job_id) if event.kind == "resumed").data["step"] == saved


def test_frozen_trainer_is_replaced(service: Service) -> None:
    """Its worker lives and renews the lease: only the missing steps show that it hangs."""
    worker = service.start_worker(NAOSPRINT_WORKER_STALL_S="30", NAOSPRINT_WORKER_STALL_WARN_S="5")
    job_id = start_job(service)
    training = service.until_training(worker)
    training.suspend()
    steps = service.shorten(job_id)
    service.until(lambda: service.job(job_id).stalled_since, what="for the job to be shown as stalled")
    service.until(lambda: "resumed" in service.kinds(job_id), what="for the second attempt")
    assert any("made no step for 30 s and was killed" in event.message for event in service.events(job_id))
    service.until_state(job_id, WorkState.SUCCEEDED)
    assert service.job(job_id).stalled_since is None
    wait_gone(training)
    assert_resumed_and_whole(service, job_id, steps)


def test_frozen_worker_whose_job_went_elsewhere_writes_nothing_more(service: Service, worker: WorkerProcess) -> None:
    """It is suspended for longer than its lease, as by a suspended machine or a clock that jumps."""
    job_id = start_job(service)
    training = service.until_training(worker)
    other = service.start_worker()
    training.suspend()
    worker.process.send_signal(signal.SIGSTOP)
    steps = service.shorten(job_id)
    service.until(lambda: service.job(job_id).attempt == 2, what="for another worker to take the job")
    worker.process.send_signal(signal.SIGCONT)
    training.resume()
    service.until_state(job_id, WorkState.SUCCEEDED)
    wait_gone(training)
    assert_resumed_and_whole(service, job_id, steps)
    assert service.job(job_id).attempt == 2
    assert worker.process.poll() is None
    assert other.process.poll() is None


ENDS_THE_PROCESS = """
import os, sys

def hook(event, arguments):
    if event == "open" and str(arguments[0]).endswith(os.environ["END_AT"]) and "naosprint" in sys.modules:
        {end}

sys.addaudithook(hook)
"""
"""A library that ends the process when it writes or reads a certain file, as anything in a process can."""


@pytest.mark.parametrize(
    ("end", "words"),
    [
        ("os._exit(0)", "exit code 0 before it had reported its end"),
        ("os._exit(76)", "exit code 76"),
    ],
)
def test_no_exit_status_of_others_counts_as_success(service: Service, tmp_path: Path, end: str, words: str) -> None:
    (tmp_path / "sitecustomize.py").write_text(ENDS_THE_PROCESS.format(end=end), encoding="utf-8")
    service.start_worker(PYTHONPATH=str(tmp_path), END_AT="learner.npz")
    job_id = service.submit(evaluate=False, max_attempts=1)
    job = service.until_state(job_id, WorkState.FAILED)
    assert words in str(job.error)
    assert not service.checkpoints(job_id)


def test_an_error_with_text_of_any_kind_is_recorded_once_and_shows_no_internals(
    service: Service, tmp_path: Path
) -> None:
    """A permanent error, whose message has a file name that is not UTF-8, an address and a statement."""
    text = "no \\0 and no \\udc80: {arguments[0]} of https://store.example/b?key=1 [SQL: SELECT secret]"
    hook = ENDS_THE_PROCESS.format(end=f'raise ValueError(f"{text}")')
    (tmp_path / "sitecustomize.py").write_text(hook, encoding="utf-8")
    worker = service.start_worker(PYTHONPATH=str(tmp_path), END_AT="learner.npz")
    job_id = service.submit(evaluate=False)
    job = service.until_state(job_id, WorkState.FAILED)
    assert (
        job.error
        == "ValueError: no \N{REPLACEMENT CHARACTER} and no \N{REPLACEMENT CHARACTER}: …/learner.npz of (address)"
    )
    assert job.attempt == 1
    with service.sessions() as session:
        line = session.scalars(select(Log.message).where(Log.job_id == job_id, Log.level == "error")).one()
    internals = ("SELECT", "store.example", sys.prefix, str(tmp_path), str(Path(naosprint_worker.__file__).parents[1]))
    assert [word for word in internals if word in line] == []
    assert 'File "naosprint_worker/child_process.py", line ' in line
    assert "[SQL: SELECT secret]" in worker.output() and naosprint_worker.__file__[:-11] in worker.output()


def test_a_database_that_fails_while_an_attempt_is_settled_costs_no_second_line_of_the_log(
    service: Service, tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(ENDS_THE_PROCESS.format(end="raise ValueError(7)"), encoding="utf-8")
    with service.sessions.begin() as session:
        fail = "BEGIN IF nextval(''tries'') <= 2 THEN RAISE serialization_failure; END IF; RETURN NEW; END"
        session.execute(text("CREATE SEQUENCE tries"))
        session.execute(text(f"CREATE FUNCTION fail() RETURNS trigger SECURITY DEFINER LANGUAGE plpgsql AS '{fail}'"))
        when = "BEFORE UPDATE ON jobs FOR EACH ROW WHEN (NEW.state = 'failed') EXECUTE FUNCTION fail()"
        session.execute(text(f"CREATE TRIGGER fail {when}"))
    service.start_worker(PYTHONPATH=str(tmp_path), END_AT="learner.npz")
    job_id = service.submit(evaluate=False)
    service.until_state(job_id, WorkState.FAILED)
    with service.sessions() as session:
        assert session.scalar(text("SELECT last_value FROM tries")) == 3
        lines = session.scalars(select(Log.message).where(Log.job_id == job_id, Log.level == "error")).all()
    assert len([line for line in lines if "ValueError: 7" in line]) == 1


def test_an_evaluator_that_is_ended_has_not_evaluated(service: Service, tmp_path: Path) -> None:
    trained = service.start_worker()
    job_id = service.submit(evaluate=False, total_steps=ROLLOUT)
    service.until_state(job_id, WorkState.SUCCEEDED)
    trained.terminate()
    (tmp_path / "sitecustomize.py").write_text(ENDS_THE_PROCESS.format(end="os._exit(0)"), encoding="utf-8")
    service.start_worker(PYTHONPATH=str(tmp_path), END_AT="evaluation.json")
    evaluation = request_evaluation(service.sessions, job_id, spec=EvaluationSpec(episodes=2, n_envs=2))
    with service.sessions.begin() as session:
        session.get_one(Evaluation, evaluation.id).max_attempts = 1
    service.wake_up(evaluation.id)

    def failed() -> str | None:
        with service.sessions() as session:
            row = session.get_one(Evaluation, evaluation.id)
            assert row.state is not WorkState.SUCCEEDED
            return row.error if row.state is WorkState.FAILED else None

    assert "before it had reported its end" in str(service.until(failed, what="for the evaluation to fail"))
    with pytest.raises(IntegrityError, match="succeeded_has_result"), service.sessions.begin() as session:
        session.execute(
            update(Evaluation).where(Evaluation.id == evaluation.id).values(state=WorkState.SUCCEEDED, error=None)
        )
