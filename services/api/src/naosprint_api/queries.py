"""Queries of the API: pages of jobs, thinned metrics, and news for followers."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field

from naojobs.capabilities import waiting_reasons
from naojobs.database import Sessions
from naojobs.errors import NotFoundError
from naojobs.models import (
    Checkpoint,
    Evaluation,
    Event,
    Job,
    Log,
    Match,
    MatchGame,
    MetricsRecord,
    PolicyRecord,
    Study,
    Worker,
    generation,
)
from naojobs.states import WorkState
from naojobs.tokens import Principal
from sqlalchemy import ColumnElement, Select, Text, and_, cast, false, func, not_, select, true, tuple_
from sqlalchemy.orm import InstrumentedAttribute

from naosprint_api.results import results_of
from naosprint_api.schemas.jobs import JobResult, MetricsPublic

_log = logging.getLogger(__name__)

MAX_POINTS = 5_000
"""Maximum number of rows of metrics in one response."""


@dataclass(frozen=True, slots=True)
class JobFilter:
    """Filter of a list of jobs."""

    states: Sequence[WorkState] = ()
    tags: Sequence[str] = ()
    owner: str | None = None
    group: str | None = None
    parent: str | None = None
    task: str | None = None
    robot: str | None = None
    text: str | None = None
    job_id: str | None = None

    def apply(self, statement: Select[tuple[Job]]) -> Select[tuple[Job]]:
        """Return `statement` narrowed to these jobs."""
        if self.states:
            statement = statement.where(Job.state.in_(self.states))
        if self.tags:
            statement = statement.where(Job.tags.contains(list(self.tags)))
        if self.owner is not None:
            statement = statement.where(Job.owner == self.owner)
        if self.group is not None:
            statement = statement.where(Job.group_id == self.group)
        if self.parent is not None:
            statement = statement.where(Job.parent_job_id == self.parent)
        if self.task is not None:
            statement = statement.where(Job.task == self.task)
        if self.robot is not None:
            statement = statement.where(Job.robot == self.robot)
        if self.job_id is not None:
            statement = statement.where(Job.id == self.job_id)
        if self.text:
            statement = statement.where(
                Job.name.icontains(self.text, autoescape=True)
                | Job.id.startswith(self.text, autoescape=True)
                | Job.id.endswith(self.text, autoescape=True)
                | func.array_to_string(Job.tags, " ").icontains(self.text, autoescape=True)
                | Job.task.icontains(self.text, autoescape=True)
                | Job.robot.icontains(self.text, autoescape=True),
            )
        return statement


def list_jobs(sessions: Sessions, wanted: JobFilter, *, limit: int, before: str | None) -> list[Job]:
    """Return up to `limit` jobs older than the job `before`, newest first."""
    statement = wanted.apply(select(Job)).order_by(Job.id.desc()).limit(limit)
    if before is not None:
        statement = statement.where(Job.id < before)
    with sessions.begin() as session:
        return list(session.scalars(statement))


PAGE = 100
"""Changed jobs that are read at a time."""

MOST_NEWS = 500
"""Most metrics, log lines and events of a job that are read at a time, of each."""

REPLAYED = 1_000
"""Most changed jobs that a returning follower is sent; one that has missed more reads the list again."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Transactions whose changes a reader sees: all before `end` but those that still run."""

    generation: str
    """The database's, see `naojobs.models.generation`."""
    oldest: int
    """The oldest transaction that runs, or `end`."""
    end: int
    running: tuple[int, ...] = ()

    def __str__(self) -> str:
        """Return it as the id of a server-sent event, from which all that it may not include is sent."""
        return f"{self.oldest}@{self.generation}"

    def includes(self, transaction: InstrumentedAttribute[int]) -> ColumnElement[bool]:
        """Return the condition of the transactions whose changes it includes."""
        return and_(transaction < self.end, transaction.not_in(self.running))


_SNAPSHOT = select(generation(), cast(func.pg_current_snapshot(), Text))


def snapshot(sessions: Sessions) -> Snapshot:
    """Return what a reader of the database sees now."""
    with sessions.begin() as session:
        database, found = session.execute(_SNAPSHOT).one()
    oldest, end, running = found.split(":")
    return Snapshot(database, int(oldest), int(end), tuple(map(int, running.split(","))) if running else ())


def resume(sessions: Sessions, last_id: str | None) -> tuple[Snapshot, bool]:
    """Return the snapshot that a follower continues from, and whether it has to read the list of jobs again.

    It has to if `last_id` is not an id of this database, or more than `REPLAYED` jobs have changed since then.
    """
    now = snapshot(sessions)
    if not last_id:
        return now, False
    number, _, database = last_id.partition("@")
    position = int(number) if number.isascii() and number.isdecimal() else 0
    newest = select(Job.changed_in).where(Job.changed_in < now.end).order_by(Job.changed_in.desc(), Job.id.desc())
    with sessions.begin() as session:
        too_old = session.scalar(newest.offset(REPLAYED).limit(1)) or 0
    if database != now.generation or not too_old < position <= now.end:
        return now, True
    return Snapshot(database, position, position), False


def changed_jobs(
    sessions: Sessions, wanted: JobFilter, *, seen: Snapshot, now: Snapshot, after: tuple[int, str]
) -> list[Job]:
    """Return up to `PAGE` jobs whose last change is in `now` and not in `seen`, oldest transaction first.

    Args:
        sessions: the database.
        wanted: the jobs that are followed.
        seen: the snapshot of the changes that were read before.
        now: a later one; jobs that have changed since then are left out.
        after: transaction and id of the last job of the page before, or of the oldest transaction to read.
    """
    place = tuple_(Job.changed_in, Job.id)
    statement = wanted.apply(select(Job)).where(
        place > after, not_(seen.includes(Job.changed_in)), now.includes(Job.changed_in)
    )
    with sessions.begin() as session:
        return list(session.scalars(statement.order_by(Job.changed_in, Job.id).limit(PAGE)))


def seconds(sessions: Sessions) -> float:
    """Return the time by the database's clock, which all processes share, in seconds since 1970."""
    with sessions() as session:
        return float(session.execute(select(func.extract("epoch", func.now()))).scalar_one())


def visible_job(sessions: Sessions, principal: Principal, job_id: str) -> Job:
    """Return a job that `principal` may see. Raises NotFoundError, also for jobs of others."""
    with sessions.begin() as session:
        job = session.get(Job, job_id)
    if job is None or not _may_see(principal, job.owner, job_id, job_id):
        raise NotFoundError(f"no job {job_id} that this token may see")
    return job


def _may_see(principal: Principal, owner: str, job_id: str, what: str) -> bool:
    """Return whether `principal` may see `what` of a job of `owner`; log a refusal."""
    if principal.may_see(owner, job_id):
        return True
    _log.warning("refused %s (%s): %s belongs to %s", principal.owner, principal.token_id, what, owner)
    return False


def visible_checkpoint(sessions: Sessions, principal: Principal, checkpoint_id: str) -> Checkpoint:
    """Return a checkpoint of a job that `principal` may see. Raises NotFoundError."""
    with sessions.begin() as session:
        row = session.execute(
            select(Checkpoint, Job.owner).join(Job, Job.id == Checkpoint.job_id).where(Checkpoint.id == checkpoint_id),
        ).one_or_none()
    if row is None or not _may_see(principal, row.owner, row.Checkpoint.job_id, checkpoint_id):
        raise NotFoundError(f"no checkpoint {checkpoint_id} that this token may see")
    checkpoint: Checkpoint = row.Checkpoint
    return checkpoint


def visible_evaluation(sessions: Sessions, principal: Principal, evaluation_id: str) -> Evaluation:
    """Return an evaluation of a job that `principal` may see. Raises NotFoundError."""
    with sessions.begin() as session:
        row = session.execute(
            select(Evaluation, Job.owner).join(Job, Job.id == Evaluation.job_id).where(Evaluation.id == evaluation_id),
        ).one_or_none()
    if row is None or not _may_see(principal, row.owner, row.Evaluation.job_id, evaluation_id):
        raise NotFoundError(f"no evaluation {evaluation_id} that this token may see")
    evaluation: Evaluation = row.Evaluation
    return evaluation


def visible_study(sessions: Sessions, principal: Principal, study_id: str) -> Study:
    """Return a study that `principal` may see. Raises NotFoundError, also for studies of others."""
    with sessions.begin() as session:
        study = session.get(Study, study_id)
    if study is None or not _may_see(principal, study.owner, "", study_id):
        raise NotFoundError(f"no study {study_id} that this token may see")
    return study


def visible_match(sessions: Sessions, principal: Principal, match_id: str) -> Match:
    """Return a match that `principal` may see. Raises NotFoundError, also for matches of others."""
    with sessions.begin() as session:
        match = session.get(Match, match_id)
    if match is None or not _may_see(principal, match.owner, "", match_id):
        raise NotFoundError(f"no match {match_id} that this token may see")
    return match


def game(sessions: Sessions, match_id: str, number: int) -> MatchGame:
    """Return a game that is over. Raises NotFoundError."""
    with sessions.begin() as session:
        found = session.get(MatchGame, (match_id, number))
    if found is None:
        raise NotFoundError(f"game {number} of match {match_id} is not over")
    return found


def list_matches(
    sessions: Sessions, *, owner: str | None, tags: Sequence[str] = (), limit: int, before: str | None
) -> list[Match]:
    """Return up to `limit` matches with all of `tags` older than the match `before`, newest first."""
    statement = select(Match).order_by(Match.id.desc()).limit(limit)
    if tags:
        statement = statement.where(Match.tags.contains(list(tags)))
    if owner is not None:
        statement = statement.where(Match.owner == owner)
    if before is not None:
        statement = statement.where(Match.id < before)
    with sessions.begin() as session:
        return list(session.scalars(statement))


def owned_policies(principal: Principal, owner: str | None) -> ColumnElement[bool]:
    """Return the condition of the registered policies that `principal` may see, those of `owner` if one is given.

    Raises NotFoundError for another owner without scope admin.
    """
    if principal.job_id is not None:
        return false()  # a link to a job shows no policy
    if not principal.is_admin:
        if owner is not None and owner != principal.owner:
            raise NotFoundError(f"no policies of {owner} that this token may see; leave `owner` out")
        owner = principal.owner
    return true() if owner is None else PolicyRecord.owner == owner


def list_studies(
    sessions: Sessions, *, owner: str | None, text: str | None, limit: int, before: str | None
) -> list[Study]:
    """Return up to `limit` studies older than `before`, newest first."""
    statement = select(Study).order_by(Study.id.desc()).limit(limit)
    if owner is not None:
        statement = statement.where(Study.owner == owner)
    if text:
        statement = statement.where(Study.name.icontains(text, autoescape=True))
    if before is not None:
        statement = statement.where(Study.id < before)
    with sessions.begin() as session:
        return list(session.scalars(statement))


def evaluation(sessions: Sessions, evaluation_id: str) -> Evaluation:
    """Return an evaluation of any owner. Raises NotFoundError."""
    with sessions.begin() as session:
        row = session.get(Evaluation, evaluation_id)
    if row is None:
        raise NotFoundError(f"no evaluation {evaluation_id}")
    return row


def metrics_columns(sessions: Sessions, job_id: str, *, after_step: int, max_points: int) -> MetricsPublic:
    """Return metrics by column, thinned to every k-th row so that at most `max_points` remain.

    The last row is always among them. Rows are real ones, never averages.
    """
    numbered = (
        select(
            MetricsRecord.step,
            MetricsRecord.values,
            func.row_number().over(order_by=MetricsRecord.step.desc()).label("from_end"),
            func.count().over().label("total"),
            func.max(MetricsRecord.seq).over().label("last_seq"),
        )
        .where(MetricsRecord.job_id == job_id, MetricsRecord.step > after_step)
        .subquery()
    )
    stride = (numbered.c.total + max_points - 1) / max_points
    with sessions.begin() as session:
        rows = session.execute(
            select(numbered)
            .where((numbered.c.from_end - 1) % func.greatest(func.floor(stride), 1) == 0)
            .order_by(numbered.c.step),
        ).all()
    names = dict.fromkeys(["step", *(name for row in rows for name in row.values)])
    columns: dict[str, list[float | None]] = {name: [row.values.get(name) for row in rows] for name in names}
    columns["step"] = [row.step for row in rows]
    return MetricsPublic(
        columns=columns,
        rows=len(rows),
        total_rows=rows[0].total if rows else 0,
        last_seq=max((row.last_seq for row in rows), default=0),
    )


def events_after(sessions: Sessions, job_id: str, *, after: int, limit: int) -> list[Event]:
    """Return events of a job after the event `after`, oldest first."""
    with sessions.begin() as session:
        return list(
            session.scalars(
                select(Event).where(Event.job_id == job_id, Event.id > after).order_by(Event.id).limit(limit)
            ),
        )


def logs_after(sessions: Sessions, job_id: str, *, after: int, limit: int) -> list[Log]:
    """Return log lines of a job after the line `after`, oldest first."""
    with sessions.begin() as session:
        return list(
            session.scalars(select(Log).where(Log.job_id == job_id, Log.id > after).order_by(Log.id).limit(limit)),
        )


def logs_tail(sessions: Sessions, job_id: str, *, limit: int, before: int | None = None) -> list[Log]:
    """Return the last log lines of a job, or the last ones before the line `before`, oldest first."""
    statement = select(Log).where(Log.job_id == job_id).order_by(Log.id.desc()).limit(limit)
    if before is not None:
        statement = statement.where(Log.id < before)
    with sessions.begin() as session:
        rows = session.scalars(statement).all()
    return list(reversed(rows))


def checkpoints_of(
    sessions: Sessions, job_id: str, *, limit: int, before: tuple[int, int] | None = None
) -> list[Checkpoint]:
    """Return up to `limit` checkpoints of a job, those before a step and attempt if given, most steps first."""
    statement = select(Checkpoint).where(Checkpoint.job_id == job_id).limit(limit)
    if before is not None:
        statement = statement.where(tuple_(Checkpoint.step, Checkpoint.attempt) < before)
    with sessions.begin() as session:
        return list(session.scalars(statement.order_by(Checkpoint.step.desc(), Checkpoint.attempt.desc())))


def evaluations_of(sessions: Sessions, job_id: str, *, limit: int, before: str | None = None) -> list[Evaluation]:
    """Return up to `limit` evaluations of a job, those older than the evaluation `before` if given, newest first."""
    statement = select(Evaluation).where(Evaluation.job_id == job_id).limit(limit)
    if before is not None:
        statement = statement.where(Evaluation.id < before)
    with sessions.begin() as session:
        return list(session.scalars(statement.order_by(Evaluation.id.desc())))


@dataclass(frozen=True, slots=True)
class Position:
    """Position of a follower: the last metrics row, log line and event that it has seen."""

    metrics: int = 0
    logs: int = 0
    events: int = 0

    def __str__(self) -> str:
        """Return it as the id of a server-sent event."""
        return f"{self.metrics}-{self.logs}-{self.events}"

    @classmethod
    def parse(cls, text: str) -> Position | None:
        """Read the id of a server-sent event; none if it is not valid."""
        parts = text.split("-")
        if len(parts) != 3 or not all(part.isascii() and part.isdecimal() and len(part) < 19 for part in parts):
            return None
        return cls(*(int(part) for part in parts))


@dataclass(slots=True)
class News:
    """Changes of a job since a position."""

    job: Job | None
    waiting_reason: str | None = None
    """Why no worker can take the job, if it is queued."""
    result: JobResult | None = None
    """Its evaluation, if one has finished."""
    metrics: list[MetricsRecord] = field(default_factory=list)
    logs: list[Log] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    more: bool = False
    """Whether there is more of some kind than the limit."""


def news_of(
    sessions: Sessions,
    job_id: str,
    seen: Position,
    kinds: frozenset[str],
    *,
    workers: Sequence[Worker],
) -> News:
    """Return the job and what is new about it, at most `MOST_NEWS` of each kind.

    The job is read first: if it has ended, everything before its end is in the rows read after it.
    """
    with sessions.begin() as session:
        news = News(session.get(Job, job_id))
        if news.job is None:
            return news
        news.waiting_reason = waiting_reasons(session, [news.job], workers).get(job_id)
        news.result = results_of(session, [news.job]).get(job_id)
        if "metrics" in kinds:
            rows = select(MetricsRecord).where(MetricsRecord.job_id == job_id, MetricsRecord.seq > seen.metrics)
            news.metrics = list(session.scalars(rows.order_by(MetricsRecord.seq).limit(MOST_NEWS)))
        if "log" in kinds:
            lines = select(Log).where(Log.job_id == job_id, Log.id > seen.logs)
            news.logs = list(session.scalars(lines.order_by(Log.id).limit(MOST_NEWS)))
        if "event" in kinds:
            events = select(Event).where(Event.job_id == job_id, Event.id > seen.events)
            news.events = list(session.scalars(events.order_by(Event.id).limit(MOST_NEWS)))
    news.more = MOST_NEWS in (len(news.metrics), len(news.logs), len(news.events))
    return news
