"""Jobs: submission, metrics, history, logs."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Self

from naojobs.states import WorkState
from naojobs.submission import MAX_GROUP_SIZE, GroupRequest, JobRequest
from naospec import EvaluationSpec, TrainingSpec
from pydantic import AfterValidator, BaseModel, Field, StringConstraints, model_validator

from naosprint_api.patterns import NAME, REFERENCE, TEXT
from naosprint_api.schemas.common import Id, Page, RequestBody, RowView, Tag, TrainingDocument, WorkCreate

RESERVED_NAMES = frozenset({"last"})
"""Words that refer to a job in commands, and so are not allowed as names."""


def _not_reserved(name: str) -> str:
    if name in RESERVED_NAMES:
        raise ValueError(f"{name!r} refers to the newest job in commands; use another name")
    return name


Name = Annotated[
    str,
    StringConstraints(strip_whitespace=True, min_length=1, max_length=200, pattern=NAME),
    AfterValidator(_not_reserved),
]


class JobCreate(WorkCreate):
    """Job to submit."""

    name: Name | None = Field(
        None,
        description="Name; left out: made of task, preset and seed. A number is added if the owner has such a job.",
    )
    spec: TrainingSpec = Field(
        default_factory=TrainingSpec,
        description="What to train; a field left out takes the preset's value.",
    )
    evaluation: EvaluationSpec | None = Field(
        default_factory=EvaluationSpec,
        description="How to evaluate the final policy, by default on the training's task; null for no evaluation.",
    )
    parent_job_id: Id | None = Field(None, description="Start from the policy of this job.")
    parent_checkpoint_id: Id | None = Field(
        None,
        description="Start from this checkpoint; left out, from the parent job's newest when this job starts.",
    )

    parent_policy: Annotated[str, StringConstraints(pattern=REFERENCE)] | None = Field(
        None, description="Start from a bundled or registered policy instead: NAME, NAME@VERSION or NAME@ALIAS."
    )

    @model_validator(mode="after")
    def _one_parent(self) -> Self:
        if self.parent_policy is not None and self.parent_job_id is not None:
            raise ValueError("parent_policy: give a parent policy or a parent job, not both")
        if self.parent_checkpoint_id is not None and self.parent_job_id is None:
            raise ValueError("parent_job_id: give the job that parent_checkpoint_id belongs to")
        return self

    def request(self) -> JobRequest:
        """Return the job for `naojobs.submission`."""
        return JobRequest(**{name: getattr(self, name) for name in type(self).model_fields})


class JobPatch(RequestBody):
    """Changes of a job's name, tags, notes and priority."""

    name: Name | None = Field(None, description="New name, which no other job of the owner has.")
    tags: list[Tag] | None = Field(None, max_length=20, description="All tags from now on.")
    notes: Annotated[str, StringConstraints(max_length=10_000, pattern=TEXT)] | None = Field(
        None, description="Notes: plain text, at most 10,000 characters."
    )
    priority: int | None = Field(None, ge=0, le=9, description="New priority of a job that has not ended.")


class GroupCreate(RequestBody):
    """Jobs to submit that differ in a few fields: N seeds, a grid, or both."""

    job: JobCreate = Field(description="Fields that all jobs share.")
    seeds: list[int] = Field(default_factory=list, max_length=MAX_GROUP_SIZE, description="One job for each seed.")
    grid: dict[str, Annotated[list[Any], Field(min_length=1, max_length=MAX_GROUP_SIZE)]] = Field(
        default_factory=dict,
        max_length=8,
        description=(
            "Settings of the training, by short name (learning_rate) or by path (algorithm.learning_rate), each with "
            "its values; one job for each combination."
        ),
    )

    def request(self) -> GroupRequest:
        """Return the group for `naojobs.submission`."""
        return GroupRequest(self.job.request(), self.seeds, self.grid)


class ResultPublic(BaseModel):
    """One result of an evaluation: a metric over all episodes."""

    name: str
    title: str
    unit: str = ""
    digits: int = Field(2, description="Decimals to show.")
    value: float | None = Field(None, description="Null if no episode counts.")
    interval: tuple[float, float] | None = Field(None, description="Confidence interval.")
    sd: float | None = Field(None, description="Standard deviation over the episodes.")


class JobResult(BaseModel):
    """Result of a job: of its finished evaluations, the newest of those with the most episodes."""

    evaluation_id: str
    checkpoint_id: str
    step: int = Field(description="Environment steps of the checkpoint.")
    episodes: int
    finished_at: datetime
    results: list[ResultPublic] = Field(description="The task's main results, then others that training reports too.")


class JobPublic(RowView):
    """Job."""

    id: str
    name: str
    owner: str
    tags: list[str]
    notes: str = Field(description="The user's notes.")
    state: WorkState
    priority: int
    queue: str = Field(
        validation_alias="simulator", description="Its simulator.", json_schema_extra={"deprecated": True}
    )
    waiting_reason: str | None = Field(
        None, description="Why no worker can take the queued job; null if a worker can, and in all other states."
    )
    not_before: datetime | None = Field(None, description="When its next attempt may begin; null: at any time.")
    spec: TrainingDocument = Field(description="Specification of the training, in the current format.")
    evaluation: dict[str, Any] | None = Field(description="How the final policy is evaluated; null for no evaluation.")
    attempt: int = Field(description="Number of claims by workers.")
    failures: int = Field(description="Attempts lost since the last submit or retry.")
    max_attempts: int = Field(description="The job fails when failures reaches it.")
    worker: str | None = Field(validation_alias="lease_owner", description="Id of the worker that leases it.")
    heartbeat_at: datetime | None
    stalled_since: datetime | None = Field(
        description="Since when the running job has made no step; null if it makes steps, and in all other states."
    )
    cancel_requested: bool
    pruned: str | None = Field(description="Why its study ended it early; null if it did not.")
    pause_requested: bool = Field(
        validation_alias="pausing", description="Whether its state is pausing.", json_schema_extra={"deprecated": True}
    )
    parent_job_id: str | None
    parent_checkpoint_id: str | None
    parent_policy: str | None = Field(description="The bundled policy or the version that it was to start from.")
    needs_policy: bool = Field(description="Whether it was to start from another policy, which may be deleted since.")
    software: dict[str, str] = Field(
        description="Versions by package that the last attempt ran with, and the commit of the source if it is known."
    )
    group_id: str | None
    progress_step: int = Field(description="Environment steps done.")
    total_steps: int = Field(description="Environment steps to do: whole rollouts.")
    latest_metrics: dict[str, float] = Field(
        description="The newest row of training metrics: of the latest episodes, with exploration."
    )
    result: JobResult | None = Field(None, description="Its evaluation; null until one has finished.")
    error: str | None = Field(description="Why it failed, or why its last attempt was lost.")
    created_at: datetime
    queued_at: datetime | None
    started_at: datetime | None
    finished_at: datetime | None
    updated_at: datetime


class JobPage(Page[JobPublic]):
    """Page of jobs, newest first."""


class GroupPublic(BaseModel):
    """Group and its jobs."""

    id: str
    jobs: list[JobPublic]


class MetricsPublic(BaseModel):
    """Metrics by column; every column has one value per row, null where a row has none."""

    columns: dict[str, list[float | None]]
    rows: int = Field(description="Rows in this answer.")
    total_rows: int = Field(description="Rows after `after_step`, before thinning.")
    last_seq: int = Field(description="Give it as `metrics_after` to a stream to continue after these rows.")


class EventPublic(RowView):
    """Event in the history of a job."""

    id: int
    at: datetime
    kind: str
    attempt: int
    message: str
    data: dict[str, Any]


class EventPage(BaseModel):
    """Page of events, oldest first."""

    items: list[EventPublic]
    next_after: int | None = Field(description="Value of `after` for the next page; null if the page is empty.")


class LogPublic(RowView):
    """Line of a job's log."""

    id: int
    at: datetime
    attempt: int
    level: str
    message: str


class LogPage(BaseModel):
    """Page of log lines, oldest first."""

    items: list[LogPublic]
    next_after: int | None = Field(description="Value of `after` for the next page; null if the page is empty.")
