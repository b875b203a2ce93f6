"""What an upgrade would lose, found before it changes anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import naopolicies
import psycopg
from naospec import EvaluationSpec, TrainingSpec, plugins, read_stored, validation_words
from naospec.search import SearchSpec
from psycopg import sql
from pydantic import ValidationError

from naojobs.connections import bounds
from naojobs.database import alembic_config
from naojobs.errors import ConflictError, InvalidError
from naojobs.models import Study, StudyState
from naojobs.states import ENDED
from naojobs.studies import job_of, trial_job
from naojobs.teams import MatchSpec

_NAMED = 5
"""Pieces of work that an error names."""


def _read_job(row: Mapping[str, Any]) -> list[str | None]:
    read_stored(TrainingSpec, row["spec"])
    if row["evaluation"]:
        read_stored(EvaluationSpec, row["evaluation"])
    return [] if row["attempt"] else [row.get("parent_policy")]  # one that has begun resumes from its checkpoints


def _read_evaluation(row: Mapping[str, Any]) -> list[str | None]:
    read_stored(EvaluationSpec, row["spec"])
    return []


def _read_match(row: Mapping[str, Any]) -> list[str | None]:
    used = (policy for team in MatchSpec.model_validate(row["spec"]).teams for policy in team.policies.values())
    return [policy for policy in used if not policy.startswith("ckpt_")]


def _read_study(row: Mapping[str, Any]) -> list[str | None]:
    job = job_of(Study(name=row["name"], job=row["job"]))
    for name, parameter in SearchSpec.model_validate(row["spec"]).space.items():
        for value in parameter.ends():
            trial_job(job, {name: value})
    return [job.parent_policy]


_READERS: dict[str, Callable[[Mapping[str, Any]], list[str | None]]] = {
    "jobs": _read_job,
    "evaluations": _read_evaluation,
    "matches": _read_match,
    "studies": _read_study,
}
"""By table, what reads a row of work as this version's workers will; it returns the policies by name that they need."""

_OVER = [*map(str, ENDED), *(str(state) for state in StudyState if state is not StudyState.RUNNING)]


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
    known = set(naopolicies.names())
    for table, read in _READERS.items():
        if connection.execute("SELECT to_regclass(%s)", (table,)).fetchone() == (None,):
            continue
        statement = sql.SQL("SELECT to_jsonb(work) FROM {} work WHERE state <> ALL (%s) ORDER BY id")
        for (row,) in connection.execute(statement.format(sql.Identifier(table)), (_OVER,)):
            try:
                gone = {policy for policy in read(row) if policy is not None and "@" not in policy} - known
                lines += [
                    f"{row['id']}: this version has no policy {policy!r}, which it needs" for policy in sorted(gone)
                ]
            except ValidationError as error:
                lines.append(f"{row['id']}: {validation_words(error.errors())}")
            except (plugins.BrokenPluginError, InvalidError) as error:
                lines.append(f"{row['id']}: {error}")
            except Exception as error:  # a document of another shape, or a defect of a plug-in: its work would fail
                lines.append(f"{row['id']}: {type(error).__name__}: {error}")
    return lines
