"""What settings need, and what the robot, simulator and task of a specification provide.

A field of a section states what it needs to differ from its default::

    push_mps: float = Field(default=0.0, json_schema_extra={"needs": Ability.PUSHES})

It names an ability of simulators (``naosim.simulator.Ability``), ``perceptor NAME`` for one of the robot's perceptors,
or :data:`DEMONSTRATIONS`. A task lists in its ``needs`` what it needs with any settings. A setting that differs from
its default may also provide something: ``{"provides": DEMONSTRATIONS}``.

A setting that another one of its section switches on states that, and a user who chooses a value while the other one is
off is told::

    push_steps: int = Field(default=100, json_schema_extra={"with": ["push_mps"]})

One of them is enough. Null, zero, false and nothing are off, and so is what the other one states as ``{"off": 1.0}``.
Settings that a plug-in inherits and has no use for are its model's ``unused``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from pydantic_core import InitErrorDetails, PydanticCustomError

from naospec import plugins

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

    from naospec.contracts import RobotContract, SimulatorContract, TaskContract
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


def switches_of(setting: FieldInfo) -> tuple[str, ...] | None:
    """Return the settings one of which has to be on for this one to have an effect; None if it always has."""
    extra = setting.json_schema_extra
    names = extra.get("with") if isinstance(extra, dict) else None
    return tuple(map(str, names)) if isinstance(names, list) else None


def idle(section: Section, chosen: Iterable[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield those of the ``chosen`` settings of a section that have no effect, and what would switch them on."""
    fields = type(section).model_fields
    for name in chosen:
        unused = name in type(section).unused
        switches = () if unused else switches_of(fields[name]) if name in fields else None
        if switches is not None and not any(_is_on(section, switch) for switch in switches if switch in fields):
            yield name, tuple(switch for switch in switches if switch in fields)


def _is_on(section: Section, name: str) -> bool:
    extra, value = type(section).model_fields[name].json_schema_extra, getattr(section, name)
    return bool(value) and not (isinstance(extra, dict) and value == extra.get("off"))


def _by_settings(sections: Iterable[Section]) -> frozenset[str]:
    """Return what the settings that differ from their defaults provide."""
    extras = (
        info.json_schema_extra
        for section in sections
        for name, info in type(section).model_fields.items()
        if getattr(section, name) != info.get_default()
    )
    return frozenset(str(extra["provides"]) for extra in extras if isinstance(extra, dict) and "provides" in extra)


def provided(group: str, name: str, robot: RobotContract) -> frozenset[str]:
    """Return what the robot, simulator or task of this name provides in a specification with this robot."""
    if group == plugins.ROBOTS:
        return _by_robot(plugins.load(plugins.ROBOTS, name))
    if group == plugins.SIMULATORS:
        return _by_simulator(plugins.load(plugins.SIMULATORS, name), robot)
    if group == plugins.TASKS:
        return _by_task(plugins.load(plugins.TASKS, name), robot)
    return frozenset()


def _by_robot(robot: RobotContract) -> frozenset[str]:
    return frozenset(perceptor(each.name) for each in robot.perceptors)


def _by_simulator(simulator: SimulatorContract, robot: RobotContract) -> frozenset[str]:
    return frozenset(map(str, simulator.abilities(robot))) if simulator.supports(robot) else frozenset()


def _by_task(task: TaskContract, robot: RobotContract) -> frozenset[str]:
    return frozenset({DEMONSTRATIONS}) if task.demonstrates(robot) else frozenset()


def lacking(
    robot: RobotContract, simulator: SimulatorContract, task: TaskContract, sections: dict[str, Section]
) -> Iterator[InitErrorDetails]:
    """Yield an error for everything that the task, or a setting of ``sections``, needs and nothing provides."""
    there = _of(robot, simulator, task) | _by_settings(sections.values())
    for need in sorted(map(str, task.needs)):
        if need not in there:
            yield _error(("task",), task.name, need, robot, simulator, task, "use another task")
    for place, section in sections.items():
        for name, info in type(section).model_fields.items():
            required, value = need_of(info), getattr(section, name)
            if required is not None and required not in there and value != info.get_default():
                yield _error((place, name), value, required, robot, simulator, task, "leave it out")


def _of(robot: RobotContract, simulator: SimulatorContract, task: TaskContract) -> frozenset[str]:
    return _by_robot(robot) | _by_simulator(simulator, robot) | _by_task(task, robot)


def _error(
    place: tuple[str, ...],
    value: object,
    need: str,
    robot: RobotContract,
    simulator: SimulatorContract,
    task: TaskContract,
    remedy: str,
) -> InitErrorDetails:
    """Return the error of a value that needs what is not there, with the robots and simulators that have it."""
    possible = [
        (other.name, kind.name)
        for _, other in plugins.usable(plugins.ROBOTS)
        for _, kind in plugins.usable(plugins.SIMULATORS)
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
