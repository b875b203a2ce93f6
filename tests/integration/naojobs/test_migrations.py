"""The migrations: upgrades give the models' schema, downgrades leave nothing."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from naojobs.__main__ import main
from naojobs.database import REVISION, alembic_config, downgrade, upgrade
from naojobs.models import Base
from sqlalchemy import Engine, create_engine, inspect, text

from tests.ports import reserved_port

MIGRATIONS = Path(__file__).parents[3] / "migrations"


@pytest.fixture
def empty(make_database: Callable[..., str]) -> Iterator[Engine]:
    """An engine for an empty database."""
    url = make_database(migrated=False)
    engine = create_engine("postgresql+psycopg://" + url.split("://", 1)[1])
    yield engine
    engine.dispose()


def url_of(engine: Engine) -> str:
    return engine.url.render_as_string(hide_password=False)


def differs(difference: Any) -> bool:
    """Return whether a difference is one: Alembic compares defaults by their values, which random ones never share."""
    if not isinstance(difference, list) or difference[0][0] != "modify_default":
        return True
    texts = [re.sub(r"::text|[\s()]", "", str(default.arg)) for default in difference[0][-2:] if default is not None]
    return len(set(texts)) != 1 or "gen_random_uuid" not in texts[0]


def test_up_gives_what_the_models_say_and_down_leaves_nothing(empty: Engine) -> None:
    upgrade(url_of(empty), MIGRATIONS)
    with empty.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_server_default": True})
        assert [found for found in compare_metadata(context, Base.metadata) if differs(found)] == []
    downgrade(url_of(empty), MIGRATIONS, "base")
    assert inspect(empty).get_table_names() == ["alembic_version"]
    assert inspect(empty).get_sequence_names() == []
    upgrade(url_of(empty), MIGRATIONS)
    assert set(inspect(empty).get_table_names()) == {"alembic_version", *Base.metadata.tables}


def test_rows_of_the_first_revision_are_kept(empty: Engine) -> None:
    """The upgrade adds the requirements of jobs and evaluations; after a downgrade, no new state remains."""
    upgrade(url_of(empty), MIGRATIONS, "0001")
    spec = '{"task": "sprint2", "robot_type": 3, "simulator": "rcssserver3d"}'
    with empty.begin() as connection:
        connection.execute(
            text(
                "INSERT INTO jobs (id, name, owner, spec, queue, state, total_steps) "
                "VALUES ('job_1', 'a', 'alice', cast(:spec AS jsonb), 'rcssserver3d', 'succeeded', 1)"
            ),
            {"spec": spec},
        )
        connection.execute(
            text(
                "INSERT INTO checkpoints (id, job_id, attempt, step, key, manifest) "
                "VALUES ('c', 'job_1', 1, 1, 'k', '{}')"
            )
        )
        connection.execute(
            text(
                "INSERT INTO evaluations (id, job_id, checkpoint_id, state, spec, queue) "
                "VALUES ('eval_1', 'job_1', 'c', 'queued', '{\"task\": \"sprint1\"}', 'embedded')"
            )
        )
    upgrade(url_of(empty), MIGRATIONS)
    needs = "task, task_version, robot, simulator"
    with empty.begin() as connection:
        assert connection.execute(text(f"SELECT {needs} FROM jobs")).one() == ("sprint2", 1, "nao-3", "rcssserver3d")
        assert connection.execute(text(f"SELECT {needs} FROM evaluations")).one() == ("sprint1", 1, "nao-3", "embedded")
        assert connection.execute(text("SELECT queued_at = created_at FROM evaluations")).scalar_one()
        connection.execute(text("UPDATE evaluations SET state = 'cancelled'"))
    downgrade(url_of(empty), MIGRATIONS, "0001")
    with empty.begin() as connection:
        assert connection.execute(text("SELECT state FROM evaluations")).scalar_one() == "failed"


def test_what_0022_dropped_is_filled_in_by_a_downgrade(empty: Engine) -> None:
    upgrade(url_of(empty), MIGRATIONS)
    needs = "task, task_version, robot, simulator, algorithm"
    with empty.begin() as connection:
        for job, state, owner in (("a", "pausing", "'w'"), ("b", "queued", "NULL")):
            connection.execute(
                text(
                    f"INSERT INTO jobs (id, name, owner, spec, state, lease_owner, total_steps, {needs}) "
                    f"VALUES ('{job}', '', '', '{{}}', '{state}', {owner}, 1, 'sprint1', 1, 't1', 'server', 'ppo')"
                )
            )
        connection.execute(
            text(
                "INSERT INTO workers (id, host, pid, simulators, version) "
                """VALUES ('w', 'h', 1, '["embedded", "server"]', '1')"""
            )
        )
    downgrade(url_of(empty), MIGRATIONS, "0021")
    with empty.begin() as connection:
        rows = connection.execute(text("SELECT id, queue, pause_requested FROM jobs ORDER BY id")).all()
        assert rows == [("a", "server", True), ("b", "server", False)]
        assert connection.execute(text("SELECT queues FROM workers")).scalar_one() == ["embedded", "server"]
    upgrade(url_of(empty), MIGRATIONS)
    with empty.begin() as connection:
        assert connection.execute(text("SELECT simulator FROM jobs WHERE id = 'b'")).scalar_one() == "server"


def test_0030_keeps_the_checkpoint_that_a_study_starts_from(empty: Engine) -> None:
    upgrade(url_of(empty), MIGRATIONS, "0029")
    needs = "task, task_version, robot, simulator, algorithm"
    with empty.begin() as connection:
        for statement in (
            f"INSERT INTO jobs (id, name, owner, spec, state, total_steps, {needs}) "
            "VALUES ('j', '', 'a', '{}', 'failed', 1, 'sprint1', 1, 't1', 'server', 'ppo')",
            "INSERT INTO checkpoints (id, job_id, attempt, step, key, manifest) VALUES ('c', 'j', 1, 1, 'k', '{}')",
            "INSERT INTO policies (id, owner, name) VALUES ('p', 'a', 'quick')",
            "INSERT INTO policy_versions (policy_id, number, checkpoint_id, notes, spec, spec_sha256, lineage) "
            "VALUES ('p', 2, 'c', '', '{}', '', '[]')",
            "INSERT INTO studies (id, name, owner, spec, job, state) "
            """VALUES ('s', '', 'a', '{}', '{"parent_policy": "quick@2"}', 'running'), """
            """('t', '', 'b', '{}', '{"parent_policy": "quick@2"}', 'running')""",
        ):
            connection.exec_driver_sql(statement)
    upgrade(url_of(empty), MIGRATIONS)
    with empty.begin() as connection:
        kept = connection.execute(text("SELECT job->>'parent_checkpoint_id' FROM studies ORDER BY id")).scalars().all()
    assert kept == ["c", None]


def test_several_processes_may_migrate_at_once(empty: Engine) -> None:
    with ThreadPoolExecutor(2) as pool:
        futures = [pool.submit(upgrade, url_of(empty), MIGRATIONS) for _ in range(2)]
        for future in futures:
            future.result()
    with empty.connect() as connection:
        assert connection.execute(text("SELECT version_num FROM alembic_version")).scalar_one() == REVISION


def test_the_code_names_the_newest_revision(tmp_path: Path) -> None:
    folder = tmp_path / "50% [x] %(here)s"
    folder.symlink_to(MIGRATIONS)
    scripts = ScriptDirectory.from_config(alembic_config("postgresql://", folder))
    assert scripts.get_current_head() == REVISION


def test_migrations_and_tokens_from_a_shell(
    empty: Engine, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("NAOSPRINT_MODE", "local")
    monkeypatch.setenv("NAOSPRINT_DATABASE_URL", url_of(empty))
    monkeypatch.setenv("NAOSPRINT_BROKER_URL", "redis://127.0.0.1/0")
    monkeypatch.setenv("NAOSPRINT_ARTIFACT_URL", "file:///nowhere")
    assert main(["migrate", "--directory", str(MIGRATIONS)]) == 0
    assert main(["token", "create", "--owner", "alice", "--scope", "submit"]) == 0
    created = capsys.readouterr().out
    assert '"token": "nao_' in created
    assert main(["token", "list"]) == 0
    listed = capsys.readouterr().out
    assert "alice" in listed
    assert "nao_" not in listed
    for given, status in ((json.loads(created)["token"], 0), ("nao_unknown", 1), ("", 1)):
        monkeypatch.setattr("sys.stdin", io.StringIO(f"{given}\n"))
        assert main(["token", "verify"]) == status
        assert ('"scopes": ["read", "submit"]' in capsys.readouterr().out) is (status == 0)
    assert main(["token", "revoke", "token_unknown"]) == 1
    assert "no token token_unknown" in capsys.readouterr().err
    for option, value in (("--days", "4000000"), ("--days", "0"), ("--days", "nan"), ("--name", "n" * 201)):
        assert main(["token", "create", "--owner", "alice", "--scope", "read", option, value]) == 1
        assert capsys.readouterr().err.startswith(f"{option[2:]}: give ")
    assert main(["token", "list"]) == 0, "none of them was made"
    assert capsys.readouterr().out == listed


@pytest.mark.parametrize("reachable", [True, False])
def test_a_shell_command_without_a_database_says_so_in_a_line(
    reachable: bool, empty: Engine, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It lacks the tables, or does not answer; the statement and the password are not shown."""
    url = url_of(empty) if reachable else f"postgresql://u:hidden@127.0.0.1:{reserved_port()}/x"
    monkeypatch.setenv("NAOSPRINT_MODE", "local")
    monkeypatch.setenv("NAOSPRINT_DATABASE_URL", url)
    monkeypatch.setenv("NAOSPRINT_BROKER_URL", "redis://127.0.0.1/0")
    monkeypatch.setenv("NAOSPRINT_ARTIFACT_URL", "file:///nowhere")
    commands = [["token", "list"], ["backup", "begin"], ["artifacts", "sweep"]]
    for command in commands if reachable else [*commands, ["migrate", "--directory", str(MIGRATIONS)]]:
        assert main(command) == 1
        written = capsys.readouterr().err
        assert written.startswith("the database failed: ") and written.count("\n") == 1
        assert ("does not exist" if reachable else "Connection refused") in written
        assert "hidden" not in written and "SELECT" not in written
    assert main(["token", "create", "--owner", "a", "--scope", "read", "--days", "1e12"]) == 1
