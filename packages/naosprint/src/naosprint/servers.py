"""Run robots on rcssserver3d servers, one server each."""

from __future__ import annotations

from dataclasses import dataclass
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np
from naosim.launchers import LABELS_VARIABLE, NETWORK_VARIABLE, most_servers, reap_servers, require_servers
from naosim.simspark import BatchSimulator, RemoteBatch
from naosim.simspark.kinematics import body_poses
from naosim.simspark.program import PROGRAM_VARIABLE, server_launcher

from naosprint.actuation import Actuation
from naosprint.starts import DROP_M, RUNNING_YAW_DEG, settle

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from naosim.launchers import Launcher
    from naosim.robots.nao_model import RobotModel
    from naosim.simspark.client import Act
    from naospec import Task

    from naosprint.arrays import BoolArray, FloatArray, IntArray
    from naosprint.simulator import Perceptors

__all__ = [
    "LABELS_VARIABLE",
    "NETWORK_VARIABLE",
    "PROGRAM_VARIABLE",
    "RemoteSimulator",
    "most_servers",
    "reap_servers",
    "require_servers",
    "server_launcher",
]

_REPLY_TIMEOUT_S = 10.0
_START_TIMEOUT_S = 30.0

_IDLE_S = 20.0
"""A standby server that waits for its robot is stepped so often: servers drop agents silent for 61 s."""

_NO_START = -1

_LANDING_M = 0.004
"""Height above where it is going to stand from which a robot is let down."""

_LANDING_CYCLES = 30
"""Cycles in which it is driven into its own start pose after that."""


class RemotePerceptors:
    """What n robots perceive, by the latest messages of their servers; valid until the next step."""

    def __init__(self, remote: RemoteBatch, servers: IntArray) -> None:
        self._remote = remote
        self._servers = servers

    @property
    def time(self) -> FloatArray:
        """Return (n,) times of the servers in seconds."""
        return self._remote.perceptors.time[self._servers]

    @property
    def joint_angles(self) -> FloatArray:
        """Return (n, J) angles in degrees."""
        return self._remote.perceptors.joint_angles[self._servers]

    @property
    def gyro(self) -> FloatArray:
        """Return (n, 3) rates in degrees per second, torso frame."""
        return self._remote.perceptors.gyro[self._servers]

    @property
    def accel(self) -> FloatArray:
        """Return (n, 3) accelerations in m/s^2, torso frame."""
        return self._remote.perceptors.accel[self._servers]

    @property
    def foot_left(self) -> FloatArray:
        """Return (n, 6) centre of pressure in metres and force in newtons, foot frame; NaN where none was sent."""
        return self._remote.perceptors.foot_left[self._servers]

    @property
    def foot_right(self) -> FloatArray:
        """Return the same of the right foot."""
        return self._remote.perceptors.foot_right[self._servers]


class RemoteTruth:
    """Where n robots are, as the servers' monitor ports show it; valid until the next step.

    A torso's pose is as exact as the server sends it: coordinates change in steps of 0.005 (metres, matrix elements),
    unless every cycle asks for the full scene.
    """

    def __init__(self, remote: RemoteBatch, servers: IntArray) -> None:
        self._remote = remote
        self._servers = servers

    @property
    def torso_position(self) -> FloatArray:
        """Return (n, 3) positions in metres, world frame."""
        return self._remote.truth.torso_position[self._servers]

    @property
    def torso_rotation(self) -> FloatArray:
        """Return (n, 3, 3) rotations from the torso's frame into the world's."""
        return self._remote.truth.torso_rotation[self._servers]

    @property
    def bodies(self) -> FloatArray:
        """Return (n, B, 7) body poses by forward kinematics from the perceived angles."""
        angles = self._remote.perceptors.joint_angles[self._servers]
        return body_poses(self._remote.model, self.torso_position, self.torso_rotation, angles)


@dataclass(slots=True)
class _Standby:
    """A server that gets a robot's next start ready while the robot is still running on another."""

    server: int
    start: int = _NO_START
    """Which start pose it prepares, or has prepared; ``_NO_START`` if neither."""
    waiting_since: float = 0.0
    """When it was last stepped, s."""


class RemoteSimulator:
    """Run n robots on rcssserver3d servers, all driven from this process.

    Every start is simulated: the robot is untangled in the air, brought there into the start pose without noise, let
    down to where the embedded engine's robot stands that has settled in this pose, and driven into its own pose for 30
    cycles. So that nobody waits for that, each robot may have a standby server, which prepares the next start in the
    cycles in which the robot runs; at the start the two change places. A robot whose server fails is marked in
    :attr:`lost`; its next start begins with a new server.

    Two robots or more are two groups: the servers of one compute while the caller sees to the other.

    Args:
        launcher: starts the servers.
        n: number of robots.
        robot_type: 0 to 4.
        task: says where the start line is.
        max_failures: so many servers may be replaced.
        standby_servers: whether there are two servers a robot, where starts are told in advance.
        exact: ask for the full scene in every cycle; much slower.

    Raises:
        naosim.ServerLostError: if a server does not start; the message says why.
    """

    def __init__(
        self,
        launcher: Launcher,
        n: int,
        *,
        robot_type: int,
        task: Task,
        max_failures: int,
        standby_servers: bool = False,
        exact: bool = False,
    ) -> None:
        self._remote = RemoteBatch(
            launcher,
            2 * n if standby_servers else n,
            robot_type,
            team="naosprint",
            timeout_s=_REPLY_TIMEOUT_S,
            start_timeout_s=_START_TIMEOUT_S,
            max_failures=max_failures,
            exact=exact,
        )
        self.n = n
        self.model: RobotModel = self._remote.model
        self.groups: tuple[slice, ...] = (slice(0, n),) if n < 2 else (slice(0, -(-n // 2)), slice(-(-n // 2), n))
        self._actuation = Actuation(self.model)
        self._start_position = (task.start_x_m, task.start_y_m, self.model.standing_height + DROP_M)
        engine = BatchSimulator(1, robot_type, digits=None)
        settle(engine, self._actuation, self._actuation.start_pose()[None], self._start_position)
        self._stand = engine.truth.torso_position[0] + np.array((0.0, 0.0, _LANDING_M))
        self._servers: IntArray = np.arange(n)
        self._standbys = [_Standby(n + row) for row in range(n)] if standby_servers else []
        self._acts: dict[int, Act] = {}  # by server, of those that prepare a start
        self._speeds = np.zeros((self._remote.n, len(self.model.joints)))
        self._sent: BoolArray = np.zeros(self._remote.n, dtype=np.bool_)  # servers that have not been heard since
        self._perceptors = RemotePerceptors(self._remote, self._servers)
        self._truth = RemoteTruth(self._remote, self._servers)
        self._starts: FloatArray | None = None

    @property
    def perceptors(self) -> Perceptors:
        """What the robots perceive; valid until the next call."""
        return self._perceptors

    @property
    def truth(self) -> RemoteTruth:
        """Where the robots are; valid until the next call."""
        return self._truth

    @property
    def lost(self) -> BoolArray:
        """Which robots have lost their server; they stand still until they are started again."""
        return self._remote.failed[self._servers]

    @property
    def failures(self) -> int:
        """How many servers have been replaced so far."""
        return self._remote.restarts

    def loss_reason(self, row: int) -> str:
        """Say why the robot ``row`` has lost its server; empty if it has not."""
        return self._remote.reason(int(self._servers[row]))

    def keep_alive(self) -> AbstractContextManager[None]:
        """Return a context in which servers do not drop their robots, however long nothing is stepped."""
        return self._remote.keep_alive()

    def load_starts(self, poses_rad: FloatArray) -> None:
        """Make (k, J) start poses known, in radians."""
        self._starts = np.array(poses_rad, dtype=np.float64)
        self._acts.clear()
        for standby in self._standbys:
            standby.start = _NO_START

    def start(self, rows: IntArray, starts: IntArray, following: IntArray | None = None) -> None:
        """Put the robots ``rows`` on the start line, settled in the start poses ``starts``.

        Args:
            rows: (k,) robots.
            starts: (k,) start poses.
            following: (k,) the start poses after these, for standby servers to prepare.

        Raises:
            naosim.ServerLostError: if more servers fail than are allowed, or a new one does not start.
        """
        for row, start in zip(rows.tolist(), starts.tolist(), strict=True):
            if self._standbys:
                standby = self._standbys[row]
                if standby.start != start:
                    self._prepare(standby, start)
                self._servers[row], standby.server = standby.server, int(self._servers[row])
                standby.start = _NO_START
            else:
                self._acts[int(self._servers[row])] = self._starting(int(self._servers[row]), start)
        for row, start in zip(rows.tolist(), [] if following is None else following.tolist(), strict=False):
            if self._standbys:
                self._prepare(self._standbys[row], start)
        ours = self._servers_of(rows)
        entering = dict(zip(self._servers[rows].tolist(), starts.tolist(), strict=True))
        standbys = [self._standbys[row] for row in rows.tolist()] if self._standbys else []
        preparing = entering | {standby.server: standby.start for standby in standbys}
        while entering:
            # only these: whoever else has lost its server has an episode to cut off first
            for server in self._remote.replace([server for server in preparing if self._remote.failed[server]]):
                if preparing[server] != _NO_START:
                    self._acts[server] = self._starting(server, preparing[server])
            self._send(np.zeros(self._remote.n, dtype=np.bool_), ours)
            self._receive(ours)
            entering = {
                server: start
                for server, start in entering.items()
                if server in self._acts or self._remote.failed[server]
            }

    def step(self, speeds: FloatArray, active: BoolArray | None = None) -> None:
        """Advance by one cycle with (n, J) joint speeds in rad/s; only the robots of the mask, where one is given."""
        rows = np.arange(self.n) if active is None else np.flatnonzero(active)
        self._speeds[self._servers[rows]] = speeds[rows]
        ours = self._servers_of(rows)
        self._send(self._mask(rows), ours)
        self._receive(ours)

    def send(self, speeds: FloatArray, group: slice) -> None:
        """Begin a cycle of a group's robots with (k, J) joint speeds in rad/s; its servers compute meanwhile."""
        self._speeds[self._servers[group]] = speeds
        self._send(self._mask(group), self._servers_of(group))

    def receive(self, group: slice) -> None:
        """Finish the cycle that :meth:`send` has begun."""
        self._receive(self._servers_of(group))

    def _mask(self, rows: IntArray | slice) -> BoolArray:
        """Return the servers on which robots run."""
        mask = np.zeros(self._remote.n, dtype=np.bool_)
        mask[self._servers[rows]] = True
        return mask

    def _servers_of(self, rows: IntArray | slice) -> BoolArray:
        """Return the servers of robots, standby servers among them."""
        mask = np.zeros((self._remote.n // self.n, self.n), dtype=np.bool_)
        mask[:, rows] = True
        return mask.reshape(-1)

    def _send(self, mask: BoolArray, ours: BoolArray) -> None:
        """Begin a cycle on the servers of the mask and on those of ours that prepare a start."""
        if self._acts:
            mask |= self._remote.cue(self._acts, self._speeds, ours)
        now = monotonic()
        for standby in self._standbys:
            server = standby.server
            if not mask[server] and ours[server] and now > standby.waiting_since + _IDLE_S:
                self._speeds[server], mask[server] = 0.0, True
            if mask[server]:
                standby.waiting_since = now
        if mask.any():
            self._remote.send(self._speeds, mask)
        self._sent |= mask

    def _receive(self, ours: BoolArray) -> None:
        """Finish the cycle of those of our servers to which something was sent."""
        mask = self._sent & ours
        if mask.any():
            self._remote.receive(mask)
        self._sent &= ~ours

    def _prepare(self, standby: _Standby, start: int) -> None:
        standby.start = start
        self._acts[standby.server] = self._starting(standby.server, start)

    def _starting(self, server: int, start: int) -> Act:
        """Bring a server's robot to the start: yield the joint speeds of the cycle that is to come."""
        if self._starts is None:
            raise RuntimeError("no start poses: call load_starts first")
        remote, pose = self._remote, self._starts[start]
        yield from remote.untangling(server, self._actuation.start_pose())
        yield from remote.beaming(server, self._stand, RUNNING_YAW_DEG)
        for _ in range(_LANDING_CYCLES):
            yield self._actuation.speeds(pose, remote.perceptors.joint_angles[server])

    def snapshot(self) -> None:
        """Return None: a server cannot tell its whole state."""

    def restore(self, state: object) -> None:
        """Refuse: a server cannot go back.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("rcssserver3d cannot go back to a snapshot")

    def close(self) -> None:
        """Close all connections and stop the servers."""
        self._remote.close()
