"""Simulators, found by name among the entry points of the group ``naosim.simulators``.

The two that come with naosim, ``embedded`` and ``server``, run robots of several families. A family is one line of
:data:`FAMILIES`: a module with the attributes ``EMBEDDED`` and ``SERVER``, each a SimulatorKind for its robots. A
family may lack one of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, ClassVar, cast

from naosim.launchers import most_servers
from naosim.simulator import (
    DEFAULT_OPTIONS,
    PLAIN,
    Ability,
    RuntimeOptions,
    Scene,
    Simulator,
    SimulatorKind,
)

if TYPE_CHECKING:
    from naospec import SimulatorSettings

    from naosim.robots import Robot

FAMILIES: Mapping[str, str] = {
    "nao": "naosim.simspark.kinds",
    "booster": "naosim.mujoco.kinds",
}
"""Module of each family's simulators; imported when one of its robots is used."""


def names() -> tuple[str, ...]:
    """Return the names of all simulators that installed packages offer, sorted."""
    from naospec import plugins

    return plugins.names(plugins.SIMULATORS)


def get(name: str) -> SimulatorKind:
    """Return the simulator of this name.

    Raises:
        naospec.plugins.UnknownPluginError: if no package offers it; the message lists the available ones.
        naospec.plugins.BrokenPluginError: if it cannot be loaded, or is not a SimulatorKind of that name.
    """
    from naospec import plugins

    return cast("SimulatorKind", plugins.load(plugins.SIMULATORS, name))


class _FamilyKind(SimulatorKind):
    """A simulator that each family of robots implements in a module of its own."""

    _attribute: ClassVar[str]

    def supports(self, robot: Robot) -> bool:
        """Return whether the robot's family has a simulator of this kind."""
        kind = self._find(robot)
        return kind is not None and kind.supports(robot)

    def refusal(self, robot: Robot, scene: Scene) -> str:
        """Return why the family's simulator cannot open this scene; empty if it can."""
        return self._of(robot).refusal(robot, scene)

    def abilities(self, robot: Robot) -> frozenset[Ability]:
        """Return what the family's simulator can do with the robot."""
        return self._of(robot).abilities(robot)

    def parameters(self, robot: Robot) -> type[SimulatorSettings]:
        """Return the settings that the family's simulator takes."""
        return self._of(robot).parameters(robot)

    def open(
        self,
        robot: Robot,
        n: int,
        parameters: SimulatorSettings,
        options: RuntimeOptions = DEFAULT_OPTIONS,
        scene: Scene = PLAIN,
    ) -> Simulator:
        """Open the family's simulator for n robots."""
        return self._of(robot).open(robot, n, parameters, options, scene)

    def unavailable(self, robot: Robot, environment: Mapping[str, str]) -> str:
        """Return why this machine lacks the family's simulator; empty if it has it."""
        return self._of(robot).unavailable(robot, environment)

    def _find(self, robot: Robot) -> SimulatorKind | None:
        module = FAMILIES.get(robot.family)
        return None if module is None else getattr(import_module(module), self._attribute, None)

    def _of(self, robot: Robot) -> SimulatorKind:
        kind = self._find(robot)
        if kind is None:
            raise ValueError(f"simulator: {self.name!r} cannot run {robot.name}; use a simulator that supports it")
        return kind


class EmbeddedKind(_FamilyKind):
    """Simulators that compute in this process."""

    name: ClassVar[str] = "embedded"
    summary: ClassVar[str] = "In this process: the robot's physics without a server."
    _attribute: ClassVar[str] = "EMBEDDED"


class ServerKind(_FamilyKind):
    """Simulators that drive the league's servers over the network."""

    name: ClassVar[str] = "server"
    summary: ClassVar[str] = "The league's server over the network, one server for each robot."
    _attribute: ClassVar[str] = "SERVER"

    def max_robots(self) -> int:
        """Return the most servers that this machine runs."""
        return most_servers()


EMBEDDED = EmbeddedKind()
SERVER = ServerKind()
