"""The fields of a training's specification."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError, to_jsonable_python

from naospec import plugins
from naospec.formats import CANDIDATES_ARE_STUDIES
from naospec.sections import PluginSection, Section
from naospec.settings import LearnerSettings, RuntimeSettings, SimulatorSettings, TaskSettings

DEFAULTS = {"task": "sprint1", "robot": "nao-0", "simulator": "embedded", "algorithm": "ppo"}
"""Names of the sections that a specification omits."""

Changes = Annotated[dict[str, Any], AfterValidator(to_jsonable_python)]
"""Settings as JSON holds them, so that a specification equals itself after a file."""


class Stage(BaseModel):
    """One of several successive parts of a training, with settings of its own.

    A stage starts from the policy that the stage before it ended with, as a training that is started from a checkpoint
    does: weights and observation statistics are kept, everything else is new.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    steps: int = Field(
        ge=1,
        le=10_000_000_000,
        title="Steps",
        description="Environment steps of the stage; rounded up to whole rollouts.",
        json_schema_extra={"unit": "steps"},
    )
    seed: int | None = Field(
        default=None, ge=0, le=2**31 - 1, title="Seed", description="Seed of the stage; left out: the training's."
    )
    robot: str | None = Field(
        default=None,
        title="Robot",
        description="Robot of the stage, with its default settings; left out: the training's.",
    )
    algorithm: Changes = Field(
        default_factory=dict, title="Algorithm", description="Algorithm settings that differ in this stage."
    )
    task: Changes = Field(
        default_factory=dict,
        title="Task",
        description="Task settings that differ in this stage; with a name of its own, another task with its default "
        "settings.",
    )

    @model_validator(mode="before")
    @classmethod
    def _refuse_candidates(cls, data: object) -> object:
        if isinstance(data, dict) and "candidates" in data:
            error = PydanticCustomError("replaced_setting", "{words}", {"words": CANDIDATES_ARE_STUDIES})
            details = InitErrorDetails(type=error, loc=("candidates",), input=data["candidates"])
            raise ValidationError.from_exception_data(cls.__name__, [details])
        return data


class TrainingFields(BaseModel):
    """What a training's specification consists of; the sections' models are those of their plug-ins."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, protected_namespaces=())

    task: Annotated[TaskSettings, PluginSection(plugins.TASKS, TaskSettings)] = Field(
        default=None,
        validate_default=True,
        title="Task",
        description="What to learn.",
        json_schema_extra={"default": {"name": DEFAULTS["task"]}},
    )
    robot: Annotated[Section, PluginSection(plugins.ROBOTS, Section)] = Field(
        default=None,
        validate_default=True,
        title="Robot",
        description="Which robot learns, with its settings.",
        json_schema_extra={"default": {"name": DEFAULTS["robot"]}},
    )
    simulator: Annotated[SimulatorSettings, PluginSection(plugins.SIMULATORS, SimulatorSettings)] = Field(
        default=None,
        validate_default=True,
        title="Simulator",
        description="Where the robot runs.",
        json_schema_extra={"default": {"name": DEFAULTS["simulator"]}},
    )
    algorithm: Annotated[LearnerSettings, PluginSection(plugins.LEARNERS, LearnerSettings)] = Field(
        default=None,
        validate_default=True,
        title="Algorithm",
        description="How the robot learns.",
        json_schema_extra={"default": {"name": DEFAULTS["algorithm"]}},
    )
    total_steps: int = Field(
        default=10_000_000,
        ge=1,
        le=10_000_000_000,
        title="Total steps",
        description="Environment steps to train for; rounded up to whole rollouts. With stages: their sum.",
        json_schema_extra={"unit": "steps"},
    )
    seed: int = Field(
        default=0,
        ge=0,
        le=2**31 - 1,
        title="Seed",
        description="Seed of initial weights, exploration, minibatches and starts, except in stages with their own; "
        "`--seed` moves these along.",
    )
    stages: tuple[Stage, ...] = Field(
        default=(),
        max_length=32,
        title="Stages",
        description="Successive parts of the training with settings of their own.",
    )
    runtime: RuntimeSettings = Field(
        default_factory=RuntimeSettings,
        title="Runtime",
        description="Settings that change how fast the training runs, but not what it learns.",
    )
