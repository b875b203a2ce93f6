"""Submission of work: trainings, groups of trainings, and evaluations of their checkpoints."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import datetime
from typing import Any

import naopolicies
from naospec import EvaluationSpec, TrainingSpec, plugins, read_stored, stored, validation_words
from naospec.flat import nest
from pydantic import ValidationError
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from naojobs import policies
from naojobs.capabilities import Requirements
from naojobs.changes import add_event, lock
from naojobs.checkpoints import newest_checkpoint, trained_checkpoint
from naojobs.database import Sessions, notify, storable
from naojobs.errors import ConflictError, InvalidError, NotFoundError, within
from naojobs.idempotency import earlier, hold_names
from naojobs.ids import new_id
from naojobs.lineage import trained_by
from naojobs.models import DEFAULT_TIME_LIMIT_S, Checkpoint, Evaluation, Job, PolicyRecord, Study
from naojobs.quotas import NO_LIMITS, SPACE, Limits, Quota, require_room, wait_for_turn
from naojobs.states import ENDED, OPEN, WorkState

INVISIBLE = frozenset({"Cc", "Cf", "Zl", "Zp"})
"""Categories of characters that no name has: controls, formats, separators of lines and paragraphs."""
_MOST_NAMED = 190
"""Characters of a name before the number that is added to it."""
MAX_GROUP_SIZE = 256
"""The most jobs of one group."""
MAX_OPEN_EVALUATIONS = 100
"""The most evaluations of one job that may wait or run."""


@dataclass(frozen=True, slots=True)
class JobRequest:
    """Training to submit."""

    spec: TrainingSpec = field(default_factory=TrainingSpec)
    evaluation: EvaluationSpec | None = None
    """Evaluation of the final policy; none for no evaluation."""
    name: str | None = None
    tags: Sequence[str] = ()
    priority: int = 5
    not_before: datetime | None = None
    """Earliest start; none for at once."""
    max_attempts: int = 3
    parent_job_id: str | None = None
    parent_checkpoint_id: str | None = None
    parent_policy: str | None = None
    """A bundled or registered policy to start from: NAME, NAME@VERSION or NAME@ALIAS; excludes the other two."""

    @property
    def display_name(self) -> str:
        """Name, or one made of task, preset and seed."""
        return self.name or f"{self.spec.task.name}-{self.spec.algorithm.preset}-{self.spec.seed}"

    def digest(self) -> str:
        """Return the SHA-256 that equal requests share."""
        return digest_of(self, later=("parent_policy", "not_before"))


@dataclass(frozen=True, slots=True)
class EvaluationRequest:
    """Evaluation of a job's checkpoint to submit."""

    checkpoint_id: str | None = None
    """The newest checkpoint if none is named."""
    spec: EvaluationSpec | None = None
    report: str | None = None
    """Report to draw with it: film, pictures or off; none for what the worker is set to."""
    time_limit_s: float = DEFAULT_TIME_LIMIT_S
    tags: Sequence[str] = ()
    priority: int | None = None
    """None for the job's."""
    not_before: datetime | None = None
    max_attempts: int = 3


def digest_of(request: Any, later: Sequence[str] = ()) -> str:
    """Return the SHA-256 that equal requests share; without `later` fields that are not set.

    Requests of versions that did not have these fields keep their digest.
    """
    values = {item.name: getattr(request, item.name) for item in fields(request)}
    kept = {name: value for name, value in values.items() if value or name not in later}
    return hashlib.sha256(json.dumps(kept, sort_keys=True, default=_document).encode()).hexdigest()


def _document(value: TrainingSpec | EvaluationSpec | datetime) -> Any:
    return value.isoformat() if isinstance(value, datetime) else value.model_dump(mode="json")


@dataclass(frozen=True, slots=True)
class GroupRequest:
    """Trainings to submit that differ in their seed or in other fields of the specification."""

    job: JobRequest
    seeds: Sequence[int] = ()
    grid: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    """Values by field; one job for each combination."""

    def digest(self) -> str:
        """Return the SHA-256 that equal requests share."""
        text = json.dumps([self.job.digest(), list(self.seeds), self.grid])
        return hashlib.sha256(text.encode()).hexdigest()


def submit(
    sessions: Sessions,
    request: JobRequest,
    *,
    owner: str,
    idempotency_key: str | None = None,
    limits: Limits = NO_LIMITS,
    see_all: bool = False,
) -> tuple[Job, bool]:
    """Queue a new job of `owner`; return it and whether it is new.

    The same `idempotency_key` with the same request returns the existing job.

    Raises:
        ConflictError: the key was used for another request.
        InvalidError: the parent job or checkpoint does not exist or does not fit; `see_all` allows others' jobs.
        QuotaError: `owner` has as many open jobs, or jobs, as `limits` allow.
    """
    with sessions.begin() as session:
        job, created = add_job(session, request, owner, idempotency_key, limits, see_all)
    return job, created


def submit_group(
    sessions: Sessions,
    request: GroupRequest,
    *,
    owner: str,
    idempotency_key: str | None = None,
    limits: Limits = NO_LIMITS,
    see_all: bool = False,
) -> tuple[str, list[Job], bool]:
    """Queue one job for each seed and combination of grid values, or none at all.

    Return the group's id, its jobs and whether they are new. Raises as `submit` does, and InvalidError for a
    combination that the specification refuses or a group of more than `MAX_GROUP_SIZE` jobs.
    """
    requests = expand_group(request)
    digest = request.digest() if idempotency_key is not None else None
    keys = [f"{idempotency_key}#{number}" for number in range(len(requests))] if idempotency_key is not None else []
    with sessions.begin() as session:
        _wait(session, owner, limits)
        if made := _group_made(session, owner, keys, digest):
            return made[0].group_id or made[0].id, made, False
        with within("job"):
            _require_room(session, owner, limits, more=len(requests))
            group_id, taken, jobs = new_id("group"), _names(session, Job, owner, request.job.display_name), []
            for item, key in itertools.zip_longest(requests, keys):
                jobs.append(_queue(session, item, owner, see_all, taken, group_id, key, digest))
    return group_id, jobs, True


def _group_made(session: Session, owner: str, keys: Sequence[str], digest: str | None) -> list[Job]:
    """Return what is left of the group that a request with these keys has made. Raises as `earlier` does."""
    used = select(Job.idempotency_key).where(Job.owner == owner, Job.idempotency_key.in_(keys))
    found = [earlier(session, Job, Job.owner == owner, key, digest) for key in session.scalars(used)]
    return sorted((job for job in found if job is not None), key=lambda job: keys.index(str(job.idempotency_key)))


def expand_group(request: GroupRequest) -> list[JobRequest]:
    """Return the requests of a group's jobs. Raises InvalidError."""
    axes: dict[str, Sequence[Any]] = dict(request.grid)
    if request.seeds:
        if "seed" in axes:
            raise InvalidError("give the seeds in `seeds` or in `grid`, not in both", "seeds")
        axes["seed"] = request.seeds
    if not axes:
        raise InvalidError("name at least one seed in `seeds` or one field in `grid`", "seeds")
    for name in axes:
        try:
            nest({name: None})
        except KeyError:
            raise InvalidError(f"the training specification has no field {name!r}", f"grid.{name}") from None
    size = math.prod(len(values) for values in axes.values())
    if size > MAX_GROUP_SIZE:
        raise InvalidError(f"{size} jobs are more than {MAX_GROUP_SIZE}; give fewer values", "grid")
    base = request.job.spec.written()
    jobs = []
    for values in itertools.product(*axes.values()):
        point = dict(zip(axes, values, strict=True))
        label = ",".join(f"{name}={value}" for name, value in point.items())
        try:
            spec = TrainingSpec.model_validate(base.with_settings(point))
        except ValidationError as error:
            raise InvalidError(f"{label}: {validation_words(error.errors())}", f"grid.{next(iter(point))}") from error
        # Without blanks, so that it can be typed as it is.
        suffix = "".join(f"-{name.rpartition('.')[2]}-{value}" for name, value in point.items()).replace(" ", "")
        jobs.append(replace(request.job, spec=spec, name=f"{request.job.display_name}{suffix}"[:200]))
    return jobs


def add_job(
    session: Session,
    request: JobRequest,
    owner: str,
    idempotency_key: str | None = None,
    limits: Limits = NO_LIMITS,
    see_all: bool = False,
    *,
    group_id: str | None = None,
) -> tuple[Job, bool]:
    """Queue a new job as `submit` does, as part of a transaction."""
    digest = request.digest() if idempotency_key is not None else None
    _wait(session, owner, limits)
    if (made := earlier(session, Job, Job.owner == owner, idempotency_key, digest)) is not None:
        return made, False
    _require_room(session, owner, limits)
    taken = _names(session, Job, owner, request.display_name)
    return _queue(session, request, owner, see_all, taken, group_id, idempotency_key, digest), True


def _wait(session: Session, owner: str, limits: Limits) -> None:
    """Wait for all that must not change while jobs of an owner are queued."""
    wait_for_turn(session, owner, limits, Quota.OPEN_JOBS, Quota.JOBS, *SPACE)
    hold_names(session, owner)


def _require_room(session: Session, owner: str, limits: Limits, *, more: int = 1) -> None:
    require_room(session, owner, limits, Quota.OPEN_JOBS, Quota.JOBS, more=more)
    require_room(session, owner, limits, *SPACE)


def _queue(
    session: Session,
    request: JobRequest,
    owner: str,
    see_all: bool,
    taken: set[str],
    group_id: str | None,
    idempotency_key: str | None,
    digest: str | None,
) -> Job:
    """Queue a new job for which there is room, under a name that is not among those taken, which it joins."""
    request = with_parent(session, request, owner, see_all)
    check_evaluation(request.evaluation, request.spec, "evaluation")
    job = Job(
        id=new_id("job"),
        name=_free(request.display_name, taken),
        owner=owner,
        tags=list(dict.fromkeys(request.tags)),
        spec=stored(request.spec),
        evaluation=stored(request.evaluation) if request.evaluation else None,
        **asdict(Requirements.of_training(request.spec)),
        priority=request.priority,
        not_before=request.not_before,
        state=WorkState.QUEUED,
        max_attempts=request.max_attempts,
        parent_job_id=request.parent_job_id,
        parent_checkpoint_id=request.parent_checkpoint_id,
        parent_policy=request.parent_policy,
        needs_policy=request.parent_job_id is not None or request.parent_policy is not None,
        group_id=group_id,
        idempotency_key=idempotency_key,
        idempotency_digest=digest,
        total_steps=request.spec.planned_steps,
        queued_at=func.now(),
    )
    session.add(job)
    session.flush()
    session.refresh(job)
    add_event(session, job, "queued", "submitted", {"owner": owner})
    return job


def edit(
    sessions: Sessions,
    job_id: str,
    *,
    name: str | None = None,
    tags: Sequence[str] | None = None,
    notes: str | None = None,
    priority: int | None = None,
    limits: Limits = NO_LIMITS,
) -> Job:
    """Change a job's name, tags, notes or priority; None leaves a value as it is.

    Raises NotFoundError, ConflictError if another job of the owner has the name or if the priority of a job that has
    ended would change, and QuotaError if the owner's notes would become longer than `limits` allow.
    """
    with sessions.begin() as session:
        owner = session.scalar(select(Job.owner).where(Job.id == job_id))
        wait_for_turn(session, owner, limits, Quota.NOTES, Quota.ROWS)
        if name is not None and owner is not None:
            hold_names(session, owner)
        job = session.get(Job, job_id, with_for_update=True)
        if job is None:
            raise NotFoundError(f"no job {job_id}")
        if name is not None and name != job.name:
            if free_name(session, Job, job.owner, name) != name:
                raise ConflictError(f"another job is named {name!r}; use another name", "name")
            job.name = name
        if tags is not None:
            job.tags = list(tags)
        if notes is not None:
            longer = len(storable(notes).encode()) - len(job.notes.encode())
            if longer > 0:
                require_room(session, job.owner, limits, Quota.NOTES, more=longer)
            job.notes = notes
        if priority is not None and priority != job.priority:
            if job.state in ENDED:
                raise ConflictError(f"job {job_id} waits no longer: it is {job.state}", "priority")
            require_room(session, job.owner, limits, Quota.ROWS)
            job.priority = priority
            add_event(session, job, "priority", f"priority changed to {priority}", {"priority": priority})
        job.updated_at = func.now()
        session.flush()
        session.refresh(job)
        notify(session, job_id)
    return job


def free_name(session: Session, model: type[Job] | type[Study], owner: str, name: str) -> str:
    """Return a name that no job, or no study, of `owner` has: `name`, or with a number.

    The transaction holds the names (`hold_names`).
    Raises InvalidError for characters that would act on a terminal instead of being shown, also in composed names.
    """
    return _free(name, _names(session, model, owner, name))


def _names(session: Session, model: type[Job] | type[Study], owner: str, name: str) -> set[str]:
    """Return the owner's names that begin as a name that is made from this one may begin."""
    condition = model.name.startswith(name[:_MOST_NAMED], autoescape=True)
    return set(session.scalars(select(model.name).where(model.owner == owner, condition)))


def _free(name: str, taken: set[str]) -> str:
    """Add a name that is not taken, this one or with a number, to those taken, and return it. Raises InvalidError."""
    if any(unicodedata.category(character) in INVISIBLE for character in name):
        raise InvalidError("expected text without control, format and separator characters", "name")
    numbered = (f"{name[:_MOST_NAMED]}-{number}" for number in itertools.count(2))
    free = next(text for text in itertools.chain([name], numbered) if text not in taken)
    taken.add(free)
    return free


def check_evaluation(evaluation: EvaluationSpec | None, trained: TrainingSpec, field: str) -> None:
    """Raise InvalidError if what is trained cannot be evaluated so, for example on another simulator."""
    if evaluation is None:
        return
    try:
        evaluation.applied_to(trained)
    except ValidationError as error:
        first, *others = error.errors()
        path = [str(part) for part in first["loc"]]
        if not others and path and getattr(evaluation, path[0], None) is not None:
            raise InvalidError(validation_words([{**first, "loc": ()}]), ".".join([field, *path])) from None
        part = next((f".{name}" for name in ("engine", "simulator", "task") if getattr(evaluation, name)), "")
        raise InvalidError(validation_words([first, *others]), field + part) from None


def with_parent(session: Session, request: JobRequest, owner: str, see_all: bool) -> JobRequest:
    """Return the request with the job, checkpoint and version that its parent policy names, after a check that it fits.

    Raises InvalidError.
    """
    reference = request.parent_policy
    if reference is None:
        _check_parent(session, request, owner, see_all)
        return request
    if request.parent_job_id is not None:
        raise InvalidError("give a parent policy or a parent job, not both", "parent_policy")
    try:
        policy, version = policies.find(session, PolicyRecord.owner == owner, reference)
    except NotFoundError as error:
        if reference in naopolicies.names():
            check_fit(request, read_stored(TrainingSpec, naopolicies.spec(reference)))
            return request
        known = ", ".join(naopolicies.names())
        raise InvalidError(f"{error}; bundled policies are {known}", "parent_policy") from None
    checkpoint = session.get(Checkpoint, version.checkpoint_id)
    if checkpoint is None:
        raise InvalidError(f"version {version.number} of {policy.name} was just deleted", "parent_policy")
    found = replace(
        request,
        parent_job_id=checkpoint.job_id,
        parent_checkpoint_id=checkpoint.id,
        parent_policy=f"{policy.name}@{version.number}",
    )
    _check_parent(session, found, owner, see_all=True)
    return found


def _check_parent(session: Session, request: JobRequest, owner: str, see_all: bool) -> None:
    if request.parent_job_id is None:
        return
    parent = session.scalar(select(Job).where(Job.id == request.parent_job_id).with_for_update(key_share=True))
    if parent is None or (parent.owner != owner and not see_all):
        raise InvalidError(f"no job {request.parent_job_id}; use the id of one of your jobs", "parent_job_id")
    try:
        theirs = read_stored(TrainingSpec, parent.spec)
    except (ValidationError, plugins.BrokenPluginError):
        raise InvalidError(
            f"job {parent.id} was stored by a version whose specifications this one cannot read; use a newer job",
            "parent_job_id",
        ) from None
    check_fit(request, theirs)
    if request.parent_checkpoint_id is not None:
        # Read again under the lock: what named it may have been deleted meanwhile, and the checkpoint with it.
        checkpoint = session.get(Checkpoint, request.parent_checkpoint_id, populate_existing=True)
        if checkpoint is None or checkpoint.job_id != parent.id:
            raise InvalidError(
                f"job {parent.id} has no checkpoint {request.parent_checkpoint_id}",
                "parent_checkpoint_id",
            )
    elif parent.state in ENDED and trained_checkpoint(session, parent.id) is None:
        raise InvalidError(
            f"job {parent.id} is {parent.state} and has no trained checkpoint; start from another job", "parent_job_id"
        )


def check_fit(request: JobRequest, theirs: TrainingSpec, *, field: str = "") -> None:
    """Raise InvalidError, for `field` or the one that differs, unless a training can start from another's policy."""
    robot = theirs.robot.name
    if robot in plugins.names(plugins.ROBOTS):
        family = theirs.family
        if family != request.spec.family:
            raise InvalidError(
                f"the parent's policy is for robot {robot}, this job is for {request.spec.robot.name}; "
                f"use a robot of family {family}",
                field or "spec.robot",
            )
    if (misfit := request.spec.stage_specs[0].algorithm.misfit(theirs.stage_specs[-1].algorithm)) is not None:
        name, there, here = misfit
        raise InvalidError(
            f"the parent's policy has {name} {there}, this job {here}; use {there}",
            field or f"spec.algorithm.{name}",
        )


def submit_evaluation(
    sessions: Sessions,
    job_id: str,
    request: EvaluationRequest,
    *,
    idempotency_key: str | None = None,
    limits: Limits = NO_LIMITS,
) -> tuple[Evaluation, bool]:
    """Queue an evaluation of a job's checkpoint; return it and whether it is new.

    The same `idempotency_key` with the same request for the same job returns the existing evaluation.

    Raises NotFoundError, InvalidError if the policy cannot be evaluated so, ConflictError if the key was used for
    another request, or if the job has no checkpoint yet or too many open evaluations, and QuotaError if its owner has
    as many evaluations as `limits` allow.
    """
    digest = digest_of(request) if idempotency_key is not None else None
    with sessions.begin() as session:
        owner = session.scalar(select(Job.owner).where(Job.id == job_id))
        wait_for_turn(session, owner, limits, Quota.EVALUATIONS, *SPACE)
        job = lock(session, Job, job_id)
        if job is None:
            raise NotFoundError(f"no job {job_id}")
        if (made := earlier(session, Evaluation, Evaluation.job_id == job_id, idempotency_key, digest)) is not None:
            return made, False
        checkpoint = _checkpoint_of(session, job_id, request.checkpoint_id)
        is_open = (Evaluation.job_id == job_id, Evaluation.state.in_(OPEN))
        waiting = session.scalar(select(func.count()).select_from(Evaluation).where(*is_open))
        if (waiting or 0) >= MAX_OPEN_EVALUATIONS:
            raise ConflictError(f"job {job_id} has {waiting} open evaluations; wait until some finish, or cancel some")
        require_room(session, job.owner, limits, Quota.EVALUATIONS, *SPACE)
        spec = request.spec or EvaluationSpec()
        if (trained := trained_by(job)) is not None:
            check_evaluation(spec, trained, "spec")
        evaluation = Evaluation(
            id=new_id("eval"),
            job_id=job_id,
            checkpoint_id=checkpoint.id,
            state=WorkState.QUEUED,
            spec=stored(spec),
            report=request.report,
            **asdict(Requirements.of_evaluation(spec, job)),
            tags=list(dict.fromkeys(request.tags)),
            priority=job.priority if request.priority is None else request.priority,
            not_before=request.not_before,
            max_attempts=request.max_attempts,
            time_limit_s=request.time_limit_s,
            idempotency_key=idempotency_key,
            idempotency_digest=digest,
            queued_at=func.now(),
        )
        session.add(evaluation)
        session.flush()
        add_event(session, evaluation, "queued", "requested")
        session.refresh(evaluation)
    return evaluation, True


def _checkpoint_of(session: Session, job_id: str, checkpoint_id: str | None) -> Checkpoint:
    """Return a checkpoint of a job, the newest if none is named. Raises ConflictError and NotFoundError."""
    if checkpoint_id is None:
        newest = newest_checkpoint(session, job_id)
        if newest is None:
            raise ConflictError(f"job {job_id} has no checkpoint yet; wait for the first", "checkpoint_id")
        return newest
    checkpoint = session.get(Checkpoint, checkpoint_id)
    if checkpoint is None or checkpoint.job_id != job_id:
        raise NotFoundError(f"job {job_id} has no checkpoint {checkpoint_id}")
    return checkpoint
