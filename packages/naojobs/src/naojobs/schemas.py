"""What goes over HTTP: requests and the public views of rows."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Self

from naospec import TASKS, EvaluationSpec, TrainingSpec
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

from naojobs.ids import PATTERN
from naojobs.scopes import Scope
from naojobs.states import EvaluationState, JobState

Tag = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._:/=-]{0,49}$")]
Name = Annotated[
    str, StringConstraints(strip_whitespace=True, min_length=1, max_length=200, pattern=r"^[^\x00-\x1f]*$")
]
Id = Annotated[str, StringConstraints(pattern=PATTERN)]

#: The most jobs that one group may hold.
MAX_GROUP_SIZE = 256


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Public(BaseModel):
    model_config = ConfigDict(from_attributes=True)


class JobCreate(_Request):
    """Describes a job to submit."""

    name: Name | None = Field(None, description="What to call it; left out, task, preset and seed name it.")
    tags: list[Tag] = Field(
        default_factory=list,
        max_length=20,
        description="Words to find it by: letters, digits and ._:/=- (at most 50 characters each).",
    )
    spec: TrainingSpec = Field(
        default_factory=TrainingSpec,
        description="What to train; a field left out takes the preset's value.",
    )
    evaluation: EvaluationSpec | None = Field(
        default_factory=EvaluationSpec,
        description="How to judge the final policy; its task is the training's unless given. null for no evaluation.",
    )
    priority: int = Field(5, ge=0, le=9, description="0 to 9; higher goes first.")
    max_attempts: int = Field(3, ge=1, le=10, description="Lost workers or trainers after which the job fails.")
    parent_job_id: Id | None = Field(None, description="Start from the policy of this job.")
    parent_checkpoint_id: Id | None = Field(
        None,
        description="Start from this checkpoint; left out, from the parent job's newest when this job starts.",
    )

    @model_validator(mode="before")
    @classmethod
    def _judge_the_task_that_is_trained(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        evaluation = data.get("evaluation", {})
        if not isinstance(evaluation, dict) or "task" in evaluation:
            return data
        spec = data.get("spec", {})
        task = spec.get("task") if isinstance(spec, dict) else getattr(spec, "task", None)
        return (
            data
            if not isinstance(task, str) or task not in TASKS
            else {**data, "evaluation": {**evaluation, "task": task}}
        )

    @model_validator(mode="after")
    def _checkpoint_needs_job(self) -> Self:
        if self.parent_checkpoint_id is not None and self.parent_job_id is None:
            raise ValueError("parent_job_id: give the job that parent_checkpoint_id belongs to")
        return self

    def display_name(self) -> str:
        """Return the name, or one made of task, preset and seed."""
        return self.name or f"{self.spec.task}-{self.spec.preset}-{self.spec.seed}"


class GroupCreate(_Request):
    """Describes several jobs that differ in a few fields: N seeds, a grid, or both."""

    job: JobCreate = Field(description="What all of them share.")
    seeds: list[int] = Field(default_factory=list, max_length=MAX_GROUP_SIZE, description="One job for each seed.")
    grid: dict[str, Annotated[list[Any], Field(min_length=1, max_length=MAX_GROUP_SIZE)]] = Field(
        default_factory=dict,
        max_length=8,
        description="Fields of the training specification, each with its values; one job for each combination.",
    )


class JobPublic(_Public):
    """Shows a job to those who may see it."""

    id: str
    name: str
    owner: str
    tags: list[str]
    state: JobState
    priority: int
    queue: str = Field(description="The simulator that a worker must have.")
    spec: TrainingSpec
    evaluation: EvaluationSpec | None
    attempt: int = Field(description="How often a worker has claimed it.")
    failures: int = Field(description="Attempts lost since the last submit or retry.")
    max_attempts: int = Field(description="The job fails when failures reaches it.")
    worker: str | None = Field(validation_alias="lease_owner", description="Who works on it now.")
    heartbeat_at: datetime | None
    cancel_requested: bool
    pause_requested: bool
    parent_job_id: str | None
    parent_checkpoint_id: str | None
    group_id: str | None
    progress_step: int = Field(description="Environment steps done.")
    total_steps: int = Field(description="Environment steps to do: whole rollouts.")
    latest_metrics: dict[str, float] = Field(description="The newest row of metrics.")
    error: str | None = Field(description="Why it failed, or what its last attempt died of.")
    created_at: datetime
    queued_at: datetime | None
    started_at: datetime | None
    finished_at: datetime | None
    updated_at: datetime


class JobPage(BaseModel):
    """Is one page of jobs, newest first."""

    items: list[JobPublic]
    next_cursor: str | None = Field(description="Give it as `cursor` to get the next page; null on the last.")


class GroupPublic(BaseModel):
    """Shows a group and its jobs."""

    id: str
    jobs: list[JobPublic]


class MetricsPublic(BaseModel):
    """Holds metrics by column; every column has one value per row, null where a row has none."""

    columns: dict[str, list[float | None]]
    rows: int = Field(description="Rows in this answer.")
    total_rows: int = Field(description="Rows after `after_step`, before thinning.")
    last_seq: int = Field(description="Give it as `metrics_after` to a stream to continue behind these rows.")


class EventPublic(_Public):
    """Shows one thing that happened to a job."""

    id: int
    at: datetime
    kind: str
    attempt: int
    message: str
    data: dict[str, Any]


class EventPage(BaseModel):
    """Is one page of events, oldest first."""

    items: list[EventPublic]
    next_after: int | None = Field(description="Give it as `after` to continue; null if there was nothing.")


class LogPublic(_Public):
    """Shows one line of a job's log."""

    id: int
    at: datetime
    attempt: int
    level: str
    message: str


class LogPage(BaseModel):
    """Is one page of log lines, oldest first."""

    items: list[LogPublic]
    next_after: int | None = Field(description="Give it as `after` to continue; null if there was nothing.")


class FilePublic(BaseModel):
    """Shows one file of an artifact."""

    name: str
    size: int = Field(description="Bytes.")
    sha256: str
    url: str = Field(description="Where to download it, below the API's root.")


class CheckpointPublic(BaseModel):
    """Shows a checkpoint."""

    id: str
    job_id: str
    attempt: int
    step: int
    created_at: datetime
    size: int = Field(description="Bytes of all files.")
    files: list[FilePublic]
    archive_url: str = Field(description="Where to download all files as one tar archive.")


class EvaluationPublic(BaseModel):
    """Shows an evaluation."""

    id: str
    job_id: str
    checkpoint_id: str
    state: EvaluationState
    spec: EvaluationSpec
    summary: dict[str, Any] | None = Field(description="Its figures; null until it has succeeded.")
    files: list[FilePublic]
    archive_url: str | None
    error: str | None
    created_at: datetime
    finished_at: datetime | None


class EvaluationCreate(_Request):
    """Asks for an evaluation."""

    checkpoint_id: Id | None = Field(None, description="Which checkpoint to judge; left out, the newest.")
    spec: EvaluationSpec | None = Field(None, description="How to judge it; left out, 1000 episodes of the job's task.")


class TokenCreate(_Request):
    """Asks for a token."""

    owner: Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")] = Field(
        description="Whose jobs it opens."
    )
    name: Annotated[str, StringConstraints(max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")] = Field(
        "", description="What it is for."
    )
    scopes: list[Scope] = Field(
        default_factory=lambda: [Scope.SUBMIT],
        min_length=1,
        max_length=len(Scope),
        description="read: see one's own jobs; submit: also submit and steer them; admin: everybody's, and tokens.",
    )
    expires_in_days: float | None = Field(None, gt=0, le=36_500, description="Days until it expires; null for never.")


class TokenPublic(_Public):
    """Shows a token without its secret."""

    id: str
    name: str
    owner: str
    scopes: list[Scope]
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None


class TokenMade(TokenPublic):
    """Shows a token that was made just now."""

    token: str = Field(description="The secret. It is shown only here: the service keeps nothing but its SHA-256.")


class WorkerPublic(_Public):
    """Shows a worker."""

    id: str
    host: str
    pid: int
    queues: list[str]
    version: str
    started_at: datetime
    heartbeat_at: datetime
    alive: bool = Field(description="Whether it was heard of lately.")
    jobs: list[str] = Field(description="The jobs it holds a lease on.")
