"""Results of jobs: of each job's finished evaluations, the newest of those with the most episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from naojobs.models import Checkpoint, Evaluation, Job
from naojobs.states import WorkState
from sqlalchemy import Integer, func, select
from sqlalchemy.dialects.postgresql import distinct_on
from sqlalchemy.orm import Session

from naosprint_api.schemas import JobResult, ResultPublic


def results_of(session: Session, jobs: Sequence[Job]) -> dict[str, JobResult]:
    """Return the results by job id; jobs without a finished evaluation are left out."""
    if not jobs:
        return {}
    episodes = func.coalesce(Evaluation.summary["episodes"].astext, Evaluation.spec["episodes"].astext).cast(Integer)
    # The whole document has tables and specifications, which lists do not show.
    statement = (
        select(
            Evaluation.job_id,
            Evaluation.id,
            Evaluation.checkpoint_id,
            Evaluation.finished_at,
            episodes.label("episodes"),
            Checkpoint.step,
            Evaluation.summary["results"].label("results"),
            Evaluation.summary["headline"].label("headline"),
        )
        .join(Checkpoint, Checkpoint.id == Evaluation.checkpoint_id)
        .where(Evaluation.job_id.in_([job.id for job in jobs]), Evaluation.state == WorkState.SUCCEEDED)
        .where(Evaluation.summary.has_key("results"))  # documents of version 0.1 do not describe themselves
        .ext(distinct_on(Evaluation.job_id))
        .order_by(Evaluation.job_id, episodes.desc(), Evaluation.finished_at.desc())
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


def _shown(results: Sequence[dict[str, Any]], names: Sequence[str]) -> list[ResultPublic]:
    """Return the results with these names, in their order, each once."""
    by_name = {result["name"]: result for result in results}
    return [
        ResultPublic.model_validate({"title": name, **by_name[name]})
        for name in dict.fromkeys(names)
        if name in by_name
    ]
