"""Catalog for jobs: the installed plug-ins with their settings, presets, recipes."""

from __future__ import annotations

import functools
import hashlib
import json
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from naospec import plugins, presets, recipes
from naospec.sections import variants
from pydantic import BaseModel, Field

from naosprint_api.dependencies import CountedRoute
from naosprint_api.problems import responses
from naosprint_api.schemas.jobs import JobCreate

router = APIRouter(tags=["catalog"], route_class=CountedRoute)


class MetricPublic(BaseModel):
    """Metric of an episode or of an update, as user interfaces show it."""

    name: str = Field(description="Its column in rows of metrics, its name in results.")
    title: str
    unit: str = Field(description="Empty for none; % means that the value is a fraction.")
    description: str
    digits: int = Field(description="Decimals to show.")
    better: str | None = Field(description="Which direction is better: higher, lower, or null.")
    kind: str = Field(description="mean: a number per episode; rate: a yes or no per episode.")
    live: bool = Field(description="Whether trainings report it; otherwise only evaluations do.")
    families: list[str] | None = Field(description="Families of the robots that have it; null for all.")


class ChartPublic(BaseModel):
    """Metrics that belong in one plot over the steps of a training."""

    title: str
    metrics: list[str]


class EndPublic(BaseModel):
    """Reason for which an episode ends."""

    name: str
    title: str
    failure: bool


class ReferencePublic(BaseModel):
    """Value to compare a metric with."""

    metric: str
    value: float
    title: str
    families: list[str] | None = Field(description="Families of the robots that it applies to; null for all.")


class FieldLinePublic(BaseModel):
    """Line across the field."""

    x_m: float
    title: str


class TaskPublic(BaseModel):
    """Installed task."""

    name: str
    version: int
    summary: str
    metrics: list[MetricPublic]
    results: list[MetricPublic] = Field(description="What only evaluations report.")
    ends: list[EndPublic]
    skill: str = Field(description="What it teaches; tasks with the same are listed together. Empty for its name.")
    charts: list[ChartPublic] = Field(description="Learning curves, the most important first.")
    listed: list[str] = Field(description="Live metrics in lists of jobs, the most important first.")
    headline: list[str] = Field(description="Results of an evaluation in summaries, the most important first.")
    references: list[ReferencePublic]
    lines: list[FieldLinePublic] = Field(description="Lines to draw across the field.")
    parameters: dict[str, Any] = Field(description="JSON schema of its settings.")


class AlgorithmPublic(BaseModel):
    """Installed learning algorithm."""

    name: str
    summary: str
    metrics: list[MetricPublic]
    charts: list[ChartPublic]
    parameters: dict[str, Any] = Field(description="JSON schema of its settings.")


class GoalPublic(BaseModel):
    """Goal of a field, metres."""

    width_m: float
    height_m: float
    depth_m: float
    post_radius_m: float


class FieldPublic(BaseModel):
    """Field of a league, metres; the origin is its middle."""

    name: str = Field(description="Server that has it.")
    length_m: float
    width_m: float
    line_width_m: float
    circle_radius_m: float
    lines: list[tuple[float, float, float, float]] = Field(description="x and y of both ends of each straight line.")
    penalty_spot_m: float = Field(description="Distance of the penalty spot from the goal line; 0 without one.")
    goal: GoalPublic
    ball_radius_m: float


class RobotPublic(BaseModel):
    """Installed robot."""

    name: str
    family: str = Field(description="Robots that share simulators, observations and values of presets.")
    title: str
    joints: list[str] = Field(description="Names of its joints, in the order of commands.")
    standing_height_m: float
    front_axis: int = Field(description="Axis of the torso's frame that points to its front: 0 for x, 1 for y.")
    field: FieldPublic = Field(description="Field of its league.")
    parameters: dict[str, Any] = Field(description="JSON schema of its settings.")


class SimulatorVariant(BaseModel):
    """Settings of a simulator for some robots."""

    robots: list[str]
    parameters: dict[str, Any] = Field(description="JSON schema of its settings.")


class SimulatorPublic(BaseModel):
    """Installed simulator."""

    name: str
    summary: str
    variants: list[SimulatorVariant] = Field(description="The robots that it can run, with its settings for them.")


class PresetPublic(BaseModel):
    """Named values for settings that a specification leaves out."""

    name: str
    summary: str
    algorithm: dict[str, Any]
    task: dict[str, Any]
    robots: dict[str, dict[str, dict[str, Any]]] = Field(description="Values in place of these, by robot family.")


class RecipePublic(BaseModel):
    """Tested job."""

    name: str
    summary: str
    job: dict[str, Any] = Field(description="Body for `POST /jobs`.")


@router.get(
    "/spec/schema",
    response_class=Response,
    responses={
        200: {"description": "The schema", "content": {"application/json": {"schema": {"type": "object"}}}},
        304: {"description": "Unchanged: the request has the schema's ETag in If-None-Match"},
    },
)
def spec_schema(request: Request) -> Response:
    """Get the JSON schema of the body of `POST /jobs`, for forms and editors.

    A section that a plug-in defines is a `oneOf` with one schema for each installed plug-in, distinguished by the
    constant `name`; `x-robots` lists the robots to which the schema of a simulator or task applies, `x-provides` what
    each robot has with it. A setting whose `needs` is not provided has to keep its default. Presets do not change the
    default of a setting with `own`, which a plug-in declares itself.
    """
    content = _schema_content()
    etag = f'"{hashlib.sha256(content).hexdigest()[:32]}"'
    if request.headers.get("if-none-match") == etag:
        return Response(status_code=304, headers={"ETag": etag})
    return Response(content, media_type="application/json", headers={"ETag": etag})


@functools.cache
def _schema_content() -> bytes:
    return json.dumps(JobCreate.model_json_schema()).encode()


@router.get("/tasks")
def list_tasks() -> list[TaskPublic]:
    """List the installed tasks with their metrics and settings."""
    return [
        TaskPublic.model_validate({**task.describe(), "parameters": task.Parameters.model_json_schema()})
        for _, task in plugins.usable(plugins.TASKS)
    ]


@router.get("/algorithms")
def list_algorithms() -> list[AlgorithmPublic]:
    """List the installed learning algorithms with their metrics and settings."""
    return [
        AlgorithmPublic.model_validate({**kind.describe(), "parameters": kind.Parameters.model_json_schema()})
        for _, kind in plugins.usable(plugins.LEARNERS)
    ]


@router.get("/robots")
def list_robots() -> list[RobotPublic]:
    """List the installed robots with their settings."""
    return [
        RobotPublic.model_validate({**robot.describe(), "parameters": type(robot.parameters).model_json_schema()})
        for _, robot in plugins.usable(plugins.ROBOTS)
    ]


@router.get("/simulators")
def list_simulators() -> list[SimulatorPublic]:
    """List the installed simulators with the robots that they can run."""
    found = list(variants(plugins.SIMULATORS))
    return [
        SimulatorPublic(
            name=kind.name,
            summary=kind.summary,
            variants=[
                SimulatorVariant(robots=list(robots), parameters=model.model_json_schema())
                for name, model, robots in found
                if name == kind.name
            ],
        )
        for _, kind in plugins.usable(plugins.SIMULATORS)
    ]


@router.get("/presets")
def list_presets() -> list[PresetPublic]:
    """List the presets with their values."""
    return [
        PresetPublic.model_validate({"algorithm": {}, "task": {}, "robots": {}, **presets.read(name), "name": name})
        for name in presets.names()
    ]


@router.get("/recipes", responses=responses(422))
def list_recipes(
    start: Annotated[
        str | None,
        Query(
            min_length=1,
            description="Policy or job that the training starts from: without the stages that it replaces, which are "
            "those up to the recipe of this name, else all but the recipe's own.",
        ),
    ] = None,
) -> list[RecipePublic]:
    """List the recipes: tested jobs."""
    return [
        RecipePublic(name=name, summary=recipes.summary(name), job=recipes.job(name, start)) for name in recipes.names()
    ]
