"""The policies in the box: their cards, and a run of each to look at."""

from __future__ import annotations

from typing import Annotated, Any

import naopolicies
from fastapi import APIRouter, Path
from fastapi.responses import FileResponse
from naojobs.errors import NotFoundError
from naospec import TrainingSpec
from pydantic import BaseModel, Field

from naosprint_api.dependencies import Reader
from naosprint_api.problems import responses

router = APIRouter(tags=["policies"])

_READ = responses(401, 403, 404, 422, 429, 503)

Name = Annotated[str, Path(pattern="^[a-z0-9-]{1,60}$", description="Name of a shipped policy.")]


class PolicyCard(BaseModel):
    """Says what a shipped policy is, how it came about and how good it is."""

    name: str
    summary: str
    robot_type: int
    task: str
    steps: int = Field(description="Environment steps that it was trained for, over all jobs of its lineage.")
    training_s: int = Field(description="Seconds that they took.")
    figures: dict[str, Any] = Field(description="Figures as an evaluation's summary has them.")
    both_feet_off_ground: dict[str, Any]
    evaluation: dict[str, Any] = Field(description="How it was judged.")
    lineage: list[dict[str, Any]] = Field(description="The jobs behind it, first to last, with their curves.")


class Policy(PolicyCard):
    """A shipped policy with the specification that it was trained by."""

    spec: TrainingSpec = Field(description="What the last job of the lineage was told.")


@router.get("/policies", responses=responses(401, 403, 422, 429, 503))
def list_policies(principal: Reader) -> list[PolicyCard]:
    """List the shipped policies."""
    del principal
    return [PolicyCard.model_validate(naopolicies.card(name)) for name in naopolicies.names()]


@router.get("/policies/{name}", responses=_READ)
def get_policy(name: Name, principal: Reader) -> Policy:
    """Look up one shipped policy."""
    del principal
    return Policy.model_validate({**naopolicies.card(_known(name)), "spec": naopolicies.spec(name)})


@router.get("/policies/{name}/replay", response_class=FileResponse, responses=_READ)
def get_policy_replay(name: Name, principal: Reader) -> FileResponse:
    """Return one episode of a shipped policy as it looked, in the format of an evaluation's replay.json."""
    del principal
    return FileResponse(naopolicies.folder(_known(name)) / naopolicies.REPLAY, media_type="application/json")


def _known(name: str) -> str:
    if name not in naopolicies.names():
        known = ", ".join(naopolicies.names()) or "none"
        raise NotFoundError(f"there is no policy {name!r}; those in the box: {known}")
    return name
