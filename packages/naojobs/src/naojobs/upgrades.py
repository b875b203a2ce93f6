"""What an upgrade would lose, found before it changes anything."""

from __future__ import annotations

from pathlib import Path

import psycopg
from naospec import EvaluationSpec, TrainingSpec, plugins, read_stored, validation_words
from psycopg import sql
from pydantic import ValidationError

from naojobs.connections import bounds
from naojobs.database import alembic_config
from naojobs.errors import ConflictError
from naojobs.states import ENDED

_NAMED = 5
"""Pieces of work that an error names."""

_SPECS: dict[str, type[TrainingSpec] | type[EvaluationSpec]] = {"jobs": TrainingSpec, "evaluations": EvaluationSpec}


def check_upgrade(url: str, migrations: Path, *, force: bool = False) -> None:
    """Check that this version can read a database that it would migrate.

    Args:
        url: the database (postgresql+psycopg://...).
        migrations: folder of the migrations.
        force: migrate even if open work cannot be read: it fails when a worker claims it.

    Raises:
        ConflictError: a newer version has migrated the database, or open work cannot be read.
    """
    from alembic.script import ScriptDirectory

    scripts = ScriptDirectory.from_config(alembic_config(url, migrations))
    with psycopg.connect(f"postgresql://{url.split('://', 1)[1]}", **bounds(url)) as connection:
        if connection.execute("SELECT to_regclass('alembic_version')").fetchone() == (None,):
            return
        row = connection.execute("SELECT version_num FROM alembic_version").fetchone()
        if row is None:
            return
        (revision,) = row
        if revision not in {script.revision for script in scripts.walk_revisions()}:
            raise ConflictError(
                f"a newer version of naosprint has migrated this database (revision {revision}, this version knows "
                f"{scripts.get_current_head()}); run that version, or restore a backup from before its upgrade"
            )
        if force or revision == scripts.get_current_head():
            return
        unreadable = _unreadable(connection)
    if unreadable:
        more = f"\nand {len(unreadable) - _NAMED} more" if len(unreadable) > _NAMED else ""
        raise ConflictError(
            "nothing was changed: this version cannot read open work of the version before.\n"
            + "\n".join(unreadable[:_NAMED])
            + f"{more}\nLet that version finish or cancel it, or lose it: migrate --force"
        )


def _unreadable(connection: psycopg.Connection) -> list[str]:
    """Return a line for each piece of open work whose specification this version cannot read."""
    lines = []
    for table, model in _SPECS.items():
        if connection.execute("SELECT to_regclass(%s)", (table,)).fetchone() == (None,):
            continue
        statement = sql.SQL("SELECT id, spec FROM {} WHERE state <> ALL (%s) ORDER BY id").format(sql.Identifier(table))
        for work_id, spec in connection.execute(statement, ([str(state) for state in ENDED],)):
            try:
                read_stored(model, spec)
            except ValidationError as error:
                lines.append(f"{work_id}: {validation_words(error.errors())}")
            except plugins.BrokenPluginError as error:
                lines.append(f"{work_id}: {error}")
    return lines
