"""Studies: submission, look-up, end. Workers conduct them: they ask the sampler for trials and report results to it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any, Literal

from naospec import EvaluationSpec, TrainingSpec, plugins, read_stored, stored, validation_words
from naospec.metrics import EPISODE_METRICS, Metric, for_family
from naospec.search import Objective, SearchSpec
from pydantic import ValidationError
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from naojobs import policies
from naojobs.checkpoints import trained_checkpoint
from naojobs.database import Sessions
from naojobs.errors import ConflictError, InvalidError, NotFoundError, public, within
from naojobs.idempotency import earlier, hold_names
from naojobs.ids import new_id
from naojobs.models import PolicyRecord, Study, StudyState, Trial, TrialState
from naojobs.quotas import NO_LIMITS, SPACE, Limits, Quota, require_room, wait_for_turn
from naojobs.requests import cancel_open
from naojobs.submission import JobRequest, check_evaluation, check_fit, free_name, with_parent
from naojobs.webhooks import MessageType, publish

MAX_NAME = 200
"""Characters of a name."""
MAX_FAILURES_IN_A_ROW = 5
"""Trials in a row that may fail before the study fails."""
PARENT = ("parent_job_id", "parent_checkpoint_id", "parent_policy")
"""Fields of a request that name the policy to start from; beside its name, its checkpoint is kept (`in_use`)."""


@dataclass(frozen=True, slots=True)
class StudyRequest:
    """Study to start."""

    job: JobRequest
    """What all trials have in common; with a parent they all start from its policy."""
    search: SearchSpec
    name: str | None = None

    @property
    def display_name(self) -> str:
        """Name, or one made of the job's."""
        return self.name or f"tune-{self.job.display_name}"[:MAX_NAME]

    def digest(self) -> str:
        """Return the SHA-256 that equal requests share."""
        text = json.dumps([self.job.digest(), self.search.model_dump(mode="json"), self.name])
        return hashlib.sha256(text.encode()).hexdigest()


def submit_study(
    sessions: Sessions,
    request: StudyRequest,
    *,
    owner: str,
    idempotency_key: str | None = None,
    limits: Limits = NO_LIMITS,
    see_all: bool = False,
) -> tuple[Study, bool]:
    """Start a study of `owner`; return it and whether it is new.

    The same `idempotency_key` with the same request returns the existing study.

    Raises:
        ConflictError: the key was used for another request.
        InvalidError: a setting or an objective does not exist, a value of a setting is refused, or the policy to start
            from does not exist or does not fit all trials; `see_all` allows others' jobs.
        QuotaError: `owner` has as many studies, or jobs, as `limits` allow.
    """
    check_evaluation(request.job.evaluation, request.job.spec, "job.evaluation")
    search = request.search if request.search.elsewhere else complete(request.search, request.job)
    at_ends = []
    for name, parameter in search.space.items():
        ends = [trial_job(request.job, {name: value}, field=f"search.space.{name}") for value in parameter.ends()]
        at_ends += ends
        if search.sampler == "population":  # each may have to continue from the policy of another
            for other in ends[1:]:
                check_fit(other, ends[0].spec, field=f"search.space.{name}")
                check_fit(ends[0], other.spec, field=f"search.space.{name}")
    digest = request.digest() if idempotency_key is not None else None
    with sessions.begin() as session:
        quotas = (Quota.STUDIES, Quota.JOBS, *SPACE)
        wait_for_turn(session, owner, limits, *quotas)
        hold_names(session, owner)
        if (made := earlier(session, Study, Study.owner == owner, idempotency_key, digest)) is not None:
            return made, False
        require_room(session, owner, limits, *quotas)
        with within("job"):
            job = _with_pinned_parent(session, request.job, owner, see_all)
            for other in at_ends:
                with_parent(session, other, owner, see_all)
        study = Study(
            id=new_id("study"),
            name=free_name(session, Study, owner, request.display_name),
            owner=owner,
            spec=search.model_dump(mode="json"),
            job={
                "spec": stored(job.spec),
                "evaluation": stored(job.evaluation) if job.evaluation else None,
                "tags": list(job.tags),
                "priority": job.priority,
                "max_attempts": job.max_attempts,
                **({} if job.not_before is None else {"not_before": job.not_before.isoformat()}),
                **{name: value for name in PARENT if (value := getattr(job, name)) is not None},
            },
            state=StudyState.RUNNING,
            idempotency_key=idempotency_key,
            idempotency_digest=digest,
        )
        session.add(study)
        session.flush()
        session.refresh(study)
    return study, True


def _with_pinned_parent(session: Session, job: JobRequest, owner: str, see_all: bool) -> JobRequest:
    """Return a job whose parent is a version or a checkpoint, so that all trials start from it. Raises InvalidError."""
    job = with_parent(session, job, owner, see_all)
    if job.parent_policy is not None:
        if job.parent_checkpoint_id is not None:  # else it is a bundled one
            policies.find(session, PolicyRecord.owner == owner, job.parent_policy, keep=True)
        return replace(job, parent_job_id=None)
    if job.parent_job_id is None or job.parent_checkpoint_id is not None:
        return job
    checkpoint = trained_checkpoint(session, job.parent_job_id)
    if checkpoint is None:
        message = f"job {job.parent_job_id} has no trained checkpoint yet; wait for the first"
        raise InvalidError(message, "parent_job_id")
    return replace(job, parent_checkpoint_id=checkpoint.id)


def complete(search: SearchSpec, job: JobRequest) -> SearchSpec:
    """Return `search` with everything that the task decides. Raises InvalidError."""
    name = job.evaluation.task.name if job.evaluation and job.evaluation.task else job.spec.task.name
    task = plugins.load(plugins.TASKS, name)
    family = plugins.load(plugins.ROBOTS, job.spec.robot.name).family
    metrics = {metric.name: replace(metric, live=False) for metric in for_family(family, task.results)}
    metrics |= {metric.name: metric for metric in (*EPISODE_METRICS, *task.metrics)}
    evaluated = job.evaluation is not None
    objectives = search.objectives
    if not objectives:
        headline = [metrics[each] for each in task.presentation.headline if each in metrics]
        headline = [metric for metric in headline if evaluated or metric.live]
        objectives = [Objective(metric=headline[0].name if headline else "reward")]
    chosen = []
    for number, objective in enumerate(objectives):
        place = f"search.objectives.{number}"
        metric = metrics.get(objective.metric)
        if metric is None:
            known = ", ".join(sorted(metrics))
            raise InvalidError(f"task {name} has no metric {objective.metric!r}; choose one of {known}", place)
        if not evaluated and not metric.live:
            raise InvalidError(f"{objective.metric} comes from an evaluation; evaluate, or use another metric", place)
        better = _direction(metric)
        if objective.direction is None and better is None:
            raise InvalidError(f"{objective.metric} has no better direction; give one", f"{place}.direction")
        chosen.append(objective.model_copy(update={"direction": objective.direction or better}))
    pruning = search.pruning
    if pruning.name != "none":
        first = chosen[0].metric
        by = pruning.metric or (first if metrics[first].live else "reward")
        if by not in metrics or not metrics[by].live:
            known = ", ".join(sorted(name for name, metric in metrics.items() if metric.live))
            raise InvalidError(f"trainings report no metric {by!r}; choose one of {known}", "search.pruning.metric")
        interval = pruning.interval_steps or max(1, job.spec.planned_steps // 20)
        direction = chosen[0].direction if by == first else _direction(metrics[by])
        update = {"metric": by, "interval_steps": interval, "direction": pruning.direction or direction or "maximize"}
        pruning = pruning.model_copy(update=update)
    return search.model_copy(update={"objectives": chosen, "pruning": pruning})


def _direction(metric: Metric) -> Literal["maximize", "minimize"] | None:
    if metric.name == "reward" or metric.better == "higher":
        return "maximize"
    return "minimize" if metric.better == "lower" else None


def trial_job(job: JobRequest, params: Mapping[str, Any], *, field: str = "search.space") -> JobRequest:
    """Return the job of a trial with these settings. Raises InvalidError."""
    try:
        spec = TrainingSpec.model_validate(job.spec.written().with_settings(params))
    except KeyError as error:
        raise InvalidError(f"the training specification has no field {error.args[0]!r}", field) from None
    except ValidationError as error:
        label = ", ".join(f"{name}={value}" for name, value in params.items())
        raise InvalidError(f"{label}: {validation_words(error.errors())}", field) from None
    return replace(job, spec=spec)


def job_of(study: Study) -> JobRequest:
    """Return what all trials of a study have in common."""
    content = study.job
    evaluation = content["evaluation"]
    return JobRequest(
        spec=read_stored(TrainingSpec, content["spec"]),
        evaluation=read_stored(EvaluationSpec, evaluation) if evaluation else None,
        name=study.name,
        tags=content["tags"],
        priority=content["priority"],
        max_attempts=content["max_attempts"],
        not_before=datetime.fromisoformat(moment) if (moment := content.get("not_before")) else None,
        **{name: content.get(name) for name in PARENT},
    )


def trials_of(session: Session, study_id: str) -> list[Trial]:
    """Return the trials of a study in their order."""
    return list(session.scalars(select(Trial).where(Trial.study_id == study_id).order_by(Trial.number)))


def end(session: Session, study: Study, state: StudyState, why: str) -> None:
    """End a locked study in `state`, and the open jobs of its trials."""
    study.state = state
    study.finished_at = func.now()
    why = public(why)
    study.error = why if state is StudyState.FAILED else None
    trials = [trial for trial in trials_of(session, study.id) if trial.state is TrialState.RUNNING]
    cancel_open(session, [trial.job_id for trial in trials if trial.job_id], f"study {study.name}: {why}")
    for trial in trials:
        trial.state, trial.error = TrialState.FAILED, why
        trial.finished_at = func.now()
    data = {"study_id": study.id, "name": study.name, "state": str(state), "error": study.error}
    publish(session, study.owner, MessageType.STUDY_FINISHED, data)


def cancel_study(sessions: Sessions, study_id: str) -> Study:
    """Cancel a study and its open jobs; a second request changes nothing.

    Raises NotFoundError, and ConflictError if the study has finished or failed.
    """
    with sessions.begin() as session:
        study = _locked(session, study_id)
        if study.state is StudyState.RUNNING:
            end(session, study, StudyState.CANCELLED, "cancelled by a user")
        elif study.state is not StudyState.CANCELLED:
            raise ConflictError(f"study {study_id} has already {study.state}; there is nothing to cancel")
        session.flush()
        session.refresh(study)
    return study


def extend_study(sessions: Sessions, study_id: str, trials: int, *, limits: Limits = NO_LIMITS) -> Study:
    """Give a study `trials` trials in all; one that has ended runs again, with what its sampler has learned.

    Raises NotFoundError, InvalidError if it has had as many trials or the search does not allow that number, and
    QuotaError if its owner has as many jobs, bytes or rows as `limits` allow.
    """
    with sessions.begin() as session:
        owner = session.scalar(select(Study.owner).where(Study.id == study_id))
        wait_for_turn(session, owner, limits, Quota.JOBS, *SPACE)
        study = _locked(session, study_id)
        started = session.scalar(select(func.count()).select_from(Trial).where(Trial.study_id == study_id)) or 0
        if trials <= started:
            raise InvalidError(f"study {study.name} has started {started} trials; give a higher number", "trials")
        try:
            study.spec = SearchSpec.model_validate({**study.spec, "trials": trials}).model_dump(mode="json")
        except ValidationError as error:
            raise InvalidError(validation_words(error.errors()), "trials") from None
        require_room(session, study.owner, limits, Quota.JOBS, *SPACE)
        study.state, study.error, study.finished_at = StudyState.RUNNING, None, None
        study.extended_at = started
        session.flush()
        session.refresh(study)
    return study


def ask(sessions: Sessions, study_id: str) -> tuple[Trial, JobRequest]:
    """Take a trial of a study whose trials run elsewhere; return it with the training that it stands for.

    Raises NotFoundError, and ConflictError if its trials are jobs, if none waits to be taken, or if this version cannot
    read the study.
    """
    with sessions.begin() as session:
        study = _elsewhere(session, study_id)
        if study.state is not StudyState.RUNNING:
            raise ConflictError(f"study {study.name} is {study.state}; it has no more trials")
        free = (Trial.study_id == study_id, Trial.state == TrialState.RUNNING, Trial.asked_at.is_(None))
        trial = session.scalar(select(Trial).where(*free).order_by(Trial.number).limit(1))
        if trial is None:
            raise ConflictError("no trial waits to be taken; report those that are taken, or ask again in some seconds")
        try:
            job = trial_job(job_of(study), trial.params)
        except (ValidationError, plugins.BrokenPluginError) as error:
            words = validation_words(error.errors()) if isinstance(error, ValidationError) else str(error)
            raise ConflictError(f"study {study.name} does not fit this version: {words}; start a new one") from None
        trial.asked_at = func.now()
        session.flush()
        session.refresh(trial)
        return trial, job


def tell(
    sessions: Sessions, study_id: str, number: int, *, values: Sequence[float] | None = None, error: str | None = None
) -> Trial:
    """Report the values of a trial that has run elsewhere, in the order of the objectives, or why it has none.

    A worker hands them to the sampler within seconds; the same report again changes nothing.

    Raises NotFoundError, InvalidError for another number of values, and ConflictError if the study's trials are jobs,
    if the trial is not taken, or if other values were reported.
    """
    with sessions.begin() as session:
        study = _elsewhere(session, study_id)
        wanted = SearchSpec.model_validate(study.spec).objectives
        if values is not None and len(values) != len(wanted):
            names = ", ".join(objective.metric for objective in wanted)
            raise InvalidError(f"expected {len(wanted)} values ({names}), got {len(values)}", "values")
        trial = session.get(Trial, (study_id, number))
        if trial is None:
            raise NotFoundError(f"study {study_id} has no trial {number}")
        reported = trial.values is not None or trial.error is not None
        if reported and (trial.values, trial.error) != (None if values is None else list(values), error):
            if trial.values is None and study.state is not StudyState.RUNNING:
                raise ConflictError(f"study {study.name} is {study.state}; extend it to continue")
            raise ConflictError(f"trial {number} was reported already")
        if trial.asked_at is None:
            raise ConflictError(f"trial {number} is not taken; ask for it first")
        if not reported:
            trial.values, trial.error = None if values is None else list(values), error
        session.flush()
        session.refresh(trial)
    return trial


def _elsewhere(session: Session, study_id: str) -> Study:
    study = _locked(session, study_id)
    if not study.spec.get("elsewhere"):
        raise ConflictError(f"the trials of study {study.name} are jobs; workers run them")
    return study


def delete_study(sessions: Sessions, study_id: str) -> None:
    """Delete a study that has ended; its jobs stay. Raises NotFoundError, and ConflictError if it has not ended."""
    with sessions.begin() as session:
        study = _locked(session, study_id)
        if study.state is StudyState.RUNNING:
            raise ConflictError(f"study {study_id} is running; cancel it first")
        session.delete(study)


def _locked(session: Session, study_id: str) -> Study:
    study = session.scalar(select(Study).where(Study.id == study_id).with_for_update())
    if study is None:
        raise NotFoundError(f"no study {study_id}")
    return study


def pareto_front(search: SearchSpec, trials: Iterable[Trial]) -> list[int]:
    """Return the numbers of the complete trials that no other one beats, the best one where there is one objective."""
    signs = [1.0 if objective.direction == "maximize" else -1.0 for objective in search.objectives]
    points = {
        trial.number: [factor * value for factor, value in zip(signs, trial.values, strict=True)]
        for trial in trials
        if trial.state is TrialState.COMPLETE and trial.values is not None
    }

    def beaten(point: list[float]) -> bool:
        return any(
            other != point and all(a >= b for a, b in zip(other, point, strict=True)) for other in points.values()
        )

    return [number for number, point in points.items() if not beaten(point)]
