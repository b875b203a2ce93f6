"""SQLAlchemy models of all tables."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import date, datetime, timedelta
from enum import StrEnum
from typing import Any, ClassVar, TypeAlias

from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    ColumnElement,
    Date,
    DateTime,
    Double,
    Enum,
    ForeignKey,
    ForeignKeyConstraint,
    Identity,
    Index,
    Integer,
    MetaData,
    ScalarSelect,
    Sequence,
    String,
    Text,
    UniqueConstraint,
    and_,
    func,
    or_,
    select,
    text,
)
from sqlalchemy.dialects.postgresql import ARRAY, JSONB
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column, validates

from naojobs.errors import public
from naojobs.states import EVALUATION_STATES, LEASED, WorkState

DEFAULT_TIME_LIMIT_S = 21_600.0
"""Seconds that an evaluation may take unless its request sets another limit."""


class Base(DeclarativeBase):
    """Declarative base that names every constraint, so that migrations can drop them."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s",
            "pk": "pk_%(table_name)s",
        },
    )
    type_annotation_map: ClassVar[dict[Any, Any]] = {
        date: Date,
        datetime: DateTime(timezone=True),
        dict[str, Any]: JSONB,
        list[str]: ARRAY(Text),
        float: Double,
        str: Text,
    }


class WorkKind(StrEnum):
    """Kind of work that workers do."""

    JOB = "job"
    """A training with the evaluation at its end."""
    EVALUATION = "evaluation"
    """An evaluation that a user requested."""
    MATCH = "match"
    """A match of two teams."""


def _work_checks(states: Iterable[WorkState]) -> tuple[CheckConstraint, ...]:
    """Return the constraints of a table whose rows may have one of `states`."""
    known, leased = (", ".join(f"'{state}'" for state in sorted(group)) for group in (states, LEASED))
    return (
        CheckConstraint(f"state IN ({known})", name="state_known"),
        CheckConstraint("priority BETWEEN 0 AND 9", name="priority_range"),
        CheckConstraint(f"(state IN ({leased})) = (lease_owner IS NOT NULL)", name="lease_fits_state"),
    )


def _waiting_index(table: str) -> Index:
    """Return the index through which free workers find the next work of `table`."""
    columns = ("simulator", text("priority DESC"), "queued_at")
    return Index(f"ix_{table}_waiting", *columns, postgresql_where=text("state = 'queued'"))


def _lease_index(table: str) -> Index:
    return Index(f"ix_{table}_leases", "lease_expires_at", postgresql_where=text("lease_owner IS NOT NULL"))


class Work:
    """Columns that all work shares: what it needs of a worker, its state and its lease."""

    kind: ClassVar[WorkKind]

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    spec: Mapped[dict[str, Any]]
    """A `naospec.TrainingSpec`, a `naospec.EvaluationSpec` or a `naojobs.teams.MatchSpec`."""
    tags: Mapped[list[str]] = mapped_column(server_default=text("'{}'"))
    idempotency_key: Mapped[str | None] = mapped_column(String(200))
    idempotency_digest: Mapped[str | None] = mapped_column(String(64))
    """SHA-256 of the request that had the key, to distinguish a repeated request from another one."""
    priority: Mapped[int] = mapped_column(Integer, server_default=text("5"))
    """0 to 9; work with a higher priority is claimed first."""
    task: Mapped[str] = mapped_column(String(100))
    """Name and version of the task, names of robot, simulator and algorithm that a worker must have."""
    task_version: Mapped[int] = mapped_column(Integer)
    robot: Mapped[str] = mapped_column(String(100))
    simulator: Mapped[str] = mapped_column(String(100))
    """Also the name of the broker's queue for its wake-up message."""
    algorithm: Mapped[str] = mapped_column(String(100))
    """Empty for a match, which learns nothing."""
    state: Mapped[WorkState] = mapped_column(
        Enum(WorkState, native_enum=False, length=20, values_callable=lambda members: [str(m) for m in members])
    )
    attempt: Mapped[int] = mapped_column(Integer, server_default=text("0"))
    """Number of claims. It never decreases: it fences off the writes of a worker that lost its lease."""
    failures: Mapped[int] = mapped_column(Integer, server_default=text("0"))
    """Number of attempts that ended by a lost worker or child process since the last submit, retry or new
    checkpoint.
    """
    postponed: Mapped[int] = mapped_column(Integer, server_default=text("0"))
    """Number of attempts in a row that ended because a service was unavailable."""
    not_before: Mapped[datetime | None]
    """When the next attempt may begin: after a postponed one, or, with none postponed, as the user asked."""
    max_attempts: Mapped[int] = mapped_column(Integer, server_default=text("3"))
    """Number of failures at which the work fails for good."""
    lease_owner: Mapped[str | None] = mapped_column(String(200))
    lease_generation: Mapped[str | None] = mapped_column(String(80))
    """Generation of the database that gave the lease, see `generation`."""
    lease_expires_at: Mapped[datetime | None]
    """By the clock of leases, see `lease_time`."""
    heartbeat_at: Mapped[datetime | None]
    stalled_since: Mapped[datetime | None]
    """Since when leased work has made no step, once its worker has noticed; none while it makes steps."""
    cancel_requested: Mapped[bool] = mapped_column(server_default=text("false"))
    error: Mapped[str | None]
    """Why it failed, or why its last attempt was lost."""
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    queued_at: Mapped[datetime | None]
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    updated_at: Mapped[datetime] = mapped_column(server_default=func.now())

    @validates("error")
    def _public(self, _name: str, error: str | None) -> str | None:
        return None if error is None else public(error)


class Job(Work, Base):
    """A training with the evaluation of its final policy."""

    __tablename__ = "jobs"
    kind = WorkKind.JOB

    name: Mapped[str] = mapped_column(String(200))
    owner: Mapped[str] = mapped_column(String(200))
    notes: Mapped[str] = mapped_column(server_default=text("''"))
    """Text of the user about the job."""
    evaluation: Mapped[dict[str, Any] | None] = mapped_column(JSONB(none_as_null=True))
    """A `naospec.EvaluationSpec` for the evaluation at the end; null for none."""
    parent_job_id: Mapped[str | None] = mapped_column(ForeignKey("jobs.id", ondelete="SET NULL"), index=True)
    parent_checkpoint_id: Mapped[str | None] = mapped_column(
        ForeignKey("checkpoints.id", ondelete="SET NULL", use_alter=True),
        index=True,
    )
    parent_policy: Mapped[str | None] = mapped_column(String(130))
    """The policy by name that it was submitted to start from, with its version; null if it was none."""
    needs_policy: Mapped[bool] = mapped_column(server_default=text("false"))
    """Whether it was submitted with a parent: it never starts without a policy, even when the parent has been
    deleted.
    """
    pruned: Mapped[str | None]
    """Why a study ended it early; null if none did."""
    yields_to: Mapped[str | None] = mapped_column(String(200))
    """What its worker was asked to requeue it for: the id of waiting work, or its own worker's if that is drained."""
    software: Mapped[dict[str, Any]] = mapped_column(server_default=text("'{}'"))
    """Versions by package of the last attempt, with `python` and, if it is known, the `commit` of the source."""
    group_id: Mapped[str | None] = mapped_column(String(64), index=True)
    progress_step: Mapped[int] = mapped_column(BigInteger, server_default=text("0"))
    total_steps: Mapped[int] = mapped_column(BigInteger)
    began_step: Mapped[int] = mapped_column(BigInteger, server_default=text("0"))
    """Step at which the last attempt began."""
    last_batch: Mapped[str | None] = mapped_column(String(64))
    """Id of the last batch of records, so that a repeated write adds nothing twice."""
    row_count: Mapped[int] = mapped_column(BigInteger, server_default=text("0"))
    """Number of rows of metrics, logs and events that workers have written."""
    latest_metrics: Mapped[dict[str, Any]] = mapped_column(server_default=text("'{}'"))
    """The newest metrics row, so that a list of jobs needs no join."""
    changed_in: Mapped[int] = mapped_column(BigInteger, server_default=text("pg_current_xact_id()::text::bigint"))
    """Transaction that has set `updated_at` last; a trigger writes it. Followers compare it with snapshots, since a
    transaction that began early may be committed late.
    """

    __table_args__ = (
        *_work_checks(WorkState),
        UniqueConstraint("owner", "idempotency_key"),
        Index("ix_jobs_owner_id", "owner", text("id DESC")),
        Index("ix_jobs_updated_at", "updated_at"),
        Index("ix_jobs_changed_in", "changed_in", "id"),
        Index("ix_jobs_tags", "tags", postgresql_using="gin"),
        _waiting_index("jobs"),
        _lease_index("jobs"),
    )

    @property
    def job_id(self) -> str:
        """Id of the job that this work belongs to: its own."""
        return self.id

    @property
    def pausing(self) -> bool:
        """Whether its worker was asked to write a checkpoint and stop."""
        return self.state is WorkState.PAUSING


METRICS_SEQ: Sequence = Sequence("metrics_seq", metadata=Base.metadata)


class MetricsRecord(Base):
    """Row of training metrics, written once per PPO update."""

    __tablename__ = "metrics"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    step: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    """Environment steps since the start of the job."""
    attempt: Mapped[int] = mapped_column(Integer)
    seq: Mapped[int] = mapped_column(BigInteger, METRICS_SEQ, server_default=METRICS_SEQ.next_value())
    """Order of writing; a follower resumes after the last one it has read."""
    time_s: Mapped[float | None]
    """Seconds of training."""
    values: Mapped[dict[str, Any]]

    __table_args__ = (Index("ix_metrics_job_id_seq", "job_id", "seq"),)


class Event(Base):
    """Event in the history of a job."""

    __tablename__ = "events"

    id: Mapped[int] = mapped_column(BigInteger, Identity(), primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    at: Mapped[datetime] = mapped_column(server_default=func.now())
    kind: Mapped[str] = mapped_column(String(40))
    attempt: Mapped[int] = mapped_column(Integer)
    message: Mapped[str]
    data: Mapped[dict[str, Any]] = mapped_column(server_default=text("'{}'"))

    __table_args__ = (Index("ix_events_job_id_id", "job_id", "id"),)


class Log(Base):
    """Line of a job's log."""

    __tablename__ = "logs"

    id: Mapped[int] = mapped_column(BigInteger, Identity(), primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    attempt: Mapped[int] = mapped_column(Integer)
    at: Mapped[datetime] = mapped_column(server_default=func.now())
    level: Mapped[str] = mapped_column(String(10))
    message: Mapped[str]

    __table_args__ = (Index("ix_logs_job_id_id", "job_id", "id"),)


class Checkpoint(Base):
    """Checkpoint whose files are all in the store."""

    __tablename__ = "checkpoints"

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    attempt: Mapped[int] = mapped_column(Integer)
    step: Mapped[int] = mapped_column(BigInteger)
    key: Mapped[str]
    """Location of its files in the store: `key/name`."""
    manifest: Mapped[dict[str, Any]]
    """A `naojobs.store.StoreManifest`."""
    size: Mapped[int] = mapped_column(BigInteger, server_default=text("0"))
    """Bytes of its files."""
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())

    __table_args__ = (UniqueConstraint("job_id", "step", "attempt"), UniqueConstraint("key"))


class Evaluation(Work, Base):
    """Evaluation of one checkpoint."""

    __tablename__ = "evaluations"
    kind = WorkKind.EVALUATION

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), index=True)
    checkpoint_id: Mapped[str] = mapped_column(ForeignKey("checkpoints.id", ondelete="CASCADE"), index=True)
    time_limit_s: Mapped[float] = mapped_column(server_default=text(f"{DEFAULT_TIME_LIMIT_S:.0f}"))
    """Seconds that one attempt may take; the evaluation fails when they are over."""
    report: Mapped[str | None] = mapped_column(String(20))
    """Report that was requested with it: film, pictures or off; none for what the worker is set to."""
    summary: Mapped[dict[str, Any] | None] = mapped_column(JSONB(none_as_null=True))
    """Metrics over all episodes; they count once it has succeeded."""
    key: Mapped[str | None]
    manifest: Mapped[dict[str, Any] | None] = mapped_column(JSONB(none_as_null=True))
    """A `naojobs.store.StoreManifest`."""
    size: Mapped[int] = mapped_column(BigInteger, server_default=text("0"))
    """Bytes of its files."""

    __table_args__ = (
        *_work_checks(EVALUATION_STATES),
        CheckConstraint(
            "state <> 'succeeded' OR (summary IS NOT NULL AND key IS NOT NULL AND manifest IS NOT NULL)",
            name="succeeded_has_result",
        ),
        UniqueConstraint("job_id", "idempotency_key"),
        _waiting_index("evaluations"),
        _lease_index("evaluations"),
    )


class Match(Work, Base):
    """Match of two teams: a number of games on the league's server."""

    __tablename__ = "matches"
    kind = WorkKind.MATCH

    owner: Mapped[str] = mapped_column(String(200))
    summary: Mapped[dict[str, Any] | None] = mapped_column(JSONB(none_as_null=True))
    """Results of the games so far, as `naosprint.matches.results.match_results` returns them."""
    live: Mapped[dict[str, Any] | None] = mapped_column(JSONB(none_as_null=True))
    """A moment of a running game, of about a second ago."""
    size: Mapped[int] = mapped_column(BigInteger, server_default=text("0"))
    """Bytes of the logs of its games."""
    row_count: Mapped[int] = mapped_column(BigInteger, server_default=text("0"))
    """Rows of its events and lines."""

    __table_args__ = (
        *_work_checks(EVALUATION_STATES),
        UniqueConstraint("owner", "idempotency_key"),
        Index("ix_matches_owner_id", "owner", text("id DESC")),
        _waiting_index("matches"),
        _lease_index("matches"),
    )

    @property
    def job_id(self) -> str:
        """Id under which its files are and followers find it: its own."""
        return self.id


class MatchEvent(Base):
    """Event in the history of a match, or line of its log."""

    __tablename__ = "match_events"

    id: Mapped[int] = mapped_column(BigInteger, Identity(), primary_key=True)
    match_id: Mapped[str] = mapped_column(ForeignKey("matches.id", ondelete="CASCADE"))
    at: Mapped[datetime] = mapped_column(server_default=func.now())
    kind: Mapped[str] = mapped_column(String(40))
    """Kind of an event, as for jobs, or level of a line: info, warning, error."""
    attempt: Mapped[int] = mapped_column(Integer)
    message: Mapped[str]

    __table_args__ = (Index("ix_match_events_match_id_id", "match_id", "id"),)


class MatchGame(Base):
    """Game of a match that is over."""

    __tablename__ = "games"

    match_id: Mapped[str] = mapped_column(ForeignKey("matches.id", ondelete="CASCADE"), primary_key=True)
    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    """Number from 1."""
    goals: Mapped[list[int]] = mapped_column(ARRAY(Integer))
    """Goals of both teams."""
    lost: Mapped[list[dict[str, Any]]] = mapped_column(JSONB)
    """Players that crashed, hung or never came, with the reasons."""
    key: Mapped[str]
    """Location of its log in the store: `key/name`."""
    manifest: Mapped[dict[str, Any]]
    """A `naojobs.store.StoreManifest`."""
    finished_at: Mapped[datetime] = mapped_column(server_default=func.now())


class TeamRecord(Base):
    """Team that a user has uploaded: a folder with the command that starts an agent."""

    __tablename__ = "teams"

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    owner: Mapped[str] = mapped_column(String(200))
    name: Mapped[str] = mapped_column(String(60))
    key: Mapped[str]
    """Location of its archive in the store: `key/name`."""
    manifest: Mapped[dict[str, Any]]
    """A `naojobs.store.StoreManifest`."""
    size: Mapped[int] = mapped_column(BigInteger)
    """Bytes of its archive."""
    image: Mapped[str | None] = mapped_column(String(255))
    """Container image that its agents run in."""
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())

    __table_args__ = (UniqueConstraint("owner", "name"),)


class StudyState(StrEnum):
    """State of a study."""

    RUNNING = "running"
    """Trials wait, run, or are to be started."""
    FINISHED = "finished"
    """All trials have ended."""
    FAILED = "failed"
    """Too many trials failed in a row."""
    CANCELLED = "cancelled"
    """Ended at a user's request."""


class TrialState(StrEnum):
    """State of a trial, as the sampler sees it."""

    RUNNING = "running"
    """Its job is open."""
    COMPLETE = "complete"
    """Its job succeeded, with a value for each objective."""
    PRUNED = "pruned"
    """Its job was ended early because it fell behind."""
    FAILED = "failed"
    """It has no values: its job failed, or was cancelled or deleted by a user."""


def _known(column: str, states: Iterable[StrEnum]) -> CheckConstraint:
    return CheckConstraint(f"{column} IN ({', '.join(repr(str(state)) for state in states)})", name=f"{column}_known")


class Study(Base):
    """Search for the best settings of a training. Its group of jobs has its id."""

    __tablename__ = "studies"

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    name: Mapped[str] = mapped_column(String(200))
    owner: Mapped[str] = mapped_column(String(200))
    spec: Mapped[dict[str, Any]]
    """A `naospec.search.SearchSpec` whose objectives have directions."""
    job: Mapped[dict[str, Any]]
    """What all trials have in common: a `naospec.TrainingSpec`, a `naospec.EvaluationSpec` or null, tags, priority and
    max_attempts.
    """
    state: Mapped[StudyState] = mapped_column(
        Enum(StudyState, native_enum=False, length=20, values_callable=lambda members: [str(m) for m in members])
    )
    error: Mapped[str | None]
    importance: Mapped[dict[str, Any]] = mapped_column(server_default=text("'{}'"))
    """Importance of each setting by objective; each objective's add up to 1."""
    extended_at: Mapped[int] = mapped_column(Integer, server_default=text("0"))
    """Number of trials that it had when it was extended last; failures before do not end it."""
    idempotency_key: Mapped[str | None] = mapped_column(String(200))
    idempotency_digest: Mapped[str | None] = mapped_column(String(64))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    finished_at: Mapped[datetime | None]

    __table_args__ = (
        _known("state", StudyState),
        UniqueConstraint("owner", "idempotency_key"),
        Index("ix_studies_running", "id", postgresql_where=text("state = 'running'")),
    )


class Trial(Base):
    """Trial of a study: one choice of settings, and the job that trains with it."""

    __tablename__ = "trials"

    study_id: Mapped[str] = mapped_column(ForeignKey("studies.id", ondelete="CASCADE"), primary_key=True)
    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    """Number of the trial in the sampler's own tables, from 0."""
    job_id: Mapped[str | None] = mapped_column(ForeignKey("jobs.id", ondelete="SET NULL"), unique=True)
    """Null if it runs elsewhere, if the choice could not be submitted, or if the job was deleted."""
    state: Mapped[TrialState] = mapped_column(
        Enum(TrialState, native_enum=False, length=20, values_callable=lambda members: [str(m) for m in members])
    )
    params: Mapped[dict[str, Any]]
    values: Mapped[list[float] | None] = mapped_column(ARRAY(Double))
    """Values of the objectives, in their order; null until it is complete or they are reported from elsewhere."""
    asked_at: Mapped[datetime | None]
    """When a client took it to run it elsewhere; null before."""
    error: Mapped[str | None]
    """Why it was pruned or has failed."""
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    finished_at: Mapped[datetime | None]

    __table_args__ = (_known("state", TrialState),)


class Webhook(Base):
    """Address that receives messages about the jobs, evaluations and studies of its owner."""

    __tablename__ = "webhooks"

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    owner: Mapped[str] = mapped_column(String(200), index=True)
    token_id: Mapped[str | None] = mapped_column(ForeignKey("tokens.id", ondelete="CASCADE"), index=True)
    """The token that it was made with, and ends with; null for one that was made before this was kept."""
    url: Mapped[str]
    events: Mapped[list[str]]
    """Types of messages that it receives."""
    secret: Mapped[str]
    """Key of the signatures. Signing needs the key itself, so it is stored; the API shows it once. Empty for alerts."""
    disabled_at: Mapped[datetime | None]
    """When its receiver answered 410 Gone or its token ended; nothing is sent to it any more."""
    failures: Mapped[int] = mapped_column(Integer, server_default=text("0"))
    """Number of times in a row that sending to it failed, and when the next attempt may begin."""
    not_before: Mapped[datetime | None]
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())


class Delivery(Base):
    """Message to a webhook, written in the transaction of the change that it reports."""

    __tablename__ = "deliveries"

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    """Id of the message, the same in every attempt."""
    webhook_id: Mapped[str] = mapped_column(ForeignKey("webhooks.id", ondelete="CASCADE"))
    type: Mapped[str] = mapped_column(String(40))
    data: Mapped[dict[str, Any]]
    attempts: Mapped[int] = mapped_column(Integer, server_default=text("0"))
    next_at: Mapped[datetime | None] = mapped_column(server_default=func.now())
    """When the next attempt is due; null once it is delivered or given up."""
    delivered_at: Mapped[datetime | None]
    error: Mapped[str | None]
    """Why the last attempt failed; null if it did not."""
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())

    __table_args__ = (
        Index("ix_deliveries_webhook_id_id", "webhook_id", "id"),
        Index("ix_deliveries_due", "next_at", postgresql_where=text("next_at IS NOT NULL")),
    )


class PolicyRecord(Base):
    """Registered policy of a user; each version is a checkpoint of one of the user's jobs."""

    __tablename__ = "policies"

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    owner: Mapped[str] = mapped_column(String(200))
    name: Mapped[str] = mapped_column(String(60))
    last_number: Mapped[int] = mapped_column(Integer, server_default=text("0"))
    """Number of the last version that was registered; numbers are not used again, so that the row stays when the last
    version is deleted. Without versions there is no such policy to users.
    """
    requirements: Mapped[dict[str, Any]] = mapped_column(JSONB, server_default=text("'{}'"))
    """By alias, what versions need: lists of `naojobs.promotion.Requirement`."""
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())

    __table_args__ = (UniqueConstraint("owner", "name"),)


class PolicyVersion(Base):
    """Version of a registered policy. Its checkpoint cannot be deleted while it exists."""

    __tablename__ = "policy_versions"

    policy_id: Mapped[str] = mapped_column(ForeignKey("policies.id", ondelete="CASCADE"), primary_key=True)
    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    """Number from 1."""
    checkpoint_id: Mapped[str] = mapped_column(ForeignKey("checkpoints.id", ondelete="RESTRICT"), index=True)
    notes: Mapped[str]
    """Text of the user about the version."""
    spec: Mapped[dict[str, Any]]
    """The `naospec.TrainingSpec` of its job, and its digest."""
    spec_sha256: Mapped[str] = mapped_column(String(64))
    lineage: Mapped[list[dict[str, Any]]] = mapped_column(JSONB)
    """The jobs behind it, first to last (see `naojobs.lineage`); they may have been deleted since."""
    idempotency_key: Mapped[str | None] = mapped_column(String(200))
    idempotency_digest: Mapped[str | None] = mapped_column(String(64))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())

    __table_args__ = (UniqueConstraint("policy_id", "checkpoint_id"), UniqueConstraint("policy_id", "idempotency_key"))


class PolicyAlias(Base):
    """Name for one version of a policy, which may move to another."""

    __tablename__ = "policy_aliases"

    policy_id: Mapped[str] = mapped_column(String(64), primary_key=True)
    name: Mapped[str] = mapped_column(String(60), primary_key=True)
    number: Mapped[int] = mapped_column(Integer)

    __table_args__ = (
        ForeignKeyConstraint(
            ["policy_id", "number"],
            [PolicyVersion.policy_id, PolicyVersion.number],
            name="fk_policy_aliases_policy_id_number_policy_versions",
            ondelete="CASCADE",
        ),
    )


AnyWork: TypeAlias = Job | Evaluation | Match
"""Row of work of any kind."""
WORK: dict[WorkKind, type[AnyWork]] = {model.kind: model for model in (Job, Evaluation, Match)}
"""Models by kind."""


class Worker(Base):
    """Worker process that is alive, or was recently."""

    __tablename__ = "workers"

    id: Mapped[str] = mapped_column(String(200), primary_key=True)
    host: Mapped[str] = mapped_column(String(200))
    pid: Mapped[int] = mapped_column(Integer)
    tasks: Mapped[dict[str, int]] = mapped_column(JSONB, server_default=text("'{}'"))
    """Tasks with their versions, robots, simulators and algorithms that it has."""
    robots: Mapped[list[str]] = mapped_column(JSONB, server_default=text("'[]'"))
    simulators: Mapped[list[str]] = mapped_column(JSONB, server_default=text("'[]'"))
    algorithms: Mapped[list[str]] = mapped_column(JSONB, server_default=text("'[]'"))
    version: Mapped[str] = mapped_column(String(40))
    disk_free_bytes: Mapped[int | None] = mapped_column(BigInteger)
    """Free space on the disk of its working folders."""
    drained_at: Mapped[datetime | None]
    """Since when it claims no work, at an administrator's request."""
    started_at: Mapped[datetime] = mapped_column(server_default=func.now())
    heartbeat_at: Mapped[datetime] = mapped_column(server_default=func.now())

    @classmethod
    def heard_within(cls, seconds: float) -> ColumnElement[bool]:
        """Return the condition that a worker's last heartbeat is at most `seconds` away from now.

        One in the future was before the database's clock was set back: workers that live have reported since.
        """
        return cls.heartbeat_at.between(
            func.now() - timedelta(seconds=seconds), func.now() + timedelta(seconds=seconds)
        )


class OwnerUsage(Base):
    """What the work of an owner has used on a day, by the database's clock; it stays when the work is deleted."""

    __tablename__ = "usage"

    owner: Mapped[str] = mapped_column(String(200), primary_key=True)
    day: Mapped[date] = mapped_column(primary_key=True)
    cpu_s: Mapped[float]
    """Seconds of processors that attempts were busy."""
    run_s: Mapped[float]
    """Seconds that attempts took."""


class Backup(Base):
    """Backup that `deploy/backup` makes or has made."""

    __tablename__ = "backups"

    id: Mapped[int] = mapped_column(BigInteger, Identity(), primary_key=True)
    started_at: Mapped[datetime] = mapped_column(server_default=func.now())
    finished_at: Mapped[datetime | None]


RANDOM_KEY = text("replace(gen_random_uuid()::text || gen_random_uuid()::text, '-', '')")
"""244 random bits in hexadecimal digits, drawn by the database."""


class ServiceKey(Base):
    """Key of the service, in one row: a restored database has that of the one that was backed up.

    Whatever a service deletes that lies outside its database has to be its own: files in the store, spools of workers.
    """

    __tablename__ = "services"

    id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    key: Mapped[str]

    __table_args__ = (CheckConstraint("id = 1", name="one_row"),)


class Generation(Base):
    """Key of the database, in one row: a restored one has another."""

    __tablename__ = "generations"

    id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    key: Mapped[str]

    __table_args__ = (CheckConstraint("id = 1", name="one_row"),)


def generation() -> ScalarSelect[str]:
    """Return the query of the database's generation: its key and the timeline of its server.

    A restore makes another key, and recovery to a moment or a standby that takes over begins another timeline: in each
    of these cases what workers have written last may be missing.
    """
    timeline = func.left(func.pg_walfile_name(func.pg_current_wal_lsn()), 8)
    return select(func.concat(Generation.key, "-", timeline)).scalar_subquery()


class LeaseClock(Base):
    """Clock of leases, in one row: the time that it showed when the database's clock showed `read_at`."""

    __tablename__ = "lease_clocks"

    id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    time: Mapped[datetime] = mapped_column(server_default=func.now())
    read_at: Mapped[datetime] = mapped_column(server_default=func.now())

    __table_args__ = (CheckConstraint("id = 1", name="one_row"),)


def lease_time(lease_s: float) -> ColumnElement[datetime]:
    """Return the expression of what the clock of leases shows now; `lease_s` is the length of a lease.

    Workers read the clock every few seconds (`naojobs.leases.read_lease_clock`), and from one reading to the next
    it advances by a third of a lease at most, never backwards. So a lease runs while the database answers: not while
    the server or its machine is stopped or suspended, nor with a step of its clock.
    """
    since = func.clock_timestamp() - LeaseClock.read_at
    return LeaseClock.time + func.least(func.greatest(since, timedelta()), timedelta(seconds=lease_s / 3))


class Token(Base):
    """Bearer token, of which only the SHA-256 is kept."""

    __tablename__ = "tokens"

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    name: Mapped[str] = mapped_column(String(200))
    owner: Mapped[str] = mapped_column(String(200))
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    scopes: Mapped[list[str]]
    job_id: Mapped[str | None] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), index=True)
    """The only job that the token gives access to; null for all jobs of the owner."""
    parent_id: Mapped[str | None] = mapped_column(ForeignKey("tokens.id", ondelete="CASCADE"), index=True)
    """The token that it was made with, and is revoked with; null for one that an administrator made."""
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    expires_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]
    ticket_key: Mapped[str] = mapped_column(String(64), server_default=RANDOM_KEY)
    """Key that signs the addresses of reports opened with this token; no request or response contains it."""

    @classmethod
    def is_valid(cls) -> ColumnElement[bool]:
        """Return the condition that a token is neither revoked nor expired."""
        return and_(cls.revoked_at.is_(None), or_(cls.expires_at.is_(None), cls.expires_at > func.now()))
