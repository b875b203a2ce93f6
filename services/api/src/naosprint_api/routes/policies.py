"""Bundled policies: their cards, and a replay of each."""

from __future__ import annotations

from typing import Annotated, Any

import naopolicies
from fastapi import APIRouter, Path
from fastapi.responses import FileResponse
from naojobs.errors import NotFoundError
from pydantic import BaseModel, Field

from naosprint_api.dependencies import Reader
from naosprint_api.patterns import POLICY
from naosprint_api.problems import responses

router = APIRouter(tags=["policies"])

_READ = responses(401, 403, 404, 422, 429, 503)

Name = Annotated[str, Path(pattern=POLICY, description="Name of a bundled policy.")]


class PolicyCard(BaseModel):
    """Bundled policy: its training and its evaluation."""

    name: str
    summary: str
    robot: str
    task: str
    steps: int = Field(description="Environment steps of its training, over all jobs of its lineage.")
    training_s: float = Field(description="Seconds of training.")
    episodes: int = Field(description="Episodes of its evaluation.")
    results: list[dict[str, Any]] = Field(description="Results of the evaluation, with titles and units.")
    headline: list[str] = Field(description="Names of the most important results.")
    tables: list[dict[str, Any]] = Field(description="Results that vary with a quantity.")
    evaluation: dict[str, Any] = Field(description="Specification of the evaluation.")
    lineage: list[dict[str, Any]] = Field(description="The jobs behind it, first to last, with their curves.")
    motion: dict[str, dict[str, float]] = Field(
        default={}, description="Peaks of joint speed, foot force and contact depth, running and standing."
    )
    robustness: list[dict[str, Any]] = Field(default=[], description="Headline results under each disturbance.")


class Policy(PolicyCard):
    """Bundled policy with the specification that it was trained by."""

    spec: dict[str, Any] = Field(description="Specification of the last job of the lineage.")


@router.get("/policies", responses=responses(401, 403, 422, 429, 503))
def list_policies(principal: Reader) -> list[PolicyCard]:
    """List the bundled policies."""
    del principal
    return [PolicyCard.model_validate(naopolicies.card(name)) for name in naopolicies.names()]


@router.get("/policies/{name}", responses=_READ)
def get_policy(name: Name, principal: Reader) -> Policy:
    """Look up one bundled policy."""
    del principal
    return Policy.model_validate({**naopolicies.card(_known(name)), "spec": naopolicies.spec(name)})


@router.get("/policies/{name}/replay", response_class=FileResponse, responses=_READ)
def get_policy_replay(name: Name, principal: Reader) -> FileResponse:
    """Return one episode of a bundled policy, in the format of an evaluation's replay.json."""
    del principal
    return FileResponse(naopolicies.folder(_known(name)) / naopolicies.REPLAY, media_type="application/json")


def _known(name: str) -> str:
    if name not in naopolicies.names():
        known = ", ".join(naopolicies.names()) or "none"
        raise NotFoundError(f"there is no policy {name!r}; bundled policies are {known}")
    return name
