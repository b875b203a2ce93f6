"""What settings need, and what the robot, simulator and task of a specification provide.

A field of a section states what it needs to differ from its default::

    push_mps: float = Field(default=0.0, json_schema_extra={"needs": Ability.PUSHES})

It names an ability of simulators (``naosim.simulator.Ability``), ``perceptor NAME`` for one of the robot's perceptors,
or :data:`DEMONSTRATIONS`. A task lists in its ``needs`` what it needs with any settings.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from pydantic_core import InitErrorDetails, PydanticCustomError

from naospec import plugins

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

    from naospec.sections import Section

DEMONSTRATIONS = "demonstrations"
"""Need of learners that imitate: actions that the task shows to the robot."""


def perceptor(name: str) -> str:
    """Return the need of a perceptor."""
    return f"perceptor {name}"


def need_of(setting: FieldInfo) -> str | None:
    """Return what a setting needs to differ from its default; None for nothing."""
    extra = setting.json_schema_extra
    return str(extra["needs"]) if isinstance(extra, dict) and "needs" in extra else None


def provided(group: str, plugin: Any, robot: Any) -> frozenset[str]:
    """Return what a robot, simulator or task provides in a specification with this robot."""
    if group == plugins.ROBOTS:
        return frozenset(perceptor(each.name) for each in plugin.perceptors)
    if group == plugins.SIMULATORS:
        return frozenset(str(each) for each in plugin.abilities(robot)) if plugin.supports(robot) else frozenset()
    if group == plugins.TASKS:
        return frozenset({DEMONSTRATIONS}) if plugin.demonstrates(robot) else frozenset()
    return frozenset()


def lacking(robot: Any, simulator: Any, task: Any, sections: dict[str, Section]) -> Iterator[InitErrorDetails]:
    """Yield an error for everything that the task, or a setting of ``sections``, needs and nothing provides."""
    there = _of(robot, simulator, task)
    for need in sorted(map(str, task.needs)):
        if need not in there:
            yield _error(("task",), task.name, need, robot, simulator, task, "use another task")
    for place, section in sections.items():
        for name, info in type(section).model_fields.items():
            required, value = need_of(info), getattr(section, name)
            if required is not None and required not in there and value != info.get_default():
                yield _error((place, name), value, required, robot, simulator, task, "leave it out")


def _of(robot: Any, simulator: Any, task: Any) -> frozenset[str]:
    parts = ((plugins.ROBOTS, robot), (plugins.SIMULATORS, simulator), (plugins.TASKS, task))
    return frozenset().union(*(provided(group, plugin, robot) for group, plugin in parts))


def _error(
    place: tuple[str, ...], value: Any, need: str, robot: Any, simulator: Any, task: Any, remedy: str
) -> InitErrorDetails:
    """Return the error of a value that needs what is not there, with the robots and simulators that have it."""
    possible = [
        (other.name, kind.name)
        for other in (plugins.load(plugins.ROBOTS, name) for name in plugins.names(plugins.ROBOTS))
        for kind in (plugins.load(plugins.SIMULATORS, name) for name in plugins.names(plugins.SIMULATORS))
        if kind.supports(other) and task.supports(other) and need in _of(other, kind, task)
    ]
    robots = [other for other, kind in possible if kind == simulator.name]
    kinds = [kind for other, kind in possible if other == robot.name]
    if kinds:
        remedy += f", or use simulator {' or '.join(kinds)}"
    elif robots:
        remedy += f", or use robot {' or '.join(robots)}"
    elif possible:
        remedy += f", or use {' or '.join(f'robot {other} with simulator {kind}' for other, kind in possible)}"
    message = "{value} needs {need}, which robot {robot} with simulator {simulator} and task {task} lacks: {remedy}"
    names = {"value": str(value), "need": need, "robot": robot.name, "simulator": simulator.name, "task": task.name}
    return {
        "type": PydanticCustomError("needs", message, {**names, "remedy": remedy}),
        "loc": place,
        "input": value,
    }
