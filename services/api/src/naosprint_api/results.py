"""Results of jobs: of each job's finished evaluations, the newest of those with the most episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from naojobs.models import Checkpoint, Evaluation, Job
from naojobs.states import WorkState
from sqlalchemy import Integer, func, select
from sqlalchemy.dialects.postgresql import distinct_on
from sqlalchemy.orm import Session

from naosprint_api.schemas.jobs import JobResult, ResultPublic

_EPISODES = func.coalesce(Evaluation.summary["episodes"].astext, Evaluation.spec["episodes"].astext).cast(Integer)


def results_of(session: Session, jobs: Sequence[Job]) -> dict[str, JobResult]:
    """Return the results by job id; jobs without a finished evaluation are left out."""
    begun = [job.id for job in jobs if job.attempt > 0]  # others have no checkpoint that could be evaluated
    if not begun:
        return {}
    # The whole document has tables and specifications, which lists do not show.
    statement = (
        select(
            Evaluation.job_id,
            Evaluation.id,
            Evaluation.checkpoint_id,
            Evaluation.finished_at,
            _EPISODES.label("episodes"),
            Checkpoint.step,
            Evaluation.summary["results"].label("results"),
            Evaluation.summary["headline"].label("headline"),
        )
        .join(Checkpoint, Checkpoint.id == Evaluation.checkpoint_id)
        .where(Evaluation.job_id.in_(begun), Evaluation.state == WorkState.SUCCEEDED)
        .where(Evaluation.summary.has_key("results"))  # documents of version 0.1 do not describe themselves
        .ext(distinct_on(Evaluation.job_id))
        .order_by(Evaluation.job_id, _EPISODES.desc(), Evaluation.finished_at.desc())
    )
    live = {job.id: job.latest_metrics.keys() for job in jobs}
    return {
        row.job_id: JobResult(
            evaluation_id=row.id,
            checkpoint_id=row.checkpoint_id,
            step=row.step,
            episodes=row.episodes,
            finished_at=row.finished_at,
            results=_shown(row.results, [*(row.headline or ()), *live[row.job_id]]),
        )
        for row in session.execute(statement)
    }


def summaries_of(session: Session, checkpoint_ids: Sequence[str]) -> dict[str, Evaluation]:
    """Return the evaluation of each checkpoint that counts, chosen as for jobs; others are left out."""
    statement = (
        select(Evaluation)
        .where(Evaluation.checkpoint_id.in_(checkpoint_ids), Evaluation.state == WorkState.SUCCEEDED)
        .where(Evaluation.summary.has_key("results"))
        .ext(distinct_on(Evaluation.checkpoint_id))
        .order_by(Evaluation.checkpoint_id, _EPISODES.desc(), Evaluation.finished_at.desc())
    )
    return {row.checkpoint_id: row for row in session.scalars(statement)}


def _shown(results: Sequence[dict[str, Any]], names: Sequence[str]) -> list[ResultPublic]:
    """Return the results with these names, in their order, each once."""
    by_name = {result["name"]: result for result in results}
    return [
        ResultPublic.model_validate({"title": name, **by_name[name]})
        for name in dict.fromkeys(names)
        if name in by_name
    ]
