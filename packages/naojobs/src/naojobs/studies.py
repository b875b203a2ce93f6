"""Studies: submission, look-up, end. Workers conduct them: they ask the sampler for trials and report results to it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from naospec import EvaluationSpec, TrainingSpec, plugins, read_stored, stored, validation_words
from naospec.metrics import EPISODE_METRICS, Metric
from naospec.search import Objective, SearchSpec
from pydantic import ValidationError
from sqlalchemy import func, select
from sqlalchemy.dialects.postgresql import insert
from sqlalchemy.orm import Session

from naojobs.database import Sessions
from naojobs.errors import ConflictError, InvalidError, NotFoundError
from naojobs.ids import new_id
from naojobs.models import Study, StudyState, Trial, TrialState
from naojobs.quotas import NO_LIMITS, Limits, Quota, require_room
from naojobs.requests import cancel_open
from naojobs.submission import JobRequest, check_evaluation, check_fit, free_name, same_request
from naojobs.webhooks import MessageType, publish

MAX_FAILURES_IN_A_ROW = 5
"""Trials in a row that may fail before the study fails."""


@dataclass(frozen=True, slots=True)
class StudyRequest:
    """Study to start."""

    job: JobRequest
    """What all trials have in common; its parent fields are not used."""
    search: SearchSpec
    name: str | None = None

    @property
    def display_name(self) -> str:
        """Name, or one made of the job's."""
        return self.name or f"tune-{self.job.display_name}"

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
) -> tuple[Study, bool]:
    """Start a study of `owner`; return it and whether it is new.

    The same `idempotency_key` with the same request returns the existing study.

    Raises:
        ConflictError: the key was used for another request.
        InvalidError: a setting or an objective does not exist, or a value of a setting is refused.
        QuotaError: `owner` has as many studies, or jobs, as `limits` allow.
    """
    check_evaluation(request.job.evaluation, request.job.spec, "job.evaluation")
    search = complete(request.search, request.job)
    for name, parameter in search.space.items():
        ends = [trial_job(request.job, {name: value}, field=f"search.space.{name}") for value in parameter.ends()]
        if search.sampler == "population":  # each may have to continue from the policy of another
            for other in ends[1:]:
                check_fit(other, ends[0].spec, field=f"search.space.{name}")
    digest = request.digest() if idempotency_key is not None else None
    same_key = (Study.owner == owner, Study.idempotency_key == idempotency_key)
    job = request.job
    with sessions.begin() as session:
        if idempotency_key is None or session.scalar(select(Study.id).where(*same_key)) is None:
            require_room(session, owner, limits, Quota.STUDIES, Quota.JOBS)
        study_id = session.scalar(
            insert(Study)
            .values(
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
                },
                state=StudyState.RUNNING,
                idempotency_key=idempotency_key,
                idempotency_digest=digest,
            )
            .on_conflict_do_nothing(index_elements=[Study.owner, Study.idempotency_key])
            .returning(Study.id)
        )
        if study_id is not None:
            return session.get_one(Study, study_id), True
        earlier = session.scalar(select(Study).where(*same_key))
        if earlier is None:
            raise ConflictError("a study with this key was deleted just now; send the request again", "Idempotency-Key")
        return same_request(earlier, digest), False


def complete(search: SearchSpec, job: JobRequest) -> SearchSpec:
    """Return `search` with everything that the task decides. Raises InvalidError."""
    name = job.evaluation.task.name if job.evaluation and job.evaluation.task else job.spec.task.name
    task = plugins.load(plugins.TASKS, name)
    metrics = {metric.name: replace(metric, live=False) for metric in task.results}
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
    )


def trials_of(session: Session, study_id: str) -> list[Trial]:
    """Return the trials of a study in their order."""
    return list(session.scalars(select(Trial).where(Trial.study_id == study_id).order_by(Trial.number)))


def end(session: Session, study: Study, state: StudyState, why: str) -> None:
    """End a locked study in `state`, and the open jobs of its trials."""
    study.state = state
    study.finished_at = func.now()
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
