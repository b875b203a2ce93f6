"""Registered policies."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from naojobs.policies import Registration, check_alias
from naojobs.promotion import MOST_REQUIREMENTS, Requirement
from pydantic import AfterValidator, BaseModel, Field, StringConstraints

from naosprint_api.patterns import ALIAS, TEXT
from naosprint_api.schemas.common import FilePublic, Id, Page, RequestBody, TrainingDocument

Alias = Annotated[str, StringConstraints(pattern=ALIAS), AfterValidator(check_alias)]


class VersionCreate(RequestBody):
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


class AliasSet(RequestBody):
    """Version that an alias is to name."""

    version: int = Field(ge=1, le=2**31 - 1, description="Number of the version.")


class RequirementsSet(RequestBody):
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
