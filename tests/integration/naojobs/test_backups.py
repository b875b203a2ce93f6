"""Restores into a real Postgres: what they refuse, and that they change all or nothing."""

from __future__ import annotations

import io
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import psycopg
import pytest
from naojobs import backups, submission
from naojobs.__main__ import main
from naojobs.database import downgrade, make_engine, make_sessions
from naojobs.errors import InvalidError
from naojobs.roles import Role, create_roles
from naojobs.submission import JobRequest

from tests.integration.conftest import MIGRATIONS, PG_PROGRAMS, as_role

WORK = "spec, task, task_version, robot, simulator, algorithm, state"
VALUES = "'{}', 'sprint1', 1, 't1', 'embedded', 'ppo', 'succeeded'"

USES = {
    "jobs": f"INSERT INTO jobs (id, name, owner, total_steps, {WORK}) VALUES ('j', '', 'bob', 1, {VALUES})",
    "matches": f"INSERT INTO matches (id, owner, {WORK}) VALUES ('m', 'bob', {VALUES})",
    "teams": "INSERT INTO teams (id, owner, name, key, manifest, size) VALUES ('t', 'bob', 'b', 'k', '{}', 1)",
    "studies": "INSERT INTO studies (id, name, owner, spec, job, state) VALUES ('s', '', 'bob', '{}', '{}', 'failed')",
    "policies": "INSERT INTO policies (id, owner, name) VALUES ('p', 'bob', 'walk')",
    "webhooks": "INSERT INTO webhooks (id, owner, url, events, secret) VALUES ('w', 'bob', 'https://b', '{}', '')",
    "usage": "INSERT INTO usage (owner, day, cpu_s, run_s) VALUES ('bob', '2026-01-31', 1, 1)",
    "tokens": "INSERT INTO tokens (id, name, owner, sha256, scopes) VALUES ('u', '', 'bob', 'u', '{submit}')",
}
"""Statements by what makes a service one in use."""

UNUSED = """
INSERT INTO tokens (id, name, owner, sha256, scopes) VALUES ('a', 'naoctl up', 'root', 'a', '{admin}'),
    ('m', 'reads /metrics', 'prometheus', 'm', '{metrics}');
INSERT INTO tokens (id, name, owner, sha256, scopes, revoked_at) VALUES ('r', '', 'bob', 'r', '{submit}', now());
INSERT INTO tokens (id, name, owner, sha256, scopes, expires_at) VALUES ('e', '', 'bob', 'e', '{read}', now());
INSERT INTO workers (id, host, pid, version) VALUES ('w', 'h', 1, '1');
INSERT INTO backups (finished_at) VALUES (now());
"""
"""What an unused service has: tokens of the installation and ended ones, workers, backups."""


def driver(url: str) -> str:
    return url.replace("postgresql://", "postgresql+psycopg://", 1)


def content(url: str) -> str:
    """Return everything that a database has: schema, rights and rows."""
    text = subprocess.run([PG_PROGRAMS / "pg_dump", url], check=True, capture_output=True, text=True, timeout=60).stdout
    return re.sub(r"(?m)^\\(un)?restrict .*$", "", text)


def dumped(url: str, folder: Path) -> bytes:
    """Return the data of a database as a restore reads it."""
    dump = folder / "dump"
    subprocess.run(
        [PG_PROGRAMS / "pg_dump", "--schema=public", "--format=custom", f"--file={dump}", url], check=True, timeout=60
    )
    plain = [PG_PROGRAMS / "pg_restore", "--data-only", "--schema=public", "--file=-", dump]
    return subprocess.run(plain, check=True, capture_output=True, timeout=60).stdout


def rows(url: str, statement: str) -> list[tuple[object, ...]]:
    with psycopg.connect(url) as connection:
        return connection.execute(statement).fetchall()


@pytest.fixture(scope="module")
def source(make_database: Callable[..., str]) -> str:
    """A service with a job and a webhook of alice."""
    url = make_database()
    engine = make_engine(driver(url))
    submission.submit(make_sessions(engine), JobRequest(name="kept"), owner="alice")
    engine.dispose()
    with psycopg.connect(url) as connection:
        connection.execute(USES["webhooks"].replace("bob", "alice"))
        connection.execute(USES["teams"].replace("bob", "alice"))
    return url


@pytest.fixture(scope="module")
def dump(source: str, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return dumped(source, tmp_path_factory.mktemp("dump"))


@pytest.fixture
def target(make_database: Callable[..., str]) -> str:
    """An unused service."""
    url = make_database()
    create_roles(url, {})  # as deploy/restore does: a copy of a database lacks rights on the database itself
    with psycopg.connect(url) as connection:
        connection.execute(UNUSED)
    return url


def restore(url: str, dump: bytes) -> dict[str, int]:
    return backups.restore(driver(as_role(url, Role.OWNER)), MIGRATIONS, io.BytesIO(dump))


def test_an_unused_service_gets_what_the_dump_has(source: str, target: str, dump: bytes) -> None:
    generation = "SELECT key FROM generations"
    before = rows(target, generation)
    backups.check_restore(driver(as_role(target, Role.OWNER)), MIGRATIONS, io.BytesIO(dump))
    counts = restore(target, dump)
    assert (counts["jobs"], counts["webhooks"], counts["teams"]) == (1, 1, 1)
    for table in ("alembic_version", "jobs", "events", "webhooks", "teams", "tokens", "workers"):
        assert rows(target, f"SELECT * FROM {table}") == rows(source, f"SELECT * FROM {table}"), table
    assert rows(target, generation) != before
    assert rows(as_role(target, Role.API), "SELECT name FROM jobs") == [("kept",)]


def test_the_key_of_the_service_is_that_of_the_dump(source: str, target: str, dump: bytes) -> None:
    key = "SELECT * FROM services"
    assert rows(target, key) == rows(source, key)  # copies of one database
    with psycopg.connect(target) as connection:
        connection.execute("UPDATE services SET key = 'another'")
    restore(target, dump)
    assert rows(target, key) == rows(source, key)


def test_a_dump_from_before_the_key_gets_one(
    source: str, target: str, make_database: Callable[..., str], tmp_path: Path
) -> None:
    old = make_database()
    engine = make_engine(driver(old))
    submission.submit(make_sessions(engine), JobRequest(name="old"), owner="alice")
    engine.dispose()
    downgrade(driver(old), MIGRATIONS, "0028")
    restore(target, dumped(old, tmp_path))
    assert rows(target, "SELECT name FROM jobs") == [("old",)]
    assert len({*rows(target, "SELECT key FROM services"), *rows(source, "SELECT key FROM services")}) == 2


@pytest.mark.parametrize("kind", USES)
def test_a_service_in_use_is_left_as_it_is(target: str, dump: bytes, kind: str) -> None:
    with psycopg.connect(target) as connection:
        connection.execute(USES[kind])
    before = content(target)
    for attempt in (backups.check_restore, backups.restore):
        with pytest.raises(InvalidError, match=f"in use already: it has rows in {kind}; "):
            attempt(driver(as_role(target, Role.OWNER)), MIGRATIONS, io.BytesIO(dump))
        assert content(target) == before


def another_revision(dump: bytes) -> bytes:
    return re.sub(rb"(COPY public.alembic_version .*\n)\d+\n", rb"\g<1>9999\n", dump)


def without_revision(dump: bytes) -> bytes:
    return re.sub(rb"(COPY public.alembic_version .*\n)\d+\n", rb"\g<1>", dump)


def cut_in_a_table(dump: bytes) -> bytes:
    return dump[: dump.index(b"COPY public.jobs ") + 900]


def cut_between_tables(dump: bytes) -> bytes:
    return dump[: dump.index(b"COPY public.teams ")]


def with_more(dump: bytes) -> bytes:
    return dump + b"SELECT 1;\n"


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (another_revision, "revision '9999', which this version does not know"),
        (without_revision, "revision none, which"),
        (cut_in_a_table, "cut off in table jobs"),
        (cut_between_tables, "the dump is cut off$"),
        (with_more, "more than the data of schema public"),
    ],
)
def test_a_dump_that_cannot_be_used_leaves_everything_as_it_is(
    target: str, dump: bytes, damage: Callable[[bytes], bytes], reason: str
) -> None:
    before = content(target)
    damaged = damage(dump)
    assert damaged != dump
    for attempt in (backups.check_restore, backups.restore):
        with pytest.raises(InvalidError, match=reason):
            attempt(driver(as_role(target, Role.OWNER)), MIGRATIONS, io.BytesIO(damaged))
        assert content(target) == before


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"\tqueued\t", b"\tunheard-of\t", "of table jobs .*ck_jobs_state_known"),
        (b"alice\tb\tk\t{}\t1\t", b"alice\tb\tk\t{}\tone\t", "of table teams .*invalid input syntax"),
        (b"COPY public.teams (", b"COPY public.teams (more, ", "makes table teams with more"),
        (b"COPY public.teams (", b"COPY public.unknown (", "makes table unknown with"),
        (b"public.events_id_seq", b"public.unknown_id_seq", "unknown_id_seq"),
    ],
)
def test_rows_that_the_database_refuses_leave_everything_as_it_is(
    target: str, dump: bytes, old: bytes, new: bytes, reason: str
) -> None:
    """Only the database finds these, after its tables were made again."""
    before = content(target)
    assert old in dump
    with pytest.raises(InvalidError, match=reason):
        restore(target, dump.replace(old, new))
    assert content(target) == before
    restore(target, dump)


def test_a_reference_to_a_missing_row_leaves_everything_as_it_is(target: str, dump: bytes) -> None:
    before = content(target)
    start = dump.index(b"COPY public.jobs ")
    begin = dump.index(b"\n", start) + 1
    without = dump[:begin] + dump[dump.index(b"\\.\n", begin) :]
    with pytest.raises(InvalidError, match=r"of table events .*violates foreign key"):
        restore(target, without)
    assert content(target) == before


def test_a_database_of_a_newer_version_is_left_as_it_is(target: str, dump: bytes) -> None:
    with psycopg.connect(target) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
    before = content(target)
    with pytest.raises(InvalidError, match=r"a newer version has migrated this database \(revision 9999\)"):
        restore(target, dump)
    assert content(target) == before


def test_a_check_from_a_shell(
    target: str, dump: bytes, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("NAOSPRINT_MODE", "local")
    monkeypatch.setenv("NAOSPRINT_DATABASE_URL", as_role(target, Role.OWNER))
    before = content(target)
    for source, code, words in ((dump, 0, ""), (dump[:-200], 1, "the dump is cut off\n")):
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(source), encoding="utf-8"))
        assert main(["restore", "--check", "--directory", str(MIGRATIONS)]) == code
        assert capsys.readouterr() == ("", words)
    assert content(target) == before
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(dump), encoding="utf-8"))
    assert main(["restore", "--directory", str(MIGRATIONS)]) == 0
    assert '"jobs": 1' in capsys.readouterr().out
    assert rows(target, "SELECT name FROM jobs") == [("kept",)]
