"""Checkpoints and evaluations."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from naojobs.models import DEFAULT_TIME_LIMIT_S
from naojobs.submission import EvaluationRequest
from naospec import EvaluationSpec
from pydantic import BaseModel, Field

from naosprint_api.schemas.common import EvaluationState, FilePublic, Id, Page, WorkCreate


class CheckpointPublic(BaseModel):
    """Checkpoint."""

    id: str
    job_id: str
    attempt: int
    step: int
    created_at: datetime
    size: int = Field(description="Bytes of all files.")
    files: list[FilePublic]
    archive_url: str = Field(description="Where to download all files as one tar archive.")


class CheckpointPage(Page[CheckpointPublic]):
    """Page of checkpoints, most steps first."""


class EvaluationPublic(BaseModel):
    """Evaluation of a checkpoint."""

    id: str
    job_id: str
    checkpoint_id: str
    state: EvaluationState
    spec: dict[str, Any] = Field(description="Specification of the evaluation, as stored.")
    report: str | None = Field(description="Report that was asked for; null for what the worker is set to.")
    tags: list[str]
    priority: int
    not_before: datetime | None = Field(description="When its next attempt may begin; null: at any time.")
    waiting_reason: str | None = Field(
        description="Why no worker can take the queued evaluation; null if a worker can, and in all other states."
    )
    attempt: int = Field(description="Number of claims by workers.")
    failures: int = Field(description="Number of lost attempts.")
    max_attempts: int = Field(description="The evaluation fails when failures reaches it.")
    worker: str | None = Field(description="Id of the worker that leases it.")
    stalled_since: datetime | None = Field(
        description="Since when the running evaluation has made no step; null if it makes steps."
    )
    cancel_requested: bool
    time_limit_s: float = Field(description="Seconds that one attempt may take.")
    summary: dict[str, Any] | None = Field(description="Metrics over all episodes; null until it has succeeded.")
    files: list[FilePublic]
    archive_url: str | None
    error: str | None = Field(description="Why it failed, or why its last attempt was lost.")
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None


class EvaluationPage(Page[EvaluationPublic]):
    """Page of evaluations, newest first."""


class EvaluationCreate(WorkCreate):
    """Evaluation to run."""

    priority: int | None = Field(  # type: ignore[assignment]
        None, ge=0, le=9, description="0 to 9; work with a higher priority starts first. Left out: the job's."
    )
    checkpoint_id: Id | None = Field(None, description="Which checkpoint to evaluate; left out, the newest.")
    spec: EvaluationSpec | None = Field(
        None, description="How to evaluate it; left out, 1000 episodes of the job's task."
    )
    time_limit_s: float = Field(
        DEFAULT_TIME_LIMIT_S,
        gt=0,
        le=30 * 86_400,
        description="Seconds that one attempt may take; then the evaluation fails.",
    )
    report: Literal["film", "pictures", "off"] | None = Field(
        None,
        description="Report to draw with it, whose files are among the evaluation's: with a film, with pictures only, "
        "or none; left out, what the worker is set to (`NAOSPRINT_WORKER_REPORT`).",
    )

    def request(self) -> EvaluationRequest:
        """Return the evaluation for `naojobs.submission`."""
        return EvaluationRequest(**{name: getattr(self, name) for name in type(self).model_fields})
