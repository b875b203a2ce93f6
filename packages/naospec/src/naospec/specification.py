"""Specifications of trainings and evaluations: every setting that decides their outcome."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from naospec import formats, plugins, presets
from naospec.abilities import idle, lacking
from naospec.fields import DEFAULTS, TrainingFields
from naospec.flat import settings
from naospec.sections import PluginSection
from naospec.settings import RuntimeSettings, TaskSettings
from naospec.written import WrittenSpec, preset_values

if TYPE_CHECKING:
    from collections.abc import Iterable
    from collections.abc import Set as AbstractSet

    from naospec.contracts import RobotContract, TaskContract


class _Specification(BaseModel):
    """Base of both specifications: frozen, without unknown fields, with a digest."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, protected_namespaces=())

    def canonical_json(self) -> str:
        """Return the one JSON text that equal specifications share: sorted keys, no blanks, no runtime settings."""
        content = self.model_dump(mode="json", exclude={"runtime"})
        return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)

    def digest(self) -> str:
        """Return the SHA-256 of the canonical JSON as 64 hexadecimal digits."""
        return hashlib.sha256(self.canonical_json().encode()).hexdigest()


class TrainingSpec(_Specification, TrainingFields):
    """Specification of a training: what to learn, with which robot, where, and how.

    Sections and settings that are left out take the values of the preset, so
    ``TrainingSpec(algorithm={"preset": "paper"})`` is the paper's table II. A section can be given as the name of its
    plug-in alone: ``TrainingSpec(robot="t1")``.
    """

    if TYPE_CHECKING:

        def __init__(self, **settings: object) -> None:
            """Accept sections as names, mappings or settings; validation decides."""

    @model_validator(mode="before")
    @classmethod
    def _resolve(cls, data: Any) -> Any:
        """Resolve what a user wrote; leave bad values to the fields' own validation."""
        if isinstance(data, WrittenSpec):
            return data.resolved()
        if not isinstance(data, dict):
            return data
        written = _of_this_format(formats.Kind.TRAINING, data)
        _refuse_misplaced(cls.__name__, written, cls.model_fields.keys())
        if isinstance(runtime := written.get("runtime"), dict):
            _refuse_misplaced(cls.__name__, runtime, RuntimeSettings.model_fields.keys(), ("runtime",))
        return WrittenSpec(written).resolved()

    @model_validator(mode="after")
    def _possible(self) -> Self:
        robot, task = self._robot, self._task
        if self.task.version != task.version:
            raise PydanticCustomError(
                "task_version",
                "task.version: the specification is for version {wanted} of task '{name}', installed is version "
                "{installed}; install the version of its package that has version {wanted}, or train with the "
                "installed one",
                {"wanted": self.task.version, "name": self.task.name, "installed": task.version},
            )
        simulator = plugins.load(plugins.SIMULATORS, self.simulator.name)
        refusal = simulator.refusal(robot, task.scene)
        if refusal:
            raise PydanticCustomError("scene", "{refusal} (task {task})", {"refusal": refusal, "task": task.name})
        sections = {name: getattr(self, name) for name in DEFAULTS}
        if errors := list(lacking(robot, simulator, task, sections)):
            raise ValidationError.from_exception_data(type(self).__name__, errors)
        learner = plugins.load(plugins.LEARNERS, self.algorithm.name)
        if twice := {metric.name for metric in task.metrics} & {metric.name for metric in learner.metrics}:
            raise PydanticCustomError(
                "metric_names",
                "task {task} and algorithm {algorithm} both have a metric {names}, of which a training reports one; "
                "use another algorithm, or rename the task's metric",
                {"task": task.name, "algorithm": learner.name, "names": ", ".join(sorted(twice))},
            )
        learner.require(self.algorithm, robot, task.name)
        if self.stages:
            total = sum(stage.steps for stage in self.stages)
            if self.total_steps != total:
                raise PydanticCustomError(
                    "stage_steps",
                    "total_steps: {total} is not the sum of the stages' steps, {sum}; leave total_steps out",
                    {"total": self.total_steps, "sum": total},
                )
            for number, (before, stage) in enumerate(itertools.pairwise(self.stage_specs), start=1):
                if (misfit := stage.algorithm.misfit(before.algorithm)) is not None:
                    name, there, here = misfit
                    raise PydanticCustomError(
                        "stage_policy",
                        "stages.{number}.algorithm: all stages train the same policy, so {name} cannot be {here} "
                        "after {there}",
                        {"number": number, "name": name, "here": str(here), "there": str(there)},
                    )
        return self

    @cached_property
    def _robot(self) -> RobotContract:
        """The robot that the section ``robot`` names, with its settings."""
        return plugins.load(plugins.ROBOTS, self.robot.name).with_parameters(self.robot.model_dump())

    @property
    def _task(self) -> TaskContract:
        """The task that the section ``task`` names."""
        return plugins.load(plugins.TASKS, self.task.name)

    @property
    def task_version(self) -> int:
        """Version of the task."""
        return self._task.version  # validation has compared it with the section's

    @property
    def family(self) -> str:
        """Family of the robot."""
        return self._robot.family

    @property
    def rollout_steps(self) -> int:
        """Samples of one rollout: environments times steps of each."""
        return self.algorithm.rollout_steps

    @cached_property
    def stage_specs(self) -> tuple[TrainingSpec, ...]:
        """One specification without stages for each stage; this one itself if there are none."""
        if not self.stages:
            return (self,)
        found = []
        for number, stage in enumerate(self.stages):
            content = self.model_dump(exclude={"stages"})
            if stage.robot is not None:
                # this robot decides what the training's own robot decided
                content = {**self.written().content, "stages": (), "robot": {"name": stage.robot}}
            if stage.task.get("name", self.task.name) != self.task.name:
                content["task"] = {}
            content["total_steps"] = stage.steps
            content["seed"] = self.seed if stage.seed is None else stage.seed
            for section in ("algorithm", "task"):
                changes = getattr(stage, section)
                fixed = {"preset", "version", *(["name"] if section == "algorithm" else [])} & changes.keys()
                if fixed:
                    raise PydanticCustomError(
                        "stage_field",
                        "stages.{number}.{section}.{field}: cannot differ between stages",
                        {"number": number, "section": section, "field": min(fixed)},
                    )
                content[section] = {**content[section], **changes}
            try:
                found.append(type(self).model_validate(content))
            except ValidationError as error:
                raise _at(("stages", number), error) from None
        return tuple(found)

    @property
    def planned_steps(self) -> int:
        """Steps that the training takes: those of each stage rounded up to whole rollouts."""
        if not self.stages:
            return -(-self.total_steps // self.rollout_steps) * self.rollout_steps
        return sum(spec.planned_steps for spec in self.stage_specs)

    def overrides(self) -> dict[str, Any]:
        """Return the settings that differ from the preset, by path: ``algorithm.learning_rate``.

        What a learner offers beyond the preset is compared with its default.
        """
        found: dict[str, Any] = {}
        family = self.family
        for section in presets.SECTIONS:
            values = preset_values(type(getattr(self, section)), self.algorithm.preset, section, family)
            if section == "algorithm":
                fields = type(self.algorithm).model_fields
                values = {
                    name: fields[name].get_default() for name in fields if name not in ("name", "preset")
                } | values
            for name, value in values.items():
                mine = getattr(getattr(self, section), name)
                if mine != (tuple(value) if isinstance(value, list) else value):
                    found[f"{section}.{name}"] = mine
        return found

    def without_effect(self) -> list[str]:
        """Return a sentence for each setting that differs from what it usually is and changes nothing in any stage.

        Another one switches it on and is off: "task.push_steps: 50 has no effect without push_mps". It is no error:
        pushes can be taken out of a recipe by ``push_mps`` alone.
        """
        used: set[str] = set()
        unused: dict[str, str] = {}
        for stage in self.stage_specs:
            written = stage.written().content
            for place in DEFAULTS:
                section = getattr(stage, place)
                off = dict(idle(section, written[place]))
                used |= {f"{place}.{name}" for name in written[place] if name not in off}
                for name, switches in off.items():
                    without = f"without {' or '.join(switches)}" if switches else f"in {place} {section.name}"
                    unused[f"{place}.{name}"] = f"{place}.{name}: {written[place][name]} has no effect {without}"
        return [sentence for path, sentence in unused.items() if path not in used]

    def written(self) -> WrittenSpec:
        """Return what has to be written for this specification: what neither preset, task, robot nor default decide.

        With another preset, task, robot or simulator, these then decide the rest.
        """
        bare = {name: type(getattr(self, name))(name=getattr(self, name).name) for name in DEFAULTS}
        bare["task"] = self._task.resolve(bare["task"], self._robot)
        content = self.model_dump(mode="json")
        for section, default in bare.items():
            usual = default.model_dump(mode="json")
            if section in presets.SECTIONS:
                usual |= preset_values(type(default), self.algorithm.preset, section, self.family)
            chosen = content[section].items()
            content[section] = {
                name: value
                for name, value in chosen
                if name in _ALWAYS_WRITTEN or name not in usual or value != usual[name]
            }
        content["task"].pop("version", None)
        if self.stages:
            content.pop("total_steps")
        return WrittenSpec(content)


class EvaluationSpec(_Specification):
    """Specification of an evaluation of a policy."""

    if TYPE_CHECKING:

        def __init__(self, **settings: object) -> None:
            """Accept sections as names, mappings or settings; validation decides."""

    episodes: int = Field(default=1000, ge=1, le=1_000_000, title="Episodes", description="Episodes to run.")
    seed: int = Field(
        default=0,
        ge=0,
        le=2**31 - 1,
        title="Seed",
        description="Seed of the starts and of the bootstrap intervals. One that the training has draws other starts "
        "than it had there.",
    )
    task: Annotated[TaskSettings, PluginSection(plugins.TASKS, TaskSettings, given=True)] | None = Field(
        default=None,
        title="Task",
        description="Task to run, with its settings; left out: the training's, undisturbed. So are settings of the "
        "training's own task that are left out.",
    )
    deterministic: bool = Field(
        default=True, title="Deterministic", description="Take the mean action instead of sampling one."
    )
    start_noise_deg: float | None = Field(
        default=None,
        ge=0.0,
        le=20.0,
        title="Start noise",
        description="Each joint of the start pose is offset by up to this angle; left out: the task's.",
        json_schema_extra={"unit": "deg"},
    )
    simulator: str | None = Field(
        default=None, title="Simulator", description="Where the episodes run; left out: where the policy was trained."
    )
    engine: str | None = Field(
        default=None,
        title="Engine",
        description="What steps T1 and K1 in an embedded simulator: mujoco or fast; left out: mujoco, which is exact.",
    )
    n_envs: int = Field(
        default=128,
        ge=1,
        le=4096,
        title="Environments",
        description="Episodes that run in parallel; on servers at most four a core.",
    )
    trajectories: int = Field(
        default=100,
        ge=0,
        le=10_000,
        title="Trajectories",
        description="Episodes whose path is kept, counted from the first.",
    )
    confidence: float = Field(
        default=0.95, gt=0.0, lt=1.0, title="Confidence", description="Level of all confidence intervals."
    )
    bootstrap_resamples: int = Field(
        default=2000,
        ge=100,
        le=100_000,
        title="Bootstrap resamples",
        description="Resamples behind each bootstrap interval.",
    )

    @model_validator(mode="before")
    @classmethod
    def _convert(cls, data: Any) -> Any:
        return _of_this_format(formats.Kind.EVALUATION, data) if isinstance(data, dict) else data

    @field_validator("simulator")
    @classmethod
    def _known_simulator(cls, value: str | None) -> str | None:
        if value is not None:
            plugins.load(plugins.SIMULATORS, value)
        return value

    @field_validator("task")
    @classmethod
    def _has_its_effect(cls, value: TaskSettings | None) -> TaskSettings | None:
        """Refuse settings that only change how a training begins."""
        if value is None:
            return None
        for name in value.model_fields_set:
            info = type(value).model_fields[name]
            extra = info.json_schema_extra
            if isinstance(extra, dict) and extra.get("training_only") and getattr(value, name) != info.default:
                raise PydanticCustomError(
                    "training_only", "{name} has a meaning for trainings only; leave it out", {"name": name}
                )
        return value

    def applied_to(self, trained: TrainingSpec) -> TrainingSpec:
        """Return the specification of the episodes: the training's, with this evaluation's task and simulator.

        A task of the training's name has the training's settings besides those that were given.

        Raises:
            pydantic.ValidationError: if the combination is impossible.
        """
        last = trained.stage_specs[-1]
        content = last.model_dump(exclude={"stages"})
        given = {} if self.task is None else self.task.model_dump(exclude_unset=True, exclude_none=True)
        own = self.task is None or self.task.name == last.task.name
        content["task"] = {
            **(last.task.for_evaluation().model_dump() if own else {}),
            **given,
            "history_steps": last.task.history_steps,  # a policy's inputs are what it was trained with
        }
        if self.start_noise_deg is not None:
            content["task"] = {**content["task"], "start_noise_deg": self.start_noise_deg}
        if self.simulator is None or self.simulator == trained.simulator.name:
            content["simulator"] = trained.simulator.model_dump()
        else:
            content["simulator"] = {"name": self.simulator}
        if self.engine is not None:
            content["simulator"] = {**content["simulator"], "engine": self.engine}
        try:
            applied = TrainingSpec.model_validate(content)
        except ValidationError as error:
            renamed = {path: name for path, name in _APPLIED.items() if getattr(self, name) is not None}
            raise _at((), error, renamed) from None
        engine = {} if self.engine is None else {"engine": self.engine}
        return applied.model_copy(update={"simulator": applied.simulator.for_evaluation().model_copy(update=engine)})


_ALWAYS_WRITTEN = {"name", "preset"}
_APPLIED: Mapping[tuple[str | int, ...], str] = {
    ("simulator", "name"): "simulator",
    ("simulator", "engine"): "engine",
    ("task", "start_noise_deg"): "start_noise_deg",
}
"""Paths in a training's specification of settings that an evaluation has under names of its own."""

Spec = TypeVar("Spec", bound=_Specification)


def stored(spec: TrainingSpec | EvaluationSpec) -> dict[str, Any]:
    """Return a specification as it is stored, for a version that may come later."""
    kind = formats.Kind.TRAINING if isinstance(spec, TrainingSpec) else formats.Kind.EVALUATION
    return formats.numbered(kind, spec.model_dump(mode="json"))


def read_stored(model: type[Spec], document: Mapping[str, Any]) -> Spec:
    """Return a specification that was stored, by this version or an older one. Raises ValidationError."""
    return model.model_validate({"format": 1, **document})


def _of_this_format(kind: formats.Kind, data: dict[str, Any]) -> dict[str, Any]:
    """Return a copy of a specification; one that names no format has this version's."""
    return formats.current(kind, data) if "format" in data else dict(data)


def _refuse_misplaced(
    title: str, data: dict[str, Any], fields: AbstractSet[str], section: tuple[str, ...] = ()
) -> None:
    """Raise ValidationError for settings outside their section, naming their place."""
    if data.keys() <= fields:
        return
    places = {name: ".".join(setting.path) for name, setting in settings().items()}
    errors: list[InitErrorDetails] = [
        {
            "type": PydanticCustomError("misplaced", "write {place}", {"place": places[name]}),
            "loc": (*section, name),
            "input": value,
        }
        for name, value in data.items()
        if name not in fields and name in places
    ]
    if errors:
        raise ValidationError.from_exception_data(title, errors)


def _at(
    place: tuple[str | int, ...],
    error: ValidationError,
    renamed: Mapping[tuple[str | int, ...], str] = MappingProxyType({}),
) -> ValidationError:
    """Return the same errors under the path ``place``; paths that ``renamed`` has are replaced first."""
    lines: list[InitErrorDetails] = [
        {
            "type": PydanticCustomError(item["type"], item["msg"].replace("{", "(").replace("}", ")")),
            "loc": (*place, *((renamed[item["loc"]],) if item["loc"] in renamed else item["loc"])),
            "input": item["input"],
        }
        for item in error.errors()
    ]
    return ValidationError.from_exception_data(error.title, lines)


def validation_words(errors: Iterable[Any]) -> str:
    """Return pydantic's errors as one line for users: wrong fields by their paths, and what is expected.

    The line is short whatever the input contains: 20 errors, 100 characters of a name, 1,000 of a message.
    """
    found = list(errors)
    words = []
    for item in found[:20]:
        place = ".".join(str(part)[:100] for part in item["loc"])
        message = item["msg"].removeprefix("Value error, ")[:1000]
        words.append(f"{place}: {message}" if place else message)
    if len(found) > 20:
        words.append(f"and {len(found) - 20:,} more")
    return "; ".join(words)
