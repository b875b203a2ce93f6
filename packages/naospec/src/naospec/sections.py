"""The sections of a specification that plug-ins define.

A section is a mapping with a ``name``, which chooses the plug-in, and that plug-in's own settings. Its model is a
subclass of :class:`Section` that the plug-in provides.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, Field, SerializationInfo, ValidationError, ValidationInfo
from pydantic_core import InitErrorDetails, PydanticCustomError, core_schema

from naospec import plugins
from naospec.abilities import provided

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
    from pydantic.json_schema import JsonSchemaValue
    from pydantic_core import CoreSchema

    from naospec.contracts import RobotContract, SimulatorContract, TaskContract

PLAIN_NAME = "^[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}$"
"""Pattern of names that enter generated files as they are: letters, digits, ``_``, ``.`` and ``-``."""

PlainName = Annotated[str, Field(pattern=PLAIN_NAME)]


def require_plain_names(what: str, names: Iterable[str]) -> None:
    """Check names that enter checkpoints and generated files.

    Raises:
        ValueError: naming the first that does not match :data:`PLAIN_NAME`.
    """
    for name in names:
        if not re.fullmatch(PLAIN_NAME, name):
            raise ValueError(f"{what}: {name!r}: a name is at most 64 letters, digits, '_', '.' and '-'")


class Section(BaseModel):
    """Base of every section's settings: frozen, without unknown fields, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, protected_namespaces=())

    unused: ClassVar[frozenset[str]] = frozenset()
    """Inherited settings that have no effect here; a user who chooses a value is told."""

    name: str = Field(default="", title="Name", description="Which plug-in the section configures.")

    @classmethod
    def of(cls, section: Section) -> Self:
        """Return a specification's section as these settings: ``KickSettings.of(spec.task)``.

        Raises:
            TypeError: if it has the settings of another plug-in.
        """
        if not isinstance(section, cls):
            raise TypeError(f"{section.name}: expected {cls.__name__}, got {type(section).__name__}")
        return section

    @classmethod
    def replacement(cls, name: str, value: object) -> str:
        """Return what replaces a setting that an older version had, with its value; empty if it had none."""
        del name, value
        return ""


def section_models(group: str, name: str, robot: RobotContract | None = None) -> type[Section]:
    """Return the settings model of one plug-in.

    Args:
        group: entry-point group.
        name: name of the plug-in.
        robot: the robot of the training; only simulators need it.

    Raises:
        UnknownPluginError: if there is no such plug-in.
    """
    model: type[BaseModel]
    if group == plugins.ROBOTS:
        model = type(plugins.load(plugins.ROBOTS, name).parameters)
    elif group == plugins.SIMULATORS:
        if robot is None:
            raise ValueError(f"robot: the settings of simulator {name} depend on it; pass one")
        model = plugins.load(plugins.SIMULATORS, name).parameters(robot)
    elif group == plugins.TASKS:
        model = plugins.load(plugins.TASKS, name).Parameters
    else:
        model = plugins.load(plugins.LEARNERS, name).Parameters
    if not issubclass(model, Section):
        raise plugins.BrokenPluginError(f"{group}: {name}: its settings must subclass naospec.Section")
    return model


@cache
def is_built_in(model: type[Section], field: str) -> bool:
    """Return whether a class of this project declares a setting, which a plug-in's model may inherit.

    Presets are written for these settings, and they keep their short names.
    """
    bases = (base for base in model.__mro__ if issubclass(base, Section))
    owner = next((base for base in bases if field in inspect.get_annotations(base)), model)
    return owner.__module__.partition(".")[0] in plugins.PROJECT


def variants(group: str) -> Iterator[tuple[str, type[Section], tuple[str, ...]]]:
    """Yield every settings model of a group: plug-in, model, and the robots it applies to (empty: all of them).

    What cannot be used is logged and left out: a broken plug-in is the problem of those who name it.
    """
    if group not in (plugins.SIMULATORS, plugins.TASKS):
        for name in plugins.names(group):
            try:
                only = section_models(group, name)
            except plugins.BrokenPluginError as error:
                plugins.leave_out(str(error))
            else:
                yield name, only, ()
        return
    found: Iterator[tuple[str, SimulatorContract | TaskContract]] = (
        plugins.usable(plugins.SIMULATORS) if group == plugins.SIMULATORS else plugins.usable(plugins.TASKS)
    )
    known = list(plugins.usable(plugins.ROBOTS))
    for name, plugin in found:
        by_model: dict[type[Section], list[str]] = {}
        for robot_name, robot in known:
            try:
                if plugin.supports(robot):
                    by_model.setdefault(section_models(group, name, robot), []).append(robot_name)
            except Exception as error:  # of the plug-in's own code
                plugins.leave_out(f"{name} with robot {robot_name}: {type(error).__name__}: {error}")
        for model, robots in by_model.items():
            yield name, model, tuple(robots)


def _provided(group: str, name: str, robots: Iterable[str]) -> dict[str, list[str]]:
    """Return what a plug-in provides, by robot."""
    by_robot = {robot: provided(group, name, plugins.load(plugins.ROBOTS, robot)) for robot in robots}
    return {robot: sorted(there) for robot, there in by_robot.items() if there}


def as_mapping(value: Any) -> Any:
    """Return a section in its long form: a bare name becomes ``{"name": ...}``, anything else stays as it is."""
    if isinstance(value, str):
        return {"name": value}
    if isinstance(value, Section):
        return value.model_dump()
    return value


def _require_known(values: Mapping[str, Any], model: type[Section], owner: str) -> None:
    """Raise ValidationError for settings that a plug-in does not have; the message lists those that it has."""
    known = [name for name in model.model_fields if name != "name"]
    choices = f"choose one of {', '.join(known)}" if known else "it has none"
    errors = [
        InitErrorDetails(
            type=PydanticCustomError(
                "unknown_setting", "{owner} has no such setting: {choices}", {"owner": owner, "choices": choices}
            )
            if not (replacement := model.replacement(name, value))
            else PydanticCustomError(
                "replaced_setting", "{name} was replaced; write {words}", {"name": name, "words": replacement}
            ),
            loc=(name,),
            input=value,
        )
        for name, value in values.items()
        if name not in model.model_fields
    ]
    if errors:
        raise ValidationError.from_exception_data(model.__name__, errors)


class PluginSection:
    """Annotation of a field that contains a section whose model its ``name`` decides: its validation and schema.

    Args:
        group: entry-point group of the plug-ins.
        base: what their settings subclass.
        given: whether only settings that were given are written, since others mean something else where it is read.
    """

    def __init__(self, group: str, base: type[Section], *, given: bool = False) -> None:
        self.group = group
        self.base = base
        self._given = given

    def validate(self, value: Any, info: ValidationInfo) -> Any:
        """Return the section that a name or mapping stands for."""
        if isinstance(value, Section):
            return value
        value = as_mapping(value)
        if not isinstance(value, Mapping):
            raise PydanticCustomError("section_type", "expected a name, or a mapping with `name` and settings")
        name = value.get("name")
        if not isinstance(name, str):
            raise PydanticCustomError(
                "section_name",
                "`name` is missing: choose one of {names}",
                {"names": ", ".join(plugins.names(self.group))},
            )
        robot = None
        if self.group == plugins.SIMULATORS:
            section = (info.data or {}).get("robot")
            if section is None:
                return self.base(name=name)  # the robot's own error is enough
            robot = plugins.load(plugins.ROBOTS, section.name)
            kind = plugins.load(plugins.SIMULATORS, name)
            if not kind.supports(robot):
                possible = [other for other, each in plugins.usable(plugins.SIMULATORS) if each.supports(robot)]
                raise PydanticCustomError(
                    "simulator_robot",
                    "'{name}' cannot run robot '{robot}': choose one of {names}",
                    {"name": name, "robot": robot.name, "names": ", ".join(possible)},
                )
        model = section_models(self.group, name, robot)
        if not issubclass(model, self.base):
            raise plugins.BrokenPluginError(
                f"{self.group}: {name}: its settings must subclass naospec.{self.base.__name__}"
            )
        _require_known(value, model, name if robot is None else f"{name} with robot {robot.name}")
        return model.model_validate(dict(value))

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the schema of a value that :meth:`validate` turns into a section."""
        del source, handler
        return core_schema.with_info_plain_validator_function(
            self.validate, serialization=core_schema.plain_serializer_function_ser_schema(self._dump, info_arg=True)
        )

    def _dump(self, section: Section, info: SerializationInfo) -> Any:
        """Return what is written of a section."""
        content = section.model_dump(mode=info.mode, exclude_none=info.exclude_none, exclude_unset=self._given)
        return {"name": section.name, **content}

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the union of the schemas of all installed plug-ins, distinguished by ``name``."""
        del schema
        options = []
        for name, model, robots in variants(self.group):
            try:
                options.append(self._option(name, model, robots, handler))
            except Exception as error:  # of the plug-in's own code, or of a type that JSON does not have
                plugins.leave_out(f"{name}: {type(error).__name__}: {error}")
        return {"oneOf": options, "x-plugin-group": self.group}

    def _option(
        self, name: str, model: type[Section], robots: Sequence[str], handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Return the schema of one plug-in's section."""
        option = dict(handler.resolve_ref_schema(handler(model.__pydantic_core_schema__)))
        described = {key: value for key, value in option["properties"]["name"].items() if key != "default"}
        option["properties"] = {
            field: schema if is_built_in(model, field) else {**schema, "own": True}
            for field, schema in option["properties"].items()
        } | {"name": {**described, "const": name, "type": "string"}}
        option["required"] = ["name"]
        option["title"] = name
        if robots:
            option["x-robots"] = list(robots)
        if there := _provided(self.group, name, robots or ([name] if self.group == plugins.ROBOTS else [])):
            option["x-provides"] = there
        return option
