"""Booster robots on rcssservermj servers, one server each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from naosim.fleet_simulator import FleetSimulator
from naosim.mujoco.client import MujocoFleet
from naosim.mujoco.shapes import body_poses, sole_heights
from naosim.mujoco.world import torque_shares, world_of
from naosim.simulator import Truth

if TYPE_CHECKING:
    from naosim.fleet import Motion
    from naosim.launchers import Launcher
    from naosim.robots import Robot
    from naosim.simulator import Flags, Floats, Ints, Starts

_REPLY_TIMEOUT_S = 10.0
_START_TIMEOUT_S = 90.0


class RemoteMujocoSimulator(FleetSimulator):
    """Booster robots on rcssservermj servers, all driven from this process.

    At a start the robot is beamed, upright with straight joints, and driven into the start's pose for ``settle_steps``,
    as in the embedded simulator. Position and orientation of the torso are those that the robot perceives: exact, but
    5 ms old and truncated to three decimals. The server reports no contacts: :meth:`foot_forces` is always zero, and a
    robot counts as :meth:`airborne` when both soles are above the ground by the perceived pose.

    Args:
        launcher: starts the servers.
        robot: a robot of the family ``booster``, with its gains.
        n: number of robots.
        settle_steps: steps between the beam and the start of an episode.
        max_failures: number of servers that may be replaced.
        standby_servers: whether there are two servers per robot.

    Raises:
        naosim.simulator.ServerLostError: if a server does not start; the message states why.
    """

    def __init__(
        self,
        launcher: Launcher,
        robot: Robot,
        n: int,
        *,
        settle_steps: int,
        max_failures: int,
        standby_servers: bool = False,
    ) -> None:
        self._remote = MujocoFleet(
            launcher,
            robot,
            2 * n if standby_servers else n,
            timeout_s=_REPLY_TIMEOUT_S,
            start_timeout_s=_START_TIMEOUT_S,
            max_failures=max_failures,
        )
        self._settle_steps = settle_steps
        self._acting = np.repeat(robot.nominal[None], n, axis=0)  # targets of the step that the last reply shows
        super().__init__(
            self._remote,
            robot,
            n,
            sources=self._remote.perceptors,
            truth=Truth(self._remote.perceptors["torso_pos"], self._remote.rotation),
            idle_s=None,
        )

    def _commands_of(self, targets_rad: Floats, rows: slice) -> Floats:
        targets = np.asarray(targets_rad, dtype=np.float64)
        shape = (rows.stop - rows.start, len(self.robot.joints))
        if targets.shape != shape:
            raise ValueError(f"targets_rad: expected shape {shape}, got {targets.shape}")
        return targets

    def step_async(self, targets_rad: Floats, rows: slice, active: Flags | None = None) -> None:
        """Send commands to the servers of these robots; they compute meanwhile.

        Raises:
            ValueError: if the targets have a wrong shape or are not finite.
        """
        before = self._commands[self._servers[rows]]
        super().step_async(targets_rad, rows, active)
        stepped = np.arange(rows.start, rows.stop)
        # the reply to this command shows what the one before it did
        self._acting[stepped if active is None else stepped[active]] = before if active is None else before[active]

    def start(self, rows: Ints, starts: Ints, following: Ints | None = None) -> None:
        """Move robots to starts; standby servers prepare the ``following`` ones.

        Raises:
            naosim.simulator.ServerLostError: if more servers fail than are allowed, or a new one does not start.
        """
        super().start(rows, starts, following)
        self._acting[rows] = self._commands[self._servers[rows]]

    def _require_possible(self, starts: Starts) -> None:
        if starts.orientations is not None:
            raise ValueError(
                "starts: rcssservermj beams robots upright only; use the embedded simulator for other orientations"
            )
        farthest = float(starts.places()[:, 0].max(initial=0.0))
        if farthest > 0.0:
            raise ValueError(
                f"starts: rcssservermj beams the left team to its own half, not to x = {farthest:g} m; "
                "use a position with x <= 0"
            )
        poses = np.asarray(starts.poses_rad)
        if poses.ndim != 2 or poses.shape[1] != len(self.robot.joints) or not np.isfinite(poses).all():
            raise ValueError(f"starts: expected finite poses of shape (k, {len(self.robot.joints)}), got {poses.shape}")

    def _starting(self, server: int, start: int) -> Motion:
        """Move a server's robot to a start: yield the target angles of each cycle."""
        assert self._starts is not None
        x, y, heading = self._starts.places()[start].tolist()
        return self._remote.starting(server, self._starts.poses_rad[start], (x, y), heading, self._settle_steps)

    # for viewers and tasks

    def bodies(self) -> Floats:
        """Return (n, B, 7) poses of ``robot.shapes`` by forward kinematics from what the robots perceive.

        Raises:
            naosim.mujoco.world.MujocoUnavailableError: if MuJoCo is missing here or has another version.
        """
        self.require_open()
        return body_poses(world_of(self.robot), self._coordinates())

    def airborne(self) -> Flags:
        """Return the (n,) robots whose soles are both above the ground, by the perceived pose."""
        self.require_open()
        above = sole_heights(world_of(self.robot), self._coordinates()) > 0.0
        return np.asarray(above.all(axis=1))

    def torque_shares(self, rows: slice | Ints) -> Floats:
        """Return the (k, J) share of its torque limit that each motor applied last, from -1 to 1, as perceived."""
        angles, speeds = (np.radians(self.perceptors[name][rows]) for name in ("joint_angles", "joint_speeds"))
        return torque_shares(self.robot, self._acting[rows], angles, speeds)

    def _coordinates(self) -> Floats:
        """Return (n, 7 + J) torso positions and quaternions, and joint angles in radians, as perceived."""
        quaternions = self.perceptors["torso_quat"]
        quaternions = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
        angles = np.radians(self.perceptors["joint_angles"])
        return np.concatenate((self.truth.torso_position, quaternions, angles), axis=1)
