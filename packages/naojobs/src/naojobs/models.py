"""The SQLAlchemy models: every table of the service."""

from __future__ import annotations

from datetime import datetime
from typing import Any, ClassVar

from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    DateTime,
    Double,
    Enum,
    ForeignKey,
    Identity,
    Index,
    Integer,
    MetaData,
    Sequence,
    String,
    Text,
    UniqueConstraint,
    func,
    text,
)
from sqlalchemy.dialects.postgresql import ARRAY, JSONB
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from naojobs.states import LEASED, EvaluationState, JobState

_LEASED_SQL = ", ".join(f"'{state}'" for state in sorted(LEASED))


class Base(DeclarativeBase):
    """Is the declarative base; names every constraint, so that migrations can drop them."""

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
        datetime: DateTime(timezone=True),
        dict[str, Any]: JSONB,
        list[str]: ARRAY(Text),
        float: Double,
        str: Text,
    }


def _state_type(states: type[JobState] | type[EvaluationState]) -> Enum:
    """Return a text column type that gives members of `states`; a check constraint guards it in the database."""
    return Enum(states, native_enum=False, length=20, values_callable=lambda members: [str(m) for m in members])


def _state_check(column: str, states: type[JobState] | type[EvaluationState]) -> CheckConstraint:
    values = ", ".join(f"'{state}'" for state in states)
    return CheckConstraint(f"{column} IN ({values})", name=f"{column}_known")


class Job(Base):
    """Is the truth of one job."""

    __tablename__ = "jobs"

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    name: Mapped[str] = mapped_column(String(200))
    owner: Mapped[str] = mapped_column(String(200))
    tags: Mapped[list[str]] = mapped_column(server_default=text("'{}'"))
    #: A `naospec.TrainingSpec`.
    spec: Mapped[dict[str, Any]]
    #: A `naospec.EvaluationSpec` for the judgement at the end; null for none.
    evaluation: Mapped[dict[str, Any] | None] = mapped_column(JSONB(none_as_null=True))
    #: The queue, which is the simulator that a worker must have.
    queue: Mapped[str] = mapped_column(String(40))
    #: 0 to 9; higher goes first.
    priority: Mapped[int] = mapped_column(Integer, server_default=text("5"))
    state: Mapped[JobState] = mapped_column(_state_type(JobState))
    #: Counts claims and never goes back: it fences the writes of a worker that lost its lease.
    attempt: Mapped[int] = mapped_column(Integer, server_default=text("0"))
    #: Counts attempts that ended by a lost worker or trainer since the last submit or retry.
    failures: Mapped[int] = mapped_column(Integer, server_default=text("0"))
    #: The job fails when `failures` reaches it.
    max_attempts: Mapped[int] = mapped_column(Integer, server_default=text("3"))
    lease_owner: Mapped[str | None] = mapped_column(String(200))
    lease_expires_at: Mapped[datetime | None]
    heartbeat_at: Mapped[datetime | None]
    cancel_requested: Mapped[bool] = mapped_column(server_default=text("false"))
    pause_requested: Mapped[bool] = mapped_column(server_default=text("false"))
    parent_job_id: Mapped[str | None] = mapped_column(ForeignKey("jobs.id", ondelete="SET NULL"), index=True)
    parent_checkpoint_id: Mapped[str | None] = mapped_column(
        ForeignKey("checkpoints.id", ondelete="SET NULL", use_alter=True),
        index=True,
    )
    group_id: Mapped[str | None] = mapped_column(String(64), index=True)
    idempotency_key: Mapped[str | None] = mapped_column(String(200))
    #: SHA-256 of the request that came with the key, to tell a repetition from a mistake.
    idempotency_digest: Mapped[str | None] = mapped_column(String(64))
    progress_step: Mapped[int] = mapped_column(BigInteger, server_default=text("0"))
    total_steps: Mapped[int] = mapped_column(BigInteger)
    #: The newest metrics row, so that a list of jobs needs no join.
    latest_metrics: Mapped[dict[str, Any]] = mapped_column(server_default=text("'{}'"))
    #: Why the job failed, in words for its owner.
    error: Mapped[str | None]
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    queued_at: Mapped[datetime | None]
    #: When the doorbell was last rung for it; null when the broker has not been reached.
    rung_at: Mapped[datetime | None]
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    updated_at: Mapped[datetime] = mapped_column(server_default=func.now())

    __table_args__ = (
        _state_check("state", JobState),
        CheckConstraint("priority BETWEEN 0 AND 9", name="priority_range"),
        CheckConstraint(f"(state IN ({_LEASED_SQL})) = (lease_owner IS NOT NULL)", name="lease_fits_state"),
        UniqueConstraint("owner", "idempotency_key"),
        Index("ix_jobs_owner_id", "owner", text("id DESC")),
        Index("ix_jobs_updated_at", "updated_at"),
        Index("ix_jobs_tags", "tags", postgresql_using="gin"),
        Index(
            "ix_jobs_waiting",
            "queue",
            text("priority DESC"),
            "queued_at",
            postgresql_where=text("state = 'queued'"),
        ),
        Index("ix_jobs_leases", "lease_expires_at", postgresql_where=text("lease_owner IS NOT NULL")),
    )


METRICS_SEQ: Sequence = Sequence("metrics_seq", metadata=Base.metadata)


class Metric(Base):
    """Is one row of figures, written once per PPO update."""

    __tablename__ = "metrics"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    #: Environment steps since the start of the job.
    step: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    attempt: Mapped[int] = mapped_column(Integer)
    #: Order of writing; a follower continues after the last one it has seen.
    seq: Mapped[int] = mapped_column(BigInteger, METRICS_SEQ, server_default=METRICS_SEQ.next_value())
    #: Seconds of training.
    time_s: Mapped[float | None]
    values: Mapped[dict[str, Any]]

    __table_args__ = (Index("ix_metrics_job_id_seq", "job_id", "seq"),)


class Event(Base):
    """Is one thing that happened to a job."""

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
    """Is one line that a trainer or a worker wrote."""

    __tablename__ = "logs"

    id: Mapped[int] = mapped_column(BigInteger, Identity(), primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    attempt: Mapped[int] = mapped_column(Integer)
    at: Mapped[datetime] = mapped_column(server_default=func.now())
    level: Mapped[str] = mapped_column(String(10))
    message: Mapped[str]

    __table_args__ = (Index("ix_logs_job_id_id", "job_id", "id"),)


class Checkpoint(Base):
    """Is a checkpoint whose files are all in the store."""

    __tablename__ = "checkpoints"

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    attempt: Mapped[int] = mapped_column(Integer)
    step: Mapped[int] = mapped_column(BigInteger)
    #: Where its files lie in the store: `key/name`.
    key: Mapped[str]
    #: A `naojobs.store.Manifest`.
    manifest: Mapped[dict[str, Any]]
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())

    __table_args__ = (UniqueConstraint("job_id", "step", "attempt"), UniqueConstraint("key"))


class Evaluation(Base):
    """Is one judgement of one checkpoint."""

    __tablename__ = "evaluations"

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), index=True)
    checkpoint_id: Mapped[str] = mapped_column(ForeignKey("checkpoints.id", ondelete="CASCADE"), index=True)
    state: Mapped[EvaluationState] = mapped_column(_state_type(EvaluationState))
    #: A `naospec.EvaluationSpec`.
    spec: Mapped[dict[str, Any]]
    queue: Mapped[str] = mapped_column(String(40))
    attempt: Mapped[int] = mapped_column(Integer, server_default=text("0"))
    max_attempts: Mapped[int] = mapped_column(Integer, server_default=text("3"))
    lease_owner: Mapped[str | None] = mapped_column(String(200))
    lease_expires_at: Mapped[datetime | None]
    rung_at: Mapped[datetime | None]
    #: Its figures; null until it has succeeded.
    summary: Mapped[dict[str, Any] | None] = mapped_column(JSONB(none_as_null=True))
    key: Mapped[str | None]
    #: A `naojobs.store.Manifest`; null until it has succeeded.
    manifest: Mapped[dict[str, Any] | None] = mapped_column(JSONB(none_as_null=True))
    error: Mapped[str | None]
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    finished_at: Mapped[datetime | None]

    __table_args__ = (
        _state_check("state", EvaluationState),
        CheckConstraint("(state = 'running') = (lease_owner IS NOT NULL)", name="lease_fits_state"),
        Index("ix_evaluations_open", "state", postgresql_where=text("state IN ('queued', 'running')")),
    )


class Worker(Base):
    """Is a worker process that is alive, or was lately."""

    __tablename__ = "workers"

    id: Mapped[str] = mapped_column(String(200), primary_key=True)
    host: Mapped[str] = mapped_column(String(200))
    pid: Mapped[int] = mapped_column(Integer)
    queues: Mapped[list[str]]
    version: Mapped[str] = mapped_column(String(40))
    started_at: Mapped[datetime] = mapped_column(server_default=func.now())
    heartbeat_at: Mapped[datetime] = mapped_column(server_default=func.now())


class Token(Base):
    """Is a bearer token; only its SHA-256 is kept."""

    __tablename__ = "tokens"

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    name: Mapped[str] = mapped_column(String(200))
    owner: Mapped[str] = mapped_column(String(200))
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    scopes: Mapped[list[str]]
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    expires_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]
