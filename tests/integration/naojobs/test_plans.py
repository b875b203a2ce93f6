"""What runs every few seconds reads the work that is open, not all that has ever ended."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from naojobs import matches, outcomes, submission
from naojobs.leases import Lease
from naojobs.matches import MatchRequest
from naojobs.models import Base, Job
from naojobs.retention import find_orphans
from naojobs.states import WorkState
from naojobs.store import ArtifactStore
from naojobs.submission import JobRequest
from naosprint_api.telemetry import Telemetry
from sqlalchemy import Engine, event, text
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work
from tests.integration.writes import record_checkpoint, request_evaluation

Sessions = sessionmaker[Session]

ENDED = 4_000
"""Rows of each kind that have ended."""
TABLES = ("jobs", "evaluations", "matches")


@pytest.fixture(scope="module")
def held(sessions: Sessions) -> Lease:
    """The lease of the one job that runs, beside many jobs, evaluations and matches that have ended."""
    job, _ = submission.submit(sessions, JobRequest(), owner="alice")
    claim = claim_work(sessions, Job, job.id, "worker")
    assert claim is not None
    record_checkpoint(sessions, claim.lease, step=1, key=f"jobs/{job.id}/1", manifest={"files": []})
    evaluation = request_evaluation(sessions, job.id)
    match, _ = matches.submit_match(
        sessions, MatchRequest(teams=("example", "example"), games=1, players=1, half_s=1.0), owner="alice"
    )
    for table, model in zip(TABLES, (job, evaluation, match), strict=True):
        _copy(sessions, table, model.id)
    return claim.lease


def _copy(sessions: Sessions, table: str, work_id: str) -> None:
    """Add copies of a row that ended an hour ago and more, and let the planner count them."""
    ended = {
        "id": "'ended_' || n",
        "state": "'failed'",
        "finished_at": "now() - n * interval '1 h'",
        "updated_at": "now() - n * interval '1 h'",
        **dict.fromkeys(("lease_owner", "lease_generation", "lease_expires_at", "idempotency_key"), "NULL"),
    }
    others = [f'"{column.name}"' for column in Base.metadata.tables[table].columns if column.name not in ended]
    with sessions.begin() as session:
        session.execute(
            text(
                f"INSERT INTO {table} ({', '.join([*ended, *others])}) SELECT {', '.join([*ended.values(), *others])} "
                f"FROM {table}, generate_series(1, {ENDED}) AS n WHERE id = :id"
            ),
            {"id": work_id},
        )
        session.execute(text(f"ANALYZE {table}"))


@contextmanager
def plans(engine: Engine) -> Iterator[list[str]]:
    """Yield the plans of the queries of work that are made meanwhile; they are there at the end."""
    queries: dict[str, Any] = {}
    found: list[str] = []

    def note(_connection: object, _cursor: object, query: str, values: Any, _context: object, _many: bool) -> None:
        if query.startswith("SELECT") and any(f"FROM {table}" in query for table in TABLES):
            queries[query] = values

    event.listen(engine, "before_cursor_execute", note)
    try:
        yield found
    finally:
        event.remove(engine, "before_cursor_execute", note)
    with engine.connect() as connection:
        for query, values in queries.items():
            rows = connection.exec_driver_sql(f"EXPLAIN {query}", values).scalars()
            found.append("\n".join([query, *rows]))


def read_whole(found: list[str]) -> list[str]:
    """Return the plans that read a whole table of work."""
    return [plan for plan in found if any(f"Seq Scan on {table}" in plan for table in TABLES)]


def test_the_search_for_expired_leases(sessions: Sessions, engine: Engine, held: Lease) -> None:
    with plans(engine) as found:
        assert outcomes.requeue_stale(sessions) == []
    assert read_whole(found) == []
    assert [f"ix_{table}_leases" in plan for table, plan in zip(TABLES, found, strict=True)] == [True] * 3


def test_the_search_for_files_that_are_in_use(
    sessions: Sessions, engine: Engine, held: Lease, store: ArtifactStore
) -> None:
    """The keys of all files are read, those of the work under way are found by index."""
    with plans(engine) as found:
        find_orphans(sessions, store)
    busy = [plan for plan in found if "lease_owner" in plan]
    assert read_whole(busy) == []
    assert [f"ix_{table}_leases" in plan for table, plan in zip(TABLES, busy, strict=True)] == [True] * 3


def test_the_metrics_of_the_service(sessions: Sessions, engine: Engine, held: Lease) -> None:
    """Only the jobs and matches by state are counted one by one."""
    telemetry = Telemetry(sessions)

    def figures() -> list[str]:
        return telemetry.render({}).decode().splitlines()

    with plans(engine) as found:
        before = figures()
    assert len(read_whole(found)) == sum("GROUP BY" in plan for plan in found) == 2
    assert f'naosprint_jobs{{state="failed"}} {ENDED}.0' in before
    assert {"naosprint_stalled 0.0", "naosprint_jobs_failed_recently 0.0"} <= set(before)

    waiting, _ = submission.submit(sessions, JobRequest(), owner="alice")
    tomorrow = datetime.now(UTC) + timedelta(days=1)
    for request in (JobRequest(not_before=tomorrow), JobRequest(parent_job_id=waiting.id)):  # no worker may begin them
        submission.submit(sessions, request, owner="alice")
    with sessions.begin() as session:
        session.execute(text("UPDATE jobs SET queued_at = now() - interval '1 day' WHERE state = 'queued'"))
        row = session.get_one(Job, waiting.id)
        row.postponed = 1
        session.execute(text("UPDATE jobs SET queued_at = now() - interval '90 s' WHERE id = :id"), {"id": row.id})
    outcomes.report_stall(sessions, held, 400.0)
    shown = dict(line.split(" ") for line in figures() if line.startswith("naosprint_") and "{" not in line)
    assert (shown["naosprint_stalled"], shown["naosprint_jobs_postponed"]) == ("1.0", "1.0")
    assert 90.0 <= float(shown["naosprint_queue_oldest_seconds"]) < 1_000.0
    outcomes.transition(sessions, held, WorkState.FAILED, error="x")
    assert "naosprint_jobs_failed_recently 1.0" in figures()
