"""Lineage of a checkpoint: the jobs behind it, first to last, as the cards of bundled policies describe them."""

from __future__ import annotations

from typing import Any

import naopolicies
from naospec import TrainingSpec, plugins, read_stored
from pydantic import ValidationError
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from naojobs.models import Checkpoint, Job, MetricsRecord, PolicyRecord, PolicyVersion

CURVE_ROWS = 200
"""Largest number of rows of a learning curve."""
MAX_JOBS = 100
"""Largest number of jobs of a lineage."""


def trained_by(trained: Job | PolicyVersion) -> TrainingSpec | None:
    """Return the specification of a job or of a version's job; none if this version cannot read it."""
    try:
        return read_stored(TrainingSpec, trained.spec)
    except (ValidationError, plugins.BrokenPluginError):
        return None


def lineage_of(session: Session, checkpoint: Checkpoint) -> list[dict[str, Any]]:
    """Return a part for each job behind a checkpoint, its own job last.

    Each part contains the job's name and id, the checkpoint that the next job or the policy starts from, task, robot,
    preset, seed, steps, seconds of training, overrides of the preset, the specification's SHA-256, a learning curve by
    column, and the policy that the job started from, if it was a bundled or registered one.
    """
    parts: list[dict[str, Any]] = []
    job, at, step = session.get_one(Job, checkpoint.job_id), checkpoint.id, checkpoint.step
    while True:
        parent_policy = job.parent_policy or _registered(session, job)
        parts.insert(0, _part(session, job, at, step, parent_policy))
        if parent_policy in naopolicies.names():
            return [*naopolicies.card(str(parent_policy))["lineage"], *parts]
        start = session.get(Checkpoint, job.parent_checkpoint_id) if job.parent_checkpoint_id else None
        if start is None or len(parts) == MAX_JOBS:
            return parts
        earlier = session.get(Job, start.job_id)
        if earlier is None:  # deleted just now
            return parts
        job, at, step = earlier, start.id, start.step


def _registered(session: Session, job: Job) -> str | None:
    """Return the first version of a policy that is the checkpoint which a job started from."""
    found = session.execute(
        select(PolicyRecord.name, PolicyVersion.number)
        .join(PolicyRecord, PolicyRecord.id == PolicyVersion.policy_id)
        .where(PolicyVersion.checkpoint_id == job.parent_checkpoint_id, PolicyRecord.owner == job.owner)
        .order_by(PolicyVersion.created_at)
        .limit(1)
    ).first()
    return f"{found.name}@{found.number}" if found else None


def _part(session: Session, job: Job, checkpoint_id: str, step: int, parent_policy: str | None) -> dict[str, Any]:
    spec = trained_by(job)
    curve = _curve(session, job, step)
    last = session.scalar(
        select(MetricsRecord.time_s)
        .where(MetricsRecord.job_id == job.id, MetricsRecord.step <= step)
        .order_by(MetricsRecord.step.desc())
        .limit(1)
    )
    return {
        "job": job.name,
        "job_id": job.id,
        "checkpoint_id": checkpoint_id,
        "task": job.task,
        "robot": job.robot,
        "preset": spec.algorithm.preset if spec else "",
        "seed": spec.seed if spec else None,
        "steps": step,
        "training_s": round(last or 0.0),
        "overrides": spec.overrides() if spec else {},
        "spec_sha256": spec.digest() if spec else None,
        "parent_policy": parent_policy,
        "curve": curve,
    }


def _curve(session: Session, job: Job, step: int) -> dict[str, list[float]]:
    """Return the columns that lists of jobs show, up to a step, thinned to every k-th row."""
    task = plugins.find(plugins.TASKS, job.task)
    listed = () if task is None else task.presentation.listed
    numbered = (
        select(
            MetricsRecord.step,
            MetricsRecord.values,
            func.row_number().over(order_by=MetricsRecord.step).label("place"),
            func.count().over().label("total"),
        )
        .where(MetricsRecord.job_id == job.id, MetricsRecord.step <= step)
        .subquery()
    )
    stride = func.greatest((numbered.c.total + CURVE_ROWS - 1) / CURVE_ROWS, 1)
    rows = session.execute(
        select(numbered.c.step, numbered.c["values"])
        .where((numbered.c.total - numbered.c.place) % func.floor(stride) == 0)
        .order_by(numbered.c.step)
    ).all()
    complete = [row for row in rows if all(name in row[1] for name in listed)]
    columns: dict[str, list[float]] = {"step": [float(row[0]) for row in complete]}
    return columns | {name: [row[1][name] for row in complete] for name in listed}
