"""Schemas of HTTP requests and answers."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Generic, Literal, Self, TypeVar

from naojobs.matches import MAX_GAMES, MatchRequest
from naojobs.models import DEFAULT_TIME_LIMIT_S, StudyState, TrialState
from naojobs.policies import Registration, check_alias
from naojobs.promotion import MOST_REQUIREMENTS, Requirement
from naojobs.scopes import Scope
from naojobs.states import WorkState
from naojobs.submission import MAX_GROUP_SIZE, EvaluationRequest, GroupRequest, JobRequest
from naojobs.teams import Film
from naojobs.webhooks import MessageType
from naospec import EvaluationSpec, TrainingSpec, formats
from naospec.search import SearchSpec
from naospec.teams import MAX_HALF_S, MAX_PLAYERS
from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    HttpUrl,
    StringConstraints,
    ValidationError,
    model_validator,
)

from naosprint_api import alerts
from naosprint_api.patterns import ALIAS, ID, NAME, PLAIN, REFERENCE, TAG, TEXT

Tag = Annotated[str, StringConstraints(pattern=TAG)]
RESERVED_NAMES = frozenset({"last"})
"""Words that refer to a job in commands, and so are not allowed as names."""


def _current(spec: dict[str, Any]) -> dict[str, Any]:
    """Return a stored training specification as this version accepts it; one that it cannot read stays as it is."""
    try:
        return formats.current(formats.Kind.TRAINING, spec)
    except formats.FormatError:
        return spec


TrainingDocument = Annotated[dict[str, Any], BeforeValidator(_current)]


def _not_reserved(name: str) -> str:
    if name in RESERVED_NAMES:
        raise ValueError(f"{name!r} refers to the newest job in commands; use another name")
    return name


Name = Annotated[
    str,
    StringConstraints(strip_whitespace=True, min_length=1, max_length=200, pattern=NAME),
    AfterValidator(_not_reserved),
]
Id = Annotated[str, StringConstraints(pattern=ID)]

EvaluationState = Literal["queued", "starting", "running", "succeeded", "failed", "cancelled"]


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Public(BaseModel):
    model_config = ConfigDict(from_attributes=True)


class _WorkCreate(_Request):
    """What all work is submitted with; an `Idempotency-Key` is a header."""

    tags: list[Tag] = Field(
        default_factory=list,
        max_length=20,
        description="Tags: letters, digits and ._:/=- (at most 50 characters each).",
    )
    priority: int = Field(5, ge=0, le=9, description="0 to 9; work with a higher priority starts first.")
    not_before: AwareDatetime | None = Field(
        None, description="Earliest start, with its time zone; left out: as soon as a worker is free."
    )
    max_attempts: int = Field(3, ge=1, le=10, description="Attempts that may be lost before it fails.")


class JobCreate(_WorkCreate):
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


class JobPatch(_Request):
    """Changes of a job's name, tags, notes and priority."""

    name: Name | None = Field(None, description="New name, which no other job of the owner has.")
    tags: list[Tag] | None = Field(None, max_length=20, description="All tags from now on.")
    notes: Annotated[str, StringConstraints(max_length=10_000, pattern=TEXT)] | None = Field(
        None, description="Notes: plain text, at most 10,000 characters."
    )
    priority: int | None = Field(None, ge=0, le=9, description="New priority of a job that has not ended.")


class ShareCreate(_Request):
    """Sharing of a job."""

    expires_in_days: float = Field(30, gt=0, le=366, description="Days until the link expires.")


class SharePublic(BaseModel):
    """Read-only token for one job."""

    token: str = Field(description="The secret. It is shown only here.")
    job_id: str
    expires_at: datetime


Item = TypeVar("Item", bound=BaseModel)


class Page(BaseModel, Generic[Item]):
    """Part of a list."""

    items: list[Item]
    next_cursor: str | None = Field(description="Give it as `cursor` to get the next page; null on the last.")

    @classmethod
    def of(cls, items: list[Item], limit: int) -> Self:
        """Return the first `limit` items; one more says that there is a next page, which the last one's id finds."""
        last: Any = items[limit - 1] if len(items) > limit else None
        return cls(items=items[:limit], next_cursor=last and last.id)


class PagePublic(BaseModel):
    """Address of a page that can be opened without a token for a few minutes."""

    url: str = Field(description="Where the page is, below the API's root.")
    expires_at: datetime


class GroupCreate(_Request):
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


class StudyCreate(_Request):
    """Search for settings to start."""

    name: Name | None = Field(None, description="Name; left out: made of the job's.")
    job: JobCreate = Field(description="What all trials have in common.")
    search: SearchSpec = Field(description="What to vary and to optimize, how to sample and when to prune.")

    @model_validator(mode="after")
    def _starts_here(self) -> Self:
        if self.search.elsewhere and self.job.not_before is not None:
            raise ValueError("job.not_before: trials that run elsewhere start when they are taken; leave it out")
        return self


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


class JobPublic(_Public):
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


class EventPublic(_Public):
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


class LogPublic(_Public):
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


class FilePublic(BaseModel):
    """File of an artifact."""

    name: str
    size: int = Field(description="Bytes.")
    sha256: str
    url: str = Field(description="Where to download it, below the API's root.")


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


class EvaluationCreate(_WorkCreate):
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


TeamText = Annotated[str, StringConstraints(min_length=1, max_length=500, pattern=PLAIN)]


class MatchCreate(_WorkCreate):
    """Match to play."""

    teams: tuple[TeamText, TeamText] = Field(
        description="Both teams: `example`, `example:walk=POLICY,kick=POLICY,getup=POLICY` with bundled or registered "
        "policies in place of some, or the name of an uploaded team."
    )
    games: int = Field(20, ge=1, le=MAX_GAMES, description="Games; the sides are swapped from game to game.")
    players: int = Field(3, ge=1, le=MAX_PLAYERS, description="Players of each team.")
    half_s: float = Field(300.0, ge=1.0, le=MAX_HALF_S, description="Seconds of play of a half.")
    gate: bool = Field(
        False, description="Whether to end as soon as a sequential test has decided if the first team does not lose."
    )
    film: Film = Field(
        "goals",
        description="What is filmed of each game: nothing (`off`), what led to goals, or all of it. Workers without "
        "imageio-ffmpeg make no film.",
    )

    def request(self) -> MatchRequest:
        """Return the match for `naojobs.matches`."""
        return MatchRequest(**self.model_dump())


class GamePublic(_Public):
    """Game of a match that is over."""

    number: int
    goals: tuple[int, int]
    lost: list[dict[str, Any]] = Field(description="Players that crashed, hung or never came, with the reasons.")
    finished_at: datetime
    log: FilePublic = Field(description="Its log: where all robots and the ball were, 25 times a second.")
    film: FilePublic | None = Field(None, description="Its film (MP4); null if none was made.")


class MatchEventPublic(_Public):
    """Event in the history of a match, or line of its log."""

    id: int
    at: datetime
    kind: str = Field(description="Kind of an event, as for jobs; of a line its level: info, warning or error.")
    attempt: int
    message: str


class MatchEventPage(BaseModel):
    """Page of a match's history, oldest first."""

    items: list[MatchEventPublic]
    next_after: int | None = Field(description="Value of `after` for the next page; null if the page is empty.")


class MatchPublic(BaseModel):
    """Match of two teams."""

    id: str
    owner: str
    state: EvaluationState
    teams: tuple[str, str]
    games: int = Field(description="Games to play.")
    players: int
    half_s: float
    gate: bool
    film: Film = Field(description="What is filmed of each game: nothing, what led to goals, or all of it.")
    played: int = Field(description="Games that are over.")
    wins: int = Field(description="Games that the first team has won.")
    draws: int
    losses: int
    tags: list[str]
    priority: int
    not_before: datetime | None = Field(description="When its next attempt may begin; null: at any time.")
    waiting_reason: str | None = Field(
        description="Why no worker can take the queued match; null if a worker can, and in all other states."
    )
    attempt: int = Field(description="Number of claims by workers.")
    failures: int = Field(description="Attempts lost in a row since the last game that is over.")
    max_attempts: int = Field(description="The match fails when failures reaches it.")
    worker: str | None = Field(description="Id of the worker that leases it.")
    stalled_since: datetime | None
    cancel_requested: bool
    error: str | None = Field(description="Why it failed, or why its last attempt was lost.")
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None


class MatchDetails(MatchPublic):
    """Match with its games and results."""

    summary: dict[str, Any] | None = Field(description="Results of the games so far; null before the first is over.")
    table: list[tuple[str, str, str]] = Field(description="The same in words: what, the first team's, the second's.")
    sums: list[str] = Field(description="Wins and goal difference with their intervals, in words.")
    live: dict[str, Any] | None = Field(
        description="A running game, about a second ago; null if none runs. `clip` is the log of its last two seconds "
        "in base64."
    )
    finished: list[GamePublic] = Field(description="The games that are over, by number.")


class MatchPage(Page[MatchPublic]):
    """Page of matches, newest first."""


class StandingPublic(_Public):
    """Place of a team in the league."""

    name: str
    rating: float = Field(description="Elo rating, fitted to all games; 1500 is average.")
    wins: int
    draws: int
    losses: int
    goals: tuple[int, int] = Field(description="Its own goals and those against it.")


class TeamPublic(_Public):
    """Uploaded team."""

    id: str
    owner: str
    name: str
    size: int = Field(description="Bytes of its archive.")
    created_at: datetime


class TeamPage(Page[TeamPublic]):
    """Page of uploaded teams, oldest first."""


class TrialPublic(_Public):
    """Trial of a study."""

    number: int
    job_id: str | None = Field(
        description="Null if it runs elsewhere, if its settings were refused or if its job was deleted."
    )
    state: TrialState
    params: dict[str, Any] = Field(description="The settings that were chosen.")
    values: list[float] | None = Field(
        description="Values of the objectives; null until it is complete, or reported from elsewhere."
    )
    asked_at: datetime | None = Field(description="When it was taken to run it elsewhere.")
    error: str | None = Field(description="Why it was pruned or has failed.")
    created_at: datetime
    finished_at: datetime | None


class TrialAsked(TrialPublic):
    """Trial to run elsewhere."""

    spec: dict[str, Any] = Field(description="The training with the settings that were chosen.")


class TrialTell(_Request):
    """Result of a trial that has run elsewhere."""

    values: list[FiniteFloat] | None = Field(None, max_length=4, description="Values, in the order of the objectives.")
    error: Annotated[str, StringConstraints(min_length=1, max_length=2000, pattern=TEXT)] | None = Field(
        None, description="Why it has no values."
    )

    @model_validator(mode="after")
    def _one_result(self) -> Self:
        if (self.values is None) == (self.error is None):
            raise ValueError("values: give values or an error")
        return self


class StudyExtend(_Request):
    """Extension of a study."""

    trials: int = Field(ge=1, le=1000, description="Number of trials in all.")


class StudyPublic(_Public):
    """Study: a search for the best settings of a training."""

    id: str = Field(description="Also the group of its jobs.")
    name: str
    owner: str
    state: StudyState
    error: str | None = Field(description="Why it failed.")
    spec: dict[str, Any] = Field(description="Its search, with everything that the task decides.")
    job: dict[str, Any] = Field(description="What all trials have in common.")
    importance: dict[str, dict[str, float]] = Field(
        description="Importance of each setting by objective (PED-ANOVA); empty for fewer than 5 complete trials."
    )
    created_at: datetime
    finished_at: datetime | None


class StudyDetails(StudyPublic):
    """Study with its trials."""

    trials: list[TrialPublic]
    best: list[int] = Field(description="The best complete trial; with several objectives, those of the Pareto front.")


class StudyPage(Page[StudyPublic]):
    """Page of studies, newest first."""


Alias = Annotated[str, StringConstraints(pattern=ALIAS), AfterValidator(check_alias)]


class VersionCreate(_Request):
    """Version of a policy to register."""

    job_id: Id = Field(description="Job whose checkpoint it is.")
    checkpoint_id: Id | None = Field(None, description="Which checkpoint; left out, the job's newest.")
    aliases: list[Alias] = Field(
        default_factory=list, max_length=20, description="Aliases to point at the new version, such as best or match."
    )
    notes: Annotated[str, StringConstraints(max_length=10_000, pattern=TEXT)] = Field(
        "", description="Notes: plain text, at most 10,000 characters."
    )

    def registration(self) -> Registration:
        """Return the version for `naojobs.policies`."""
        return Registration(self.job_id, self.checkpoint_id, self.aliases, self.notes)


class AliasSet(_Request):
    """Version that an alias is to name."""

    version: int = Field(ge=1, le=2**31 - 1, description="Number of the version.")


class RequirementsSet(_Request):
    """What an alias requires."""

    requirements: list[Requirement] = Field(
        max_length=MOST_REQUIREMENTS, description="All of them have to be met; empty for none."
    )


class PolicyCard(BaseModel):
    """Version of a registered policy, or a bundled policy: its training and its evaluation."""

    name: str
    reference: str = Field(description="What names exactly this version: NAME@VERSION, or a bundled policy's name.")
    owner: str | None = Field(description="Null for bundled policies, which are read-only.")
    version: int = Field(description="Number of the version, from 1.")
    aliases: list[str] = Field(description="Aliases of this version; `latest` is the newest.")
    created_at: datetime | None = Field(description="When it was registered; null for bundled policies.")
    job_id: str | None = Field(description="Job whose checkpoint it is; null for bundled policies.")
    checkpoint_id: str | None = Field(description="Null for bundled policies.")
    evaluation_id: str | None = Field(
        description="Evaluation of the results: of those of this checkpoint, the newest with the most episodes."
    )
    spec_sha256: str = Field(description="SHA-256 of the specification.")
    parent_policy: str | None = Field(description="Policy that its job started from, by reference.")
    notes: str = ""
    sentence: str = Field("", description="What it does; of registered policies the first line of the notes.")
    summary: str = Field(description="The most important results in a line; empty for registered policies.")
    robot: str
    task: str
    steps: int = Field(description="Environment steps of its training, over all jobs of its lineage.")
    training_s: float = Field(description="Seconds of training.")
    episodes: int = Field(description="Episodes of its evaluation; 0 if it has not been evaluated.")
    results: list[dict[str, Any]] = Field(description="Results of the evaluation, with titles and units.")
    headline: list[str] = Field(description="Names of the most important results.")
    tables: list[dict[str, Any]] = Field(description="Results that vary with a quantity.")
    evaluation: dict[str, Any] | None = Field(description="Specification of the evaluation.")
    lineage: list[dict[str, Any]] = Field(description="The jobs behind it, first to last, with their curves.")
    motion: dict[str, dict[str, float]] = Field(
        default={}, description="Peaks of joint speed, foot force and contact depth, running and standing."
    )
    robustness: list[dict[str, Any]] = Field(default=[], description="Headline results under each disturbance.")
    ranges: dict[str, Any] | None = Field(
        default=None,
        description="The range of each disturbance in which few enough episodes fail, by `naosprint examine`.",
    )


class PolicyPage(Page[PolicyCard]):
    """Page of policies, or of the versions of one."""


class PolicyDetails(PolicyCard):
    """Policy with the specification that it was trained by, and its files."""

    spec: TrainingDocument = Field(description="Specification of the last job of the lineage.")
    files: list[FilePublic] = Field(description="Files of its checkpoint.")
    requirements: dict[str, list[Requirement]] = Field(
        default_factory=dict, description="By alias, what a version needs before the alias names it."
    )


class TokenCreate(_Request):
    """Token to make."""

    owner: Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=PLAIN)] = Field(
        description="User whose jobs the token gives access to."
    )
    name: Annotated[str, StringConstraints(max_length=200, pattern=PLAIN)] = Field(
        "", description="Purpose of the token."
    )
    scopes: list[Scope] = Field(
        default_factory=lambda: [Scope.SUBMIT],
        min_length=1,
        max_length=len(Scope),
        description="read: see one's own jobs; submit: also submit and control them; metrics: the "
        "service's metrics only; admin: all jobs, and tokens.",
    )
    expires_in_days: float | None = Field(None, gt=0, le=36_500, description="Days until it expires; null for never.")


class TokenPublic(_Public):
    """Token without its secret."""

    id: str
    name: str
    owner: str
    scopes: list[Scope]
    job_id: str | None = Field(description="The only job that it gives access to; null for all jobs of the owner.")
    parent_id: str | None = Field(
        description="The token that it was made with and is revoked with; null if an administrator made it."
    )
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None


class TokenPage(Page[TokenPublic]):
    """Page of tokens, oldest first."""


class TokenMade(TokenPublic):
    """New token with its secret."""

    token: str = Field(description="The secret. It is shown only here: the service stores only its SHA-256.")


def _address(text: str) -> str:
    if alerts.is_alert(text):
        alerts.check_address(text)
        return text
    try:
        url = HttpUrl(text)
    except ValidationError as error:
        raise ValueError(error.errors()[0]["msg"]) from None
    if url.username or url.password:
        raise ValueError("expected an address without user and password; the signature identifies the sender")
    return str(url)


class WebhookCreate(_Request):
    """Webhook to register."""

    url: Annotated[str, StringConstraints(min_length=1, max_length=2083), AfterValidator(_address)] = Field(
        description="Where messages are sent: by POST to http or https, without redirects; or as text for people "
        "through a service, at an address of apprise such as mailtos://, slack://, discord://, tgram:// or ntfys://.",
        json_schema_extra={"format": "uri"},
    )
    events: list[MessageType] = Field(
        default_factory=lambda: list(MessageType),
        min_length=1,
        max_length=len(MessageType),
        description="Types of messages to receive; left out: all.",
    )


class WebhookPublic(_Public):
    """Webhook without its secret."""

    id: str
    owner: str
    url: Annotated[str, AfterValidator(alerts.shown_address)] = Field(
        description="Its address; of one that gets alerts only the service and host, since the rest is secret."
    )
    events: list[MessageType]
    disabled_at: datetime | None = Field(
        description="When its receiver answered 410 Gone, after which nothing is sent; null if it did not."
    )
    created_at: datetime


class WebhookPage(Page[WebhookPublic]):
    """Page of webhooks, oldest first."""


class WebhookMade(WebhookPublic):
    """New webhook with its secret."""

    secret: str = Field(
        description="Key of the Standard Webhooks signatures. It is shown only here. Empty for alerts: they have none."
    )


class DeliveryPublic(_Public):
    """Message to a webhook."""

    id: str = Field(description="The header webhook-id, the same in every attempt.")
    type: MessageType
    data: dict[str, Any]
    attempts: int
    next_at: datetime | None = Field(description="When the next attempt is due; null once it is delivered or given up.")
    delivered_at: datetime | None
    error: str | None = Field(description="Why the last attempt failed; null if it did not.")
    created_at: datetime


class DeliveryPage(Page[DeliveryPublic]):
    """Page of messages to a webhook, newest first."""


class WorkerPublic(_Public):
    """Worker."""

    id: str
    host: str
    pid: int
    queues: list[str] = Field(description="Its simulators.", json_schema_extra={"deprecated": True})
    tasks: dict[str, int] = Field(description="Version by name of each task that it can run.")
    robots: list[str]
    simulators: list[str]
    algorithms: list[str]
    version: str
    disk_free_bytes: int | None = Field(description="Free space on the disk of its working folders.")
    drained_at: datetime | None = Field(description="Since when it claims no work at an administrator's request.")
    started_at: datetime
    heartbeat_at: datetime
    alive: bool = Field(description="Whether its last heartbeat is recent.")
    jobs: list[str] = Field(description="Its leased jobs.")
    evaluations: list[str] = Field([], description="Its leased evaluations.")
    matches: list[str] = Field([], description="Its leased matches.")


class WorkerDrain(_Request):
    """How to drain a worker."""

    requeue: bool = Field(
        False,
        description="Whether its trainings write a checkpoint and wait for another worker instead of ending here.",
    )


class UsagePublic(_Public):
    """What an owner's work has used in a period."""

    owner: str
    cpu_s: float = Field(description="Seconds of processors that attempts were busy.")
    run_s: float = Field(description="Seconds that attempts took.")


class WorkerPage(Page[WorkerPublic]):
    """Page of workers, by id."""
