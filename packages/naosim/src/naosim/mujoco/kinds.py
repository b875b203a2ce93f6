"""The simulators of the Booster family as specifications name them; MuJoCo is imported when one is opened."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from naospec import SimulatorSettings

from naosim.launchers import most_servers, require_servers
from naosim.mujoco.settings import BoosterEmbeddedParameters, BoosterServerParameters
from naosim.robots.booster import FAMILY
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
    from collections.abc import Mapping

    from naosim.robots import Robot


class BoosterEmbeddedKind(SimulatorKind):
    """Booster robots in MuJoCo worlds of this process."""

    name: ClassVar[str] = "embedded"
    summary: ClassVar[str] = "The world of rcssservermj in MuJoCo, in this process."

    def supports(self, robot: Robot) -> bool:
        """Return whether the robot is of the Booster family."""
        return robot.family == FAMILY

    def refusal(self, robot: Robot, scene: Scene) -> str:
        """Return nothing: every scene is possible."""
        del robot, scene
        return ""

    def abilities(self, robot: Robot) -> frozenset[Ability]:
        """Return everything, without stiffer contacts where MuJoCo's steps are too long for them."""
        missing = {Ability.STIFFER} if float(robot.data.get("stiffest_contacts", 1.0)) <= 1.0 else set()
        return frozenset(Ability) - missing

    def parameters(self, robot: Robot) -> type[SimulatorSettings]:
        """Return the settings."""
        del robot
        return BoosterEmbeddedParameters

    def open(
        self,
        robot: Robot,
        n: int,
        parameters: SimulatorSettings,
        options: RuntimeOptions = DEFAULT_OPTIONS,
        scene: Scene = PLAIN,
    ) -> Simulator:
        """Open the worlds of n robots.

        Raises:
            naosim.mujoco.world.MujocoUnavailableError: if MuJoCo is missing or has another version.
        """
        from naosim.mujoco.embedded import MujocoSimulator

        self.require_scene(robot, scene)
        assert isinstance(parameters, BoosterEmbeddedParameters)
        return MujocoSimulator(robot, n, parameters, threads=options.threads, scene=scene)

    def unavailable(self, robot: Robot, environment: Mapping[str, str]) -> str:
        """Return what is missing of MuJoCo and the league's models; empty if nothing is."""
        from naosim.mujoco.world import missing_packages

        del robot, environment
        return missing_packages()


class BoosterServerKind(SimulatorKind):
    """Booster robots on rcssservermj servers, which the environment variable ``NAOSPRINT_RCSSSERVERMJ`` can name."""

    name: ClassVar[str] = "server"
    summary: ClassVar[str] = "rcssservermj over the network, one server for each robot."

    def supports(self, robot: Robot) -> bool:
        """Return whether the robot is of the Booster family."""
        return robot.family == FAMILY

    def refusal(self, robot: Robot, scene: Scene) -> str:
        """Return why a robot cannot be on the servers' field with a ball; empty if it can."""
        if not scene.ball or robot.data["model"] != "K1":
            return ""
        return (
            f"simulator: server cannot run {robot.name} with a ball, because its first touch of the ball ends "
            "rcssservermj 0.2.1; use the embedded simulator, or a T1"
        )

    def abilities(self, robot: Robot) -> frozenset[Ability]:
        """Return that motor torques follow from what the server reports."""
        del robot
        return frozenset({Ability.TORQUES})

    def parameters(self, robot: Robot) -> type[SimulatorSettings]:
        """Return the settings."""
        del robot
        return BoosterServerParameters

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
            FileNotFoundError: if the server's program is missing or has another version.
            OSError: if containers are asked for and no Docker engine answers.
            naosim.simulator.ServerLostError: if a server does not start.
        """
        from naosim.mujoco.program import server_launcher
        from naosim.mujoco.remote import RemoteMujocoSimulator

        self.require_scene(robot, scene)
        assert isinstance(parameters, BoosterServerParameters)
        require_servers(n)
        return RemoteMujocoSimulator(
            server_launcher(),
            robot,
            n,
            settle_steps=parameters.settle_steps,
            max_failures=options.max_server_failures,
            standby_servers=options.standby_servers,
            scene=scene,
        )

    def max_robots(self) -> int:
        """Return the most servers that this machine runs."""
        return most_servers()

    def unavailable(self, robot: Robot, environment: Mapping[str, str]) -> str:
        """Return why there is no server to run; empty if there is."""
        from naosim.mujoco.program import missing_server

        del robot
        return missing_server(environment)


EMBEDDED = BoosterEmbeddedKind()
SERVER = BoosterServerKind()
