"""The migrations: up gives what the models say, down leaves nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from naojobs.__main__ import main
from naojobs.database import REVISION, alembic_config, downgrade, upgrade
from naojobs.models import Base
from sqlalchemy import Engine, create_engine, inspect, text

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


def test_up_gives_what_the_models_say_and_down_leaves_nothing(empty: Engine) -> None:
    upgrade(url_of(empty), MIGRATIONS)
    with empty.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_server_default": True})
        assert compare_metadata(context, Base.metadata) == []
    downgrade(url_of(empty), MIGRATIONS, "base")
    assert inspect(empty).get_table_names() == ["alembic_version"]
    assert inspect(empty).get_sequence_names() == []
    upgrade(url_of(empty), MIGRATIONS)
    assert set(inspect(empty).get_table_names()) == {"alembic_version", *Base.metadata.tables}


def test_several_processes_may_migrate_at_once(empty: Engine) -> None:
    with ThreadPoolExecutor(2) as pool:
        futures = [pool.submit(upgrade, url_of(empty), MIGRATIONS) for _ in range(2)]
        for future in futures:
            future.result()
    with empty.connect() as connection:
        assert connection.execute(text("SELECT version_num FROM alembic_version")).scalar_one() == REVISION


def test_the_code_names_the_newest_revision() -> None:
    scripts = ScriptDirectory.from_config(alembic_config("postgresql://", MIGRATIONS))
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
    assert main(["token", "revoke", "token_unknown"]) == 1
    assert "no token token_unknown" in capsys.readouterr().err
