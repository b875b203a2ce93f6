"""The roles of the database: each can do its work, and is refused the rest."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import psycopg
import pytest
from naojobs.database import upgrade
from naojobs.models import Base
from naojobs.roles import RIGHTS, Role, create_roles

from tests.integration.conftest import MIGRATIONS, PG_PROGRAMS, as_role


def answer(url: str, statement: str, role: Role) -> object:
    """Return the first value of a statement's result, without a lasting change."""
    with psycopg.connect(as_role(url, role)) as connection:
        cursor = connection.execute(statement)
        row = cursor.fetchone() if cursor.description else None
        connection.rollback()
    return row[0] if row else None


@pytest.fixture(scope="module", autouse=True)
def _sampler_tables(database_url: str) -> None:
    """A table of the studies' sampler, which workers make."""
    with psycopg.connect(as_role(database_url, Role.WORKER)) as connection:
        connection.execute("CREATE TABLE optuna.some (id integer)")


@pytest.mark.parametrize("role", list(Role))
@pytest.mark.parametrize(
    "statement",
    [
        "COPY tokens FROM PROGRAM 'true'",
        "COPY (SELECT 1) TO PROGRAM 'true'",
        "COPY (SELECT 1) TO '/tmp/naosprint-role'",
        "SELECT pg_read_file('/etc/passwd')",
        "SELECT pg_ls_dir('/')",
        "SELECT rolpassword FROM pg_authid",
        "CREATE ROLE another SUPERUSER",
        "ALTER ROLE CURRENT_USER SUPERUSER",
        "SET ROLE postgres",
        "SELECT pg_reload_conf()",
        "ALTER DATABASE postgres CONNECTION LIMIT 1",
        "CREATE EXTENSION plpython3u",
        "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE usename = 'postgres'",
    ],
)
def test_no_role_has_a_right_of_a_superuser(database_url: str, statement: str, role: Role) -> None:
    with pytest.raises((psycopg.errors.InsufficientPrivilege, psycopg.errors.FeatureNotSupported)):
        answer(database_url, statement, role)


@pytest.mark.parametrize("role", [Role.API, Role.WORKER, Role.METRICS, Role.BACKUP])
@pytest.mark.parametrize(
    "statement",
    [
        "CREATE TABLE public.mine (id integer)",
        "DROP TABLE public.jobs CASCADE",
        "ALTER TABLE public.jobs ADD more integer",
    ],
)
def test_only_the_owner_changes_the_schema(database_url: str, statement: str, role: Role) -> None:
    with pytest.raises(psycopg.errors.InsufficientPrivilege):
        answer(database_url, statement, role)
    answer(database_url, statement, Role.OWNER)


@pytest.mark.parametrize(
    ("role", "statement"),
    [
        (Role.WORKER, "SELECT sha256 FROM tokens"),
        (Role.WORKER, "INSERT INTO tokens (id, name, owner, sha256, scopes) VALUES ('t', '', 'me', '', '{admin}')"),
        (Role.WORKER, "SELECT secret FROM webhooks"),
        (Role.WORKER, "UPDATE webhooks SET url = ''"),
        (Role.WORKER, "DELETE FROM jobs"),
        (Role.WORKER, "DELETE FROM events"),
        (Role.WORKER, "UPDATE alembic_version SET version_num = ''"),
        (Role.WORKER, "DELETE FROM tokens"),
        (Role.API, "DELETE FROM logs"),
        (Role.API, "UPDATE alembic_version SET version_num = ''"),
        (Role.API, "SELECT * FROM optuna.some"),
        (Role.METRICS, "SELECT * FROM public.jobs"),
        (Role.METRICS, "SELECT sha256 FROM public.tokens"),
        (Role.BACKUP, "SELECT * FROM optuna.some"),
        (Role.BACKUP, "DELETE FROM jobs"),
        (Role.BACKUP, "INSERT INTO backups DEFAULT VALUES"),
    ],
)
def test_a_role_is_refused_what_others_do(database_url: str, role: Role, statement: str) -> None:
    with pytest.raises(psycopg.errors.InsufficientPrivilege):
        answer(database_url, statement, role)


def test_statistics_and_backups_work(database_url: str, tmp_path: Path) -> None:
    assert answer(database_url, "SELECT count(*) FROM pg_stat_activity WHERE query <> ''", Role.METRICS)
    assert answer(database_url, "SELECT pg_database_size(current_database())", Role.METRICS)
    dump = tmp_path / "dump"
    url = as_role(database_url, Role.BACKUP)
    command = [PG_PROGRAMS / "pg_dump", "--schema=public", "--format=custom", f"--file={dump}", url]
    subprocess.run(command, check=True, timeout=60)
    found = subprocess.run(
        [PG_PROGRAMS / "pg_restore", "--list", dump], check=True, capture_output=True, text=True, timeout=60
    )
    assert "TABLE DATA public tokens" in found.stdout and "optuna" not in found.stdout


def test_every_table_has_rights() -> None:
    assert RIGHTS.keys() == {*Base.metadata.tables, "alembic_version"}


def test_roles_take_over_a_database_of_an_older_version(make_database: Callable[..., str]) -> None:
    """Everything belonged to a superuser, the sampler's tables and types included."""
    url = make_database(migrated=False)
    upgrade(url, MIGRATIONS)
    with psycopg.connect(url) as connection:
        connection.execute("CREATE TYPE optuna.kind AS ENUM ('a')")
        connection.execute("CREATE TABLE optuna.old (id serial PRIMARY KEY, kind optuna.kind)")
    for _ in range(2):
        create_roles(url, {})
        upgrade(as_role(url, Role.OWNER), MIGRATIONS)
    with psycopg.connect(as_role(url, Role.WORKER)) as connection:
        connection.execute("INSERT INTO optuna.old (kind) VALUES ('a')")
        connection.execute("ALTER TYPE optuna.kind ADD VALUE 'b'")
    answer(url, "ALTER TABLE jobs ADD more integer", Role.OWNER)
    owners = "SELECT array_agg(DISTINCT tableowner::text) FROM pg_tables WHERE schemaname = 'public'"
    assert answer(url, owners, Role.OWNER) == [Role.OWNER]


def test_roles_call_nothing_that_the_owner_has_defined(make_database: Callable[..., str]) -> None:
    """An operator of `public` whose arguments fit better than those of Postgres's own would run as a superuser."""
    url = make_database()
    with psycopg.connect(as_role(url, Role.OWNER)) as connection:
        connection.execute(
            "CREATE TABLE public.called (who text);"
            "CREATE FUNCTION public.differs(oid, regrole) RETURNS boolean LANGUAGE plpgsql AS "
            "'BEGIN INSERT INTO public.called VALUES (current_user); RETURN true; END';"
            "CREATE OPERATOR public.<> (LEFTARG = oid, RIGHTARG = regrole, FUNCTION = public.differs)"
        )
    create_roles(url, {})
    assert answer(url, "SELECT count(*) FROM public.called", Role.OWNER) == 0


def test_the_command_sets_passwords_that_the_server_never_reads(database_url: str, tmp_path: Path) -> None:
    """It reads them from files, and what the server receives only verifies them."""
    names = ("OWNER", "API", "WORKER", "METRICS")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NAOSPRINT_")}
    for name in names:
        (tmp_path / name).write_text(f"of-{name}\n")
        environment[f"NAOSPRINT_{name}_PASSWORD_FILE"] = str(tmp_path / name)
    environment |= {"NAOSPRINT_DATABASE_URL": database_url, "NAOSPRINT_MODE": "local"}
    command = [sys.executable, "-m", "naojobs", "roles"]
    subprocess.run(command, env=environment, check=True, timeout=60)
    with psycopg.connect(database_url) as connection:
        kept = dict(connection.execute("SELECT rolname, rolpassword FROM pg_authid WHERE rolname LIKE 'naosprint_%'"))
        assert kept.pop(Role.BACKUP) is None
        assert len(kept) == len(names)
        assert all(value.startswith("SCRAM-SHA-256$") for value in kept.values())
    done = subprocess.run(
        command,
        env={**environment, "NAOSPRINT_API_PASSWORD_FILE": str(tmp_path / "none")},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("NAOSPRINT_API_PASSWORD_FILE: cannot read")
