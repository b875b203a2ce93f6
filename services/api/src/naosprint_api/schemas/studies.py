"""Studies and their trials."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Self

from naojobs.models import StudyState, TrialState
from naospec.search import SearchSpec
from pydantic import Field, FiniteFloat, StringConstraints, model_validator

from naosprint_api.patterns import TEXT
from naosprint_api.schemas.common import Page, RequestBody, RowView
from naosprint_api.schemas.jobs import JobCreate, Name


class StudyCreate(RequestBody):
    """Search for settings to start."""

    name: Name | None = Field(None, description="Name; left out: made of the job's.")
    job: JobCreate = Field(description="What all trials have in common.")
    search: SearchSpec = Field(description="What to vary and to optimize, how to sample and when to prune.")

    @model_validator(mode="after")
    def _starts_here(self) -> Self:
        if self.search.elsewhere and self.job.not_before is not None:
            raise ValueError("job.not_before: trials that run elsewhere start when they are taken; leave it out")
        return self


class TrialPublic(RowView):
    """Trial of a study."""

    number: int
    job_id: str | None = Field(
        description="Null if it runs elsewhere, if its settings were refused or if its job was deleted."
    )
    state: TrialState
    params: dict[str, Any] = Field(description="The settings that were chosen.")
    values: list[float] | None = Field(
        description="Values of the objectives; null until it is complete, or reported from elsewhere."
    )
    asked_at: datetime | None = Field(description="When it was taken to run it elsewhere.")
    error: str | None = Field(description="Why it was pruned or has failed.")
    created_at: datetime
    finished_at: datetime | None


class TrialAsked(TrialPublic):
    """Trial to run elsewhere."""

    spec: dict[str, Any] = Field(description="The training with the settings that were chosen.")


class TrialTell(RequestBody):
    """Result of a trial that has run elsewhere."""

    values: list[FiniteFloat] | None = Field(None, max_length=4, description="Values, in the order of the objectives.")
    error: Annotated[str, StringConstraints(min_length=1, max_length=2000, pattern=TEXT)] | None = Field(
        None, description="Why it has no values."
    )

    @model_validator(mode="after")
    def _one_result(self) -> Self:
        if (self.values is None) == (self.error is None):
            raise ValueError("values: give values or an error")
        return self


class StudyExtend(RequestBody):
    """Extension of a study."""

    trials: int = Field(ge=1, le=1000, description="Number of trials in all.")


class StudyPublic(RowView):
    """Study: a search for the best settings of a training."""

    id: str = Field(description="Also the group of its jobs.")
    name: str
    owner: str
    state: StudyState
    error: str | None = Field(description="Why it failed.")
    spec: dict[str, Any] = Field(description="Its search, with everything that the task decides.")
    job: dict[str, Any] = Field(description="What all trials have in common.")
    importance: dict[str, dict[str, float]] = Field(
        description="Importance of each setting by objective (PED-ANOVA); empty for fewer than 5 complete trials."
    )
    created_at: datetime
    finished_at: datetime | None


class StudyDetails(StudyPublic):
    """Study with its trials."""

    trials: list[TrialPublic]
    best: list[int] = Field(description="The best complete trial; with several objectives, those of the Pareto front.")


class StudyPage(Page[StudyPublic]):
    """Page of studies, newest first."""
