"""Requirements of work and capabilities of workers: a worker claims only what it can run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC

from naospec import EvaluationSpec, TrainingSpec, plugins
from sqlalchemy import ColumnElement, and_, func, select, tuple_
from sqlalchemy.orm import Session

from naojobs.checkpoints import awaits_policy
from naojobs.models import AnyWork, Job, Match, Work, Worker
from naojobs.states import WorkState

MATCH_QUEUE = "match"
"""Queue in which matches wait, beside those of the simulators."""
MATCH_VERSION = 1


def match_task(*, confined: bool, contained: bool) -> str:
    """Return what workers have among their tasks that play a kind of matches.

    Args:
        confined: whether an uploaded team plays from its folder, whose agents must be confined.
        contained: whether a team plays from a container image.
    """
    return f"{'confined-' * confined}{'container-' * contained}match"


@dataclass(frozen=True, slots=True)
class Requirements:
    """Task with its version, robot, simulator and algorithm that a worker must have to run something."""

    task: str
    task_version: int
    robot: str
    simulator: str
    algorithm: str

    @classmethod
    def of_training(cls, spec: TrainingSpec) -> Requirements:
        """Return the requirements of a training."""
        return cls(spec.task.name, spec.task_version, spec.robot.name, spec.simulator.name, spec.algorithm.name)

    @classmethod
    def of_evaluation(cls, spec: EvaluationSpec, job: Job) -> Requirements:
        """Return the requirements of an evaluation of a checkpoint of `job`."""
        task, version = job.task, job.task_version
        if spec.task is not None and spec.task.name != job.task:
            task, version = spec.task.name, plugins.load(plugins.TASKS, spec.task.name).version
        return cls(task, version, job.robot, spec.simulator or job.simulator, job.algorithm)


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Tasks with their versions, robots, simulators and algorithms that a worker has."""

    tasks: Mapping[str, int]
    robots: Sequence[str]
    simulators: Sequence[str]
    """Also `MATCH_QUEUE` if it plays matches."""
    algorithms: Sequence[str]

    def meets(self, work: Work) -> bool:
        """Return whether a worker with these capabilities can run `work`."""
        return (
            self.tasks.get(work.task) == work.task_version
            and work.robot in self.robots
            and work.simulator in self.simulators
            and work.algorithm in ("", *self.algorithms)
        )

    def condition(self, model: type[AnyWork]) -> ColumnElement[bool]:
        """Return the SQL condition that corresponds to `meets` for rows of `model`."""
        return and_(
            tuple_(model.task, model.task_version).in_(list(self.tasks.items())),
            model.robot.in_(self.robots),
            model.simulator.in_(self.simulators),
            model.algorithm.in_(["", *self.algorithms]),
        )


def live_workers(session: Session, *, stale_s: float) -> Sequence[Worker]:
    """Return the workers with a heartbeat in the last `stale_s` seconds."""
    return session.scalars(select(Worker).where(Worker.heard_within(stale_s))).all()


def waiting_reasons(session: Session, work: Iterable[Work], workers: Sequence[Worker]) -> dict[str, str]:
    """Return by id why none of `workers` can take queued work; work that one of them can take is left out."""
    queued = [item for item in work if item.state is WorkState.QUEUED]
    if not queued:
        return {}
    children = [item.id for item in queued if isinstance(item, Job) and item.needs_policy]
    parents = {}
    if children:
        waiting = select(Job.id, Job.parent_job_id).where(Job.id.in_(children), awaits_policy())
        parents = {row.id: row.parent_job_id for row in session.execute(waiting)}
    reasons = {
        item.id: _reason(item, workers)
        if item.id not in parents
        else f"job {parents[item.id]}, whose policy it starts from, has no trained checkpoint yet"
        for item in queued
    }
    now = session.scalar(select(func.now())) if any(item.not_before is not None for item in queued) else None
    for item in queued:
        if item.not_before is not None and now is not None and item.not_before > now:
            left_s = (item.not_before - now).total_seconds()
            reasons[item.id] = (
                f"the next attempt begins in {left_s:.0f} s; the last one ended: {item.error}"
                if item.postponed
                else f"it is to start at {item.not_before.astimezone(UTC):%Y-%m-%d %H:%M} UTC or later"
            )
    return {work_id: reason for work_id, reason in reasons.items() if reason is not None}


def _reason(work: Work, workers: Sequence[Worker]) -> str | None:
    if not workers:
        return "no worker is running"
    workers = [worker for worker in workers if worker.drained_at is None]
    if not workers:
        return "all workers are drained"
    if any(_capabilities(worker).meets(work) for worker in workers):
        return None
    if isinstance(work, Match):
        confined = ", uploaded teams Linux 6.12" if "confined" in work.task else ""
        image = ", teams with an image a Docker engine and NAOSPRINT_RELAY_IMAGE" if "container" in work.task else ""
        return f"no worker can play it: matches need the package rcsssmj and the queue embedded{confined}{image}"
    if not any(work.simulator in worker.simulators for worker in workers):
        return f"no worker has simulator {work.simulator!r}"
    if not any(work.robot in worker.robots for worker in workers):
        return f"no worker has robot {work.robot!r}"
    if not any(work.algorithm in worker.algorithms for worker in workers):
        return f"no worker has algorithm {work.algorithm!r}"
    task = f"task {work.task!r} version {work.task_version}"
    versions = sorted({worker.tasks[work.task] for worker in workers if work.task in worker.tasks})
    if work.task_version not in versions:
        others = f" (workers have version {', '.join(map(str, versions))})" if versions else ""
        return f"no worker has {task}{others}"
    return (
        f"no single worker has {task}, robot {work.robot!r}, simulator {work.simulator!r} and algorithm "
        f"{work.algorithm!r}"
    )


def _capabilities(worker: Worker) -> Capabilities:
    return Capabilities(worker.tasks, worker.robots, worker.simulators, worker.algorithms)
