"""What a version of a policy needs before an alias names it: results of evaluations under conditions of a team.

A requirement is about one result: a bound, or that it is not worse than that of the version which the alias names now.
It counts evaluations of the version's own checkpoint under exactly its conditions, so that a team can require few falls
on a slippery floor, and speed on a normal one. The result `match` is that of a match with a sequential test against the
version which the alias names now, by teams that are equal but for this policy.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Self

from naospec import EvaluationSpec, TrainingSpec, plugins, read_stored, validation_words
from naospec.metrics import for_family
from naospec.teams import ROBOT, SKILLS
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError, model_validator
from pydantic_core import PydanticCustomError
from sqlalchemy import select
from sqlalchemy.orm import Session

from naojobs.errors import ConflictError, InvalidError, NotFoundError
from naojobs.lineage import trained_by
from naojobs.models import Evaluation, Match, PolicyAlias, PolicyRecord, PolicyVersion
from naojobs.states import WorkState

MAX_ALIASES = 20
"""Most aliases of a policy, and most with requirements: a request changes all of them."""

MOST_REQUIREMENTS = 50
"""Largest number of requirements of one alias."""

SETTING = r"^[a-z][a-z0-9_]{0,59}$"
"""Name of a result, or of a setting of a task."""

MATCH = "match"
"""Result of a match against the version that the alias names now."""

Plain = Annotated[str, StringConstraints(pattern=SETTING)]


class Requirement(BaseModel):
    """One result that a version needs."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    result: Plain = Field(description="Name of a result, for example fall_rate.")
    most: float | None = Field(None, allow_inf_nan=False, description="Largest value that passes; shares as 0 to 1.")
    least: float | None = Field(None, allow_inf_nan=False, description="Smallest value that passes.")
    no_worse: bool = Field(
        False, description="Whether the interval may not lie on the worse side of that of the alias's present version."
    )
    episodes: int = Field(100, ge=1, le=1_000_000, description="Episodes that the evaluation needs at least.")
    simulator: Annotated[str, StringConstraints(max_length=40)] | None = Field(
        None, description="Where the episodes have to run; left out: where the policy was trained."
    )
    conditions: dict[Plain, bool | int | float | str] = Field(
        default_factory=dict,
        max_length=20,
        description="Settings of the task in the evaluation, for example friction_min; none: as trained, undisturbed.",
    )

    @model_validator(mode="after")
    def _says_something(self) -> Self:
        if self.most is None and self.least is None and not self.no_worse:
            raise PydanticCustomError("empty", "{result}: give most, least or no_worse", {"result": self.result})
        bounds = (self.most, self.least, self.simulator)
        if self.result == MATCH and (any(each is not None for each in bounds) or self.conditions):
            raise PydanticCustomError("match", "match: give no_worse alone; a match has no bound and no conditions")
        return self

    def specification(self, task: str) -> EvaluationSpec:
        """Return the evaluation that it is about.

        Raises:
            pydantic.ValidationError: if the task has not these settings.
        """
        section = {"name": task, **self.conditions} if self.conditions else None
        return EvaluationSpec(episodes=self.episodes, simulator=self.simulator, task=section)

    def __str__(self) -> str:
        """Return it in words: ``fall_rate <= 0.03 with friction_min=0.6``."""
        limits = (("<=", self.most), (">=", self.least))
        bounds = [f"{sign} {value:g}" for sign, value in limits if value is not None]
        bounds += ["not worse than now"] * self.no_worse
        settings = " ".join(f"{name}={value}" for name, value in sorted(self.conditions.items()))
        place = f" in simulator {self.simulator}" * (self.simulator is not None)
        return f"{self.result} {' and '.join(bounds)}{f' with {settings}' * bool(settings)}{place}"


def require(session: Session, policy: PolicyRecord, alias: str, requirements: Sequence[Requirement]) -> None:
    """Replace what an alias requires; an empty sequence removes it.

    Raises:
        InvalidError: if the policy's task has not the result or the settings of a condition, if its robot cannot meet
            it, or if `MAX_ALIASES` others have requirements.
        NotFoundError: if all versions were deleted.
        ConflictError: if the specification of the newest version cannot be read.
    """
    newest = session.scalar(
        select(PolicyVersion).where(PolicyVersion.policy_id == policy.id).order_by(PolicyVersion.number.desc()).limit(1)
    )
    if newest is None:
        raise NotFoundError(f"there is no policy {policy.name!r}")
    if requirements:
        _require_possible(newest, requirements)
    others = {name: kept for name, kept in policy.requirements.items() if name != alias}
    if requirements and len(others) >= MAX_ALIASES:
        raise InvalidError(f"{len(others)} other aliases have requirements, of {MAX_ALIASES}; remove some", "alias")
    wanted = {alias: [each.model_dump(mode="json") for each in requirements]} if requirements else {}
    policy.requirements = {**others, **wanted}


def _require_possible(version: PolicyVersion, requirements: Sequence[Requirement]) -> None:
    """Raise InvalidError for a requirement that no version like this one could meet."""
    trained = _trained(version)
    task, family = plugins.load(plugins.TASKS, trained.stage_specs[-1].task.name), trained.stage_specs[-1].family
    metrics = {metric.name: metric for metric in (*task.metrics, *for_family(family, task.results))}
    for number, requirement in enumerate(requirements):
        if requirement.result == MATCH:
            if _skill(version) is None:
                tasks = ", ".join(task for task, _ in SKILLS.values())
                message = f"{MATCH}: teams have no such skill; a skill is a {ROBOT}'s policy for task {tasks}"
                raise InvalidError(message, f"requirements.{number}")
            continue
        metric = metrics.get(requirement.result)
        if metric is None:
            message = (
                f"task {task.name} has no result {requirement.result!r}; choose one of {', '.join(sorted(metrics))}"
            )
            raise InvalidError(message, f"requirements.{number}.result")
        if requirement.no_worse and metric.better is None:
            message = f"{requirement.result} has no better direction; give most or least instead"
            raise InvalidError(message, f"requirements.{number}.no_worse")
        try:
            requirement.specification(trained.stage_specs[-1].task.name).applied_to(trained)
        except ValidationError as error:
            problem = error.errors()[0]
            place = ".".join(str(part) for part in problem["loc"])
            raise InvalidError(f"{requirement.result}: {place}: {problem['msg']}", f"requirements.{number}") from None


def requirements_of(policy: PolicyRecord, alias: str) -> list[Requirement]:
    """Return what an alias requires."""
    return [Requirement.model_validate(each) for each in policy.requirements.get(alias, [])]


def check(session: Session, policy: PolicyRecord, alias: str, version: PolicyVersion) -> None:
    """Check that a version has what an alias requires.

    Raises:
        ConflictError: naming every requirement that it does not meet, its value, and what to run where it is missing;
            or a stored specification or requirement that cannot be read.
    """
    now = session.get(PolicyAlias, (policy.id, alias))
    before = None if now is None else session.get(PolicyVersion, (policy.id, now.number))
    unmet = [
        text
        for requirement in requirements_of(policy, alias)
        if (text := _unmet(session, policy, requirement, version, before)) is not None
    ]
    if unmet:
        raise ConflictError(f"{policy.name}@{version.number} cannot be {alias}: {'; '.join(unmet)}", "version")


def _unmet(
    session: Session,
    policy: PolicyRecord,
    requirement: Requirement,
    version: PolicyVersion,
    before: PolicyVersion | None,
) -> str | None:
    """Return what is missing or wrong; None if the requirement is met."""
    if requirement.result == MATCH:
        new = before is not None and before.number != version.number
        return _lost_match(session, policy, version, before) if before is not None and new else None
    result = _result(session, requirement, version)
    if result is None:
        return f"{requirement}: no evaluation of {requirement.episodes:,} episodes or more says so; run one"
    value = float(result["value"])
    if requirement.most is not None and value > requirement.most:
        return f"{requirement}: it is {value:g}"
    if requirement.least is not None and value < requirement.least:
        return f"{requirement}: it is {value:g}"
    if requirement.no_worse and before is not None and before.number != version.number:
        standing = _result(session, requirement, before)
        if standing is None:
            return f"{requirement}: version {before.number}, which it names now, has no such evaluation; run one"
        if not (result.get("interval") and standing.get("interval")):
            return f"{requirement}: evaluations give {requirement.result} no interval; require most or least instead"
        if _worse(result, standing):
            return f"{requirement}: it is {value:g}, that of version {before.number} is {standing['value']:g}"
    return None


def _lost_match(session: Session, policy: PolicyRecord, version: PolicyVersion, before: PolicyVersion) -> str | None:
    """Return why a version may lose to another; None if the newest match with a test says that it does not."""
    skill = _skill(version)
    first, second = (f"example:{skill}={policy.name}@{each.number}" for each in (version, before))
    plays = Match.spec["teams"].contains([{"policies": {skill: version.checkpoint_id}}])
    rows = session.execute(
        select(Match.id, Match.spec, Match.summary)
        .where(Match.state == WorkState.SUCCEEDED, Match.spec["gate"].as_boolean(), plays)
        .order_by(Match.finished_at.desc())
    )
    for match_id, spec, summary in rows:
        ours, theirs = (team["policies"] for team in spec["teams"])
        if ours.get(skill) == version.checkpoint_id and theirs == {**ours, skill: before.checkpoint_id}:
            return None if summary["holds"] else f"{MATCH}: {first} {summary['verdict']} against {second} ({match_id})"
    return f"{MATCH}: none says that {first} does not lose; run: naoctl match {first} {second} --games 60 --gate"


def _skill(version: PolicyVersion) -> str | None:
    """Return which skill of the example player a version is; None if it is none."""
    spec = _trained(version).stage_specs[-1]
    fits = (skill for skill, (task, _) in SKILLS.items() if task == spec.task.name and spec.robot.name == ROBOT)
    return next(fits, None)


def _trained(version: PolicyVersion) -> TrainingSpec:
    """Return the specification of a version. Raises ConflictError if this version of the service cannot read it."""
    spec = trained_by(version)
    if spec is None:
        message = f"the specification of version {version.number} cannot be read any more; register a newer version"
        raise ConflictError(message, "version")
    return spec


def _worse(result: dict[str, Any], standing: dict[str, Any]) -> bool:
    """Return whether a result's interval lies on the worse side of another's; both have one."""
    (low, high), (standing_low, standing_high) = result["interval"], standing["interval"]
    lower_is_better = result.get("better") == "lower"
    return bool(low > standing_high if lower_is_better else high < standing_low)


def _result(session: Session, requirement: Requirement, version: PolicyVersion) -> dict[str, Any] | None:
    """Return the result of the newest evaluation of a version that the requirement is about."""
    trained = _trained(version)
    try:
        wanted = _conditions(requirement.specification(trained.stage_specs[-1].task.name), trained)
    except ValidationError as error:
        words = validation_words(error.errors())
        raise ConflictError(f"{requirement}: {words}; replace this requirement", "requirements") from None
    rows = session.execute(
        select(Evaluation.spec, Evaluation.summary)
        .where(Evaluation.checkpoint_id == version.checkpoint_id, Evaluation.state == WorkState.SUCCEEDED)
        .order_by(Evaluation.created_at.desc())
    )
    for document, summary in rows:
        try:
            spec = read_stored(EvaluationSpec, document)
            conditions = _conditions(spec, trained)
        except (ValidationError, plugins.BrokenPluginError):
            continue  # of plug-ins that are gone
        if conditions != wanted or spec.episodes < requirement.episodes:
            continue
        for result in (summary or {}).get("results", []):
            if result["name"] == requirement.result and result.get("value") is not None:
                found: dict[str, Any] = result
                return found
    return None


def _conditions(spec: EvaluationSpec, trained: TrainingSpec) -> tuple[Any, ...]:
    """Return what has to be equal in two evaluations for their results, and their intervals, to compare."""
    run = spec.applied_to(trained)
    return run.task, run.simulator, spec.deterministic, spec.confidence
