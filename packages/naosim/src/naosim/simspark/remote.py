"""NAOs on rcssserver3d servers, one server each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from naosim.fleet_simulator import FleetSimulator
from naosim.robots.nao import model_of
from naosim.simspark.batch import BatchSimulator
from naosim.simspark.client import RemoteBatch
from naosim.simspark.control import motor_speeds, settle, yaw_deg
from naosim.simspark.embedded import unloaded, upward_forces
from naosim.simspark.kinematics import body_poses
from naosim.simulator import Truth

if TYPE_CHECKING:
    from naosim.fleet import Motion
    from naosim.launchers import Launcher
    from naosim.robots import Robot
    from naosim.simulator import Flags, Floats, Starts

_REPLY_TIMEOUT_S = 10.0
_START_TIMEOUT_S = 30.0

_LANDING_M = 0.004
"""Height above its settled position from which a robot is dropped, m."""

_LANDING_CYCLES = 30
"""Cycles in which it is driven into its own pose after that."""


class RemoteSimulator(FleetSimulator):
    """NAOs on rcssserver3d servers, all driven from this process.

    At a start the robot is untangled in the air, brought into the nominal pose there, dropped at the position in which
    the embedded engine's robot has settled in this pose, and driven into its own pose for 30 cycles.

    The torso's pose is as exact as the server sends it: coordinates change in steps of 0.005 (metres, matrix elements),
    unless every cycle requests the full scene.

    Args:
        launcher: starts the servers.
        robot: a NAO.
        n: number of robots.
        max_failures: number of servers that may be replaced.
        standby_servers: whether there are two servers per robot.
        exact: request the full scene in every cycle; much slower.

    Raises:
        naosim.simulator.ServerLostError: if a server does not start; the message states why.
    """

    def __init__(
        self,
        launcher: Launcher,
        robot: Robot,
        n: int,
        *,
        max_failures: int,
        standby_servers: bool = False,
        exact: bool = False,
    ) -> None:
        self._remote = RemoteBatch(
            launcher,
            2 * n if standby_servers else n,
            model_of(robot).robot_type,
            team="naosprint",
            timeout_s=_REPLY_TIMEOUT_S,
            start_timeout_s=_START_TIMEOUT_S,
            max_failures=max_failures,
            exact=exact,
        )
        self._model = self._remote.model
        self._landing: Floats = np.zeros(3)
        super().__init__(
            self._remote,
            robot,
            n,
            sources={each.name: self._remote.perceptor(each.name) for each in robot.perceptors},
            truth=Truth(self._remote.truth.torso_position, self._remote.truth.torso_rotation),
        )

    def _commands_of(self, targets_rad: Floats, rows: slice) -> Floats:
        """Return the motors' joint speeds in rad/s."""
        return motor_speeds(targets_rad, self._views["joint_angles"][rows], self._model.max_speed)

    def _require_possible(self, starts: Starts) -> None:
        if starts.orientations is not None:
            raise ValueError("starts: the NAO's simulators support upright starts only; omit orientations")

    def load_starts(self, starts: Starts) -> None:
        """Replace the starts that :meth:`start` chooses from; what standby servers have prepared is dropped.

        Raises:
            ValueError: if starts are not upright, or have places of their own.
        """
        super().load_starts(starts)
        engine = BatchSimulator(1, self._model.robot_type, digits=None)
        x, y, heading = starts.place()
        settle(engine, self.robot.nominal[None], (x, y), heading)
        self._landing = engine.truth.torso_position[0] + np.array((0.0, 0.0, _LANDING_M))

    def _starting(self, server: int, start: int) -> Motion:
        """Move a server's robot to a start: yield the joint speeds of each cycle."""
        assert self._starts is not None
        remote, pose, yaw = self._remote, self._starts.poses_rad[start], yaw_deg(self._starts.place()[2])
        yield from remote.untangling(server, self.robot.nominal)
        yield from remote.beaming(server, self._landing, yaw)
        for _ in range(_LANDING_CYCLES):
            yield motor_speeds(pose, remote.perceptors.joint_angles[server], self._model.max_speed)

    # for viewers

    def bodies(self) -> Floats:
        """Return (n, B, 7) poses of ``robot.shapes`` by forward kinematics from the perceived angles."""
        self.require_open()
        truth = self.truth
        return body_poses(self._model, truth.torso_position, truth.torso_rotation, self._views["joint_angles"])

    def foot_forces(self) -> Floats:
        """Return the (n, 2) upward forces on left and right foot in newtons, zero without contact."""
        return upward_forces(self._views["foot_left"], self._views["foot_right"])

    def airborne(self) -> Flags:
        """Return the (n,) robots whose feet both report no force in any direction."""
        return unloaded(self._views["foot_left"]) & unloaded(self._views["foot_right"])
