"""Robots, simulators, tasks and learners that installed packages offer, found through entry points.

A package offers one by an entry point in its metadata, whose name is the name that specifications use::

    [project.entry-points."naosprint.tasks"]
    run-backwards = "naosprint_backwards:RunBackwards"
"""

from __future__ import annotations

import inspect
import logging
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from types import UnionType
from typing import ClassVar, Generic, TypeVar, cast, get_origin, get_type_hints

from naospec.contracts import LearnerContract, RobotContract, SimulatorContract, TaskContract
from naospec.metrics import ENGINES, EPISODE_METRICS, PACE, PROGRESS, Metric

Found = TypeVar("Found", covariant=True)


class Group(str, Generic[Found]):
    """Name of an entry-point group, with the type of what it offers."""

    __slots__ = ()


ROBOTS = Group[RobotContract]("naosim.robots")
SIMULATORS = Group[SimulatorContract]("naosim.simulators")
TASKS = Group[TaskContract]("naosprint.tasks")
LEARNERS = Group[LearnerContract]("naosprint.learners")
ROBOT_DEFAULTS = Group[Callable[[RobotContract], object]]("naosprint.robots")

_BASES: dict[str, str] = {
    ROBOTS: "naosim.robots.Robot",
    SIMULATORS: "naosim.simulator.SimulatorKind",
    TASKS: "naosprint.tasks.Task",
    LEARNERS: "naosprint.rl.learner.LearnerKind",
}
_NOUNS: dict[str, str] = {ROBOTS: "robot", SIMULATORS: "simulator", TASKS: "task", LEARNERS: "algorithm"}


PROJECT = frozenset({"naospec", "naosim", "naosprint"})
"""Packages of this project that offer plug-ins."""

_log = logging.getLogger(__name__)

# Python refuses an import where threads import modules that need each other. Reentrant: plug-ins load others.
_LOADING = threading.RLock()


class Plugin:
    """Base of the classes that plug-ins inherit from; :func:`load` holds a plug-in against that class.

    Attributes:
        plugin_group: entry-point group, set by the class that others inherit from.
    """

    plugin_group: ClassVar[str] = ""


class UnknownPluginError(ValueError):
    """Reference to a robot, simulator, task or learner that no installed package offers."""


class BrokenPluginError(RuntimeError):
    """Entry point that cannot be loaded, or whose name is taken twice."""


@cache
def _entries(group: str) -> dict[str, tuple[EntryPoint, ...]]:
    """Return what a group offers by name: one entry point, or those that differ, of which none can be loaded."""
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for entry in entry_points(group=group):
        others = found.get(entry.name, ())
        if entry.value not in {other.value for other in others}:
            found[entry.name] = (*others, entry)
    return found


def names(group: str) -> tuple[str, ...]:
    """Return the names that a group offers, sorted."""
    return tuple(sorted(_entries(group)))


def load(group: Group[Found], name: str) -> Found:
    """Return what a group offers under ``name``.

    Raises:
        UnknownPluginError: if there is nothing of that name; the message lists the available ones.
        BrokenPluginError: if it cannot be imported, or is not what the group expects; the message names package, class
            and method.
    """
    return cast("Found", _load(group, name))


def usable(group: Group[Found]) -> Iterator[tuple[str, Found]]:
    """Yield what a group offers by name; what cannot be loaded is logged and left out."""
    for name in names(group):
        try:
            plugin = load(group, name)
        except BrokenPluginError as error:
            leave_out(str(error))
        else:
            yield name, plugin


def find(group: Group[Found], name: str) -> Found | None:
    """Return what a group offers under ``name``, or None if there is nothing that can be used."""
    try:
        return load(group, name)
    except UnknownPluginError:
        return None
    except BrokenPluginError as error:
        leave_out(str(error))
        return None


@cache
def leave_out(reason: str) -> None:
    """Log what is left out of lists because it cannot be used, once in a process."""
    _log.warning("left out: %s", " ".join(reason.split()))


@cache
def _load(group: str, name: str) -> object:
    entries = _entries(group).get(name, ())
    if not entries:
        raise UnknownPluginError(
            f"unknown {_NOUNS.get(group, group)} {name!r}: choose one of {', '.join(names(group)) or 'none'}, "
            "or install the package that offers it"
        )
    if len(entries) > 1:
        offers = " and ".join(f"package {_package(entry)} as {entry.value}" for entry in entries)
        raise BrokenPluginError(f"{name}: {offers} offer the same {_NOUNS.get(group, group)}; uninstall all but one")
    (entry,) = entries
    try:
        with _LOADING:
            plugin = entry.load()
        _require_contract(group, name, plugin)
        return plugin
    except (Exception, SystemExit) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BrokenPluginError(
            f"{name}: package {_package(entry)} offers it as {entry.value}, which cannot be used: {reason}"
        ) from error


def place_of(error: BaseException) -> str:
    """Return the last line of a plug-in of another package that an error came through: ``file, line 7``; or nothing."""
    packages = {entry.module for group in _NOUNS for entries in _entries(group).values() for entry in entries}
    theirs = {_top(module) for module in packages} - PROJECT
    lines = [
        f"{frame.f_code.co_filename}, line {number}"
        for frame, number in traceback.walk_tb(error.__traceback__)
        if _top(frame.f_globals.get("__name__", "")) in theirs
    ]
    return lines[-1] if lines else ""


def _top(module: str) -> str:
    return module.partition(".")[0]


def _package(entry: EntryPoint) -> str:
    """Return the name of the package that offers something."""
    return entry.dist.name if entry.dist is not None else entry.value


def _require_contract(group: str, name: str, plugin: object) -> None:
    """Check a plug-in's name, its attributes, and the methods with which it overrides those of its base class.

    Raises:
        TypeError: naming the class and what is wrong with it.
    """
    if group not in _BASES:
        return
    kind = plugin if isinstance(plugin, type) else type(plugin)
    contract = next((base for base in kind.__mro__ if vars(base).get("plugin_group") == group), None)
    if contract is None or isinstance(plugin, type) != (group == TASKS):
        what = "a subclass" if group == TASKS else "an instance"
        raise TypeError(f"it must be {what} of {_BASES[group]}, not {kind.__name__}")
    for attribute, annotation in contract.__annotations__.items():
        if "ClassVar" in str(annotation) and not hasattr(plugin, attribute):
            raise TypeError(f"{kind.__name__} has no {attribute}; set it")
    if (own_name := getattr(plugin, "name", None)) != name:
        raise TypeError(f"{kind.__name__}.name is {own_name!r}, its entry point's {name!r}; they must be equal")
    for method, expected in vars(contract).items():
        own = inspect.getattr_static(kind, method)
        if method.startswith("_") or own is expected or not isinstance(expected, classmethod | _FUNCTION):
            continue
        if type(own) is not type(expected):
            raise TypeError(f"{kind.__name__}.{method} must be a {type(expected).__name__}, not {type(own).__name__}")
        reason = _mismatch(_function(own), _function(expected))
        if reason:
            raise TypeError(f"{kind.__name__}.{method}: {reason}")
    if group in (TASKS, LEARNERS):
        _require_names(kind, getattr(plugin, "metrics", ()), getattr(plugin, "results", ()))


def _require_names(kind: type, metrics: Iterable[Metric], results: Iterable[Metric]) -> None:
    """Check that a plug-in's metrics and results have names of their own: there is one value for each name.

    Raises:
        TypeError: naming the class and the name.
    """
    episodes = {each.name for each in EPISODE_METRICS}
    columns = episodes | {each.name for each in (*PROGRESS, *ENGINES, *PACE)}
    seen: set[str] = set()
    for attribute, declared, reported in (("metrics", metrics, columns), ("results", results, episodes)):
        for name in (each.name for each in declared):
            if name in reported:
                raise TypeError(f"{kind.__name__}.{attribute}: every training reports {name!r}; choose another name")
            if name in seen:
                raise TypeError(f"{kind.__name__}.{attribute}: {name!r} is given twice; choose another name")
            seen.add(name)


_FUNCTION = type(_require_contract)


def _function(method: object) -> Callable[..., object]:
    """Return the function of a class method, or the method itself."""
    return cast("Callable[..., object]", getattr(method, "__func__", method))


def _mismatch(own: Callable[..., object], expected: Callable[..., object]) -> str:
    """Return why a method cannot be called like the one that it overrides, or returns something else; else nothing."""
    parameters = inspect.signature(expected).parameters.values()
    for chosen in (parameters, [each for each in parameters if each.default is each.empty]):
        by_name = {each.name: None for each in chosen if each.kind is each.KEYWORD_ONLY}
        try:
            inspect.signature(own).bind(*[None] * (len(list(chosen)) - len(by_name)), **by_name)
        except TypeError as error:
            return f"expected the parameters {inspect.signature(expected)}: {error}"
    try:
        returned, wanted = (get_type_hints(each).get("return") for each in (own, expected))
    except NameError:
        return ""  # names that only type checkers import
    returned, wanted = get_origin(returned) or returned, get_origin(wanted) or wanted
    if UnionType in (returned, wanted) or not isinstance(returned, type) or not isinstance(wanted, type):
        return ""
    if not issubclass(returned, wanted):
        return f"it returns {returned.__name__}, expected is {wanted.__name__}"
    return ""
