"""The simulators of the NAO family as specifications name them; the engine is imported when one is opened."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from naospec import SimulatorSettings
from pydantic import Field

from naosim.launchers import missing_program, most_servers, require_servers
from naosim.simulator import (
    DEFAULT_OPTIONS,
    PLAIN,
    RuntimeOptions,
    Scene,
    Simulator,
    SimulatorKind,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from naosim.robots import Robot

_DIGITS_TITLE = "Sensor digits"


def _refusal(robot: Robot, scene: Scene) -> str:
    if scene == PLAIN:
        return ""
    return (
        f"simulator: the worlds of {robot.name} have no ball, no goals and report no motion of bodies: the engine of "
        "rcssserver3d's physics has the robot and the ground only; use a robot of rcssservermj, for example t1"
    )


class NaoEmbeddedParameters(SimulatorSettings):
    """Settings of NAOs in the embedded engine."""

    sensor_digits: Literal[2, 3] | None = Field(
        default=2,
        title=_DIGITS_TITLE,
        description="Decimals of the perceptors: 2 as in the league, 3 as some servers do, null for all.",
    )


class NaoServerParameters(SimulatorSettings):
    """Settings of NAOs on servers."""

    sensor_digits: Literal[2, 3] = Field(
        default=2,
        title=_DIGITS_TITLE,
        description="Decimals that `naosim serve` prints: 2 as in the league, 3 as some servers do.",
    )


class NaoEmbeddedKind(SimulatorKind):
    """NAOs in the embedded engine."""

    name: ClassVar[str] = "embedded"
    summary: ClassVar[str] = "The exact embedded engine of rcssserver3d's physics."

    def supports(self, robot: Robot) -> bool:
        """Return whether the robot is a NAO."""
        return robot.family == "nao"

    def refusal(self, robot: Robot, scene: Scene) -> str:
        """Return that these worlds have no ball, if the scene needs more than a plain one."""
        return _refusal(robot, scene)

    def parameters(self, robot: Robot) -> type[SimulatorSettings]:
        """Return the settings."""
        del robot
        return NaoEmbeddedParameters

    def open(
        self,
        robot: Robot,
        n: int,
        parameters: SimulatorSettings,
        options: RuntimeOptions = DEFAULT_OPTIONS,
        scene: Scene = PLAIN,
    ) -> Simulator:
        """Open the engine for n robots.

        Raises:
            ValueError: if the scene is not a plain one.
        """
        self.require_scene(robot, scene)
        from naosim.simspark.embedded import EmbeddedSimulator

        assert isinstance(parameters, NaoEmbeddedParameters)
        return EmbeddedSimulator(robot, n, sensor_digits=parameters.sensor_digits, threads=options.threads)


class NaoServerKind(SimulatorKind):
    """NAOs on rcssserver3d servers, which the environment variable ``NAOSPRINT_SIMSERVER`` names."""

    name: ClassVar[str] = "server"
    summary: ClassVar[str] = "rcssserver3d over the network, one server for each robot."

    def supports(self, robot: Robot) -> bool:
        """Return whether the robot is a NAO."""
        return robot.family == "nao"

    def refusal(self, robot: Robot, scene: Scene) -> str:
        """Return that these worlds have no ball, if the scene needs more than a plain one."""
        return _refusal(robot, scene)

    def parameters(self, robot: Robot) -> type[SimulatorSettings]:
        """Return the settings."""
        del robot
        return NaoServerParameters

    def open(
        self,
        robot: Robot,
        n: int,
        parameters: SimulatorSettings,
        options: RuntimeOptions = DEFAULT_OPTIONS,
        scene: Scene = PLAIN,
    ) -> Simulator:
        """Start n servers, or twice as many with standby servers.

        Raises:
            ValueError: if this machine cannot run this number of servers.
            FileNotFoundError: if the server's program is missing.
            OSError: if containers are asked for and no Docker engine answers.
            naosim.simulator.ServerLostError: if a server does not start.
        """
        from naosim.simspark.program import server_launcher
        from naosim.simspark.remote import RemoteSimulator

        self.require_scene(robot, scene)
        assert isinstance(parameters, NaoServerParameters)
        require_servers(n)
        return RemoteSimulator(
            server_launcher(parameters.sensor_digits),
            robot,
            n,
            max_failures=options.max_server_failures,
            standby_servers=options.standby_servers,
        )

    def max_robots(self) -> int:
        """Return the most servers that this machine runs."""
        return most_servers()

    def unavailable(self, robot: Robot, environment: Mapping[str, str]) -> str:
        """Return why there is no server to run; empty if there is."""
        from naosim.simspark.program import PROGRAM_VARIABLE, RCSSSERVER3D

        del robot
        return missing_program(PROGRAM_VARIABLE, RCSSSERVER3D, environment, embedded=True)


EMBEDDED = NaoEmbeddedKind()
SERVER = NaoServerKind()
