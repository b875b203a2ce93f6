"""What a new version cannot read of open work is named before a migration changes anything."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from naojobs import matches, studies, submission
from naojobs.database import make_engine, make_sessions
from naojobs.errors import ConflictError
from naojobs.matches import MatchRequest
from naojobs.studies import StudyRequest
from naojobs.submission import JobRequest
from naojobs.upgrades import check_upgrade
from naospec import EvaluationSpec
from naospec.search import SearchSpec
from sqlalchemy import text

MIGRATIONS = Path(__file__).parents[3] / "migrations"

DAMAGES = [
    ("jobs", "evaluation = jsonb_set(evaluation, '{format}', '0')", "of this evaluation specification is too old"),
    ("jobs", "parent_policy = 'gone'", "this version has no policy 'gone', which it needs"),
    ("matches", "spec = spec - 'teams'", "teams: "),
    ("matches", "spec = jsonb_set(spec, '{teams,0,policies,walk}', '\"t1-gone\"')", "has no policy 't1-gone'"),
    ("studies", "spec = jsonb_set(spec, '{space,gone}', spec #> '{space,learning_rate}')", "has no field 'gone'"),
    ("studies", "spec = jsonb_set(spec, '{space,learning_rate,high}', '9')", "learning_rate=9"),
    ("studies", "job = jsonb_set(job, '{spec,format}', '0')", "of this training specification is too old"),
    ("studies", "job = '{}'", "KeyError: 'evaluation'"),
]
"""Changes of open work that make it another version's: table, change and what the error says."""


def test_all_open_work_is_read_before_an_upgrade(make_database: Callable[..., str]) -> None:
    url = make_database().replace("postgresql://", "postgresql+psycopg://", 1)
    engine = make_engine(url)
    sessions = make_sessions(engine)
    job = JobRequest(evaluation=EvaluationSpec())
    space = {"learning_rate": {"type": "float", "low": 1e-4, "high": 1e-3}}
    study = StudyRequest(job, SearchSpec.model_validate({"space": space}))
    match = MatchRequest(teams=("example", "example"), games=1, players=1, half_s=1.0)
    with sessions.begin() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '0030'"))
    made = {
        "jobs": lambda: submission.submit(sessions, job, owner="alice")[0].id,
        "matches": lambda: matches.submit_match(sessions, match, owner="alice")[0].id,
        "studies": lambda: studies.submit_study(sessions, study, owner="alice")[0].id,
    }
    for make in made.values():
        make()
    check_upgrade(url, MIGRATIONS)
    for table, change, reason in DAMAGES:
        work_id = made[table]()
        with sessions.begin() as session:
            session.execute(text(f"UPDATE {table} SET {change} WHERE id = :id"), {"id": work_id})
        with pytest.raises(ConflictError) as refused:
            check_upgrade(url, MIGRATIONS)
        assert f"\n{work_id}: " in str(refused.value) and reason in str(refused.value)
        with sessions.begin() as session:  # what has ended need not be read
            session.execute(text(f"UPDATE {table} SET state = 'cancelled'"))
    check_upgrade(url, MIGRATIONS)
    engine.dispose()
