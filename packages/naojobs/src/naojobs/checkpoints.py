"""Recorded checkpoints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Self

from sqlalchemy import ColumnElement, Select, and_, select
from sqlalchemy.orm import Session, aliased

from naojobs.database import Sessions
from naojobs.models import Checkpoint, Job, Match, Study, StudyState
from naojobs.states import OPEN


@dataclass(frozen=True, slots=True)
class CheckpointRef:
    """Reference to a recorded checkpoint."""

    id: str
    job_id: str
    step: int
    attempt: int
    key: str
    manifest: dict[str, Any]

    @classmethod
    def of(cls, row: Checkpoint) -> Self:
        """Return the reference to a row."""
        return cls(row.id, row.job_id, row.step, row.attempt, row.key, row.manifest)


def newest_first(job_id: str) -> Select[Checkpoint]:
    """Return the query of a job's checkpoints: most steps first, the latest attempt first where two have the same."""
    by_age = (Checkpoint.step.desc(), Checkpoint.attempt.desc())
    return select(Checkpoint).where(Checkpoint.job_id == job_id).order_by(*by_age)


def newest_checkpoint(session: Session, job_id: str) -> Checkpoint | None:
    """Return the first checkpoint by `newest_first`; none if the job has none."""
    return session.scalar(newest_first(job_id).limit(1))


def trained_checkpoint(session: Session, job_id: str) -> Checkpoint | None:
    """Return the newest checkpoint behind step 0, whose weights are random; none if the job has none."""
    return session.scalar(newest_first(job_id).where(Checkpoint.step > 0).limit(1))


def in_use(session: Session, owner: str | None = None) -> dict[str, str]:
    """Return the ids of the checkpoints that open matches play with or trials of running studies start from.

    Returns:
        The match or study by checkpoint: "match match_...", and "a match of another user" unless it is of `owner`.
    """
    used: dict[str, str] = {}
    matches = select(Match.id, Match.owner, Match.spec["teams"]).where(Match.state.in_(OPEN))
    for match_id, theirs, teams in session.execute(matches):
        name = named("match", match_id, theirs, owner)
        used |= {policy: name for team in teams or () for policy in team.get("policies", {}).values()}
    parent = Study.job["parent_checkpoint_id"].as_string()
    studies = select(Study.id, Study.owner, parent).where(Study.state == StudyState.RUNNING)
    for study_id, theirs, checkpoint in session.execute(studies):
        if checkpoint is not None:
            used[checkpoint] = named("study", study_id, theirs, owner)
    return used


def named(kind: str, work_id: str, theirs: str, owner: str | None) -> str:
    """Return how work is named to `owner`: users see no work of others."""
    return f"{kind} {work_id}" if theirs == owner else f"a {kind} of another user"


@cache
def awaits_policy() -> ColumnElement[bool]:
    """Return the condition under which a job has to wait: it starts from a policy not trained yet."""
    parent = aliased(Job)
    own = select(Checkpoint.id).where(Checkpoint.job_id == Job.id)
    trained = select(Checkpoint.id).where(Checkpoint.job_id == Job.parent_job_id, Checkpoint.step > 0)
    return and_(
        Job.needs_policy,
        Job.parent_checkpoint_id.is_(None),
        ~own.exists(),
        select(parent.id).where(parent.id == Job.parent_job_id, parent.state.in_(OPEN)).exists(),
        ~trained.exists(),
    )


def checkpoints_of(sessions: Sessions, job_id: str) -> list[CheckpointRef]:
    """Return references to all checkpoints of a job by `newest_first`."""
    with sessions() as session:
        return [CheckpointRef.of(row) for row in session.scalars(newest_first(job_id))]
