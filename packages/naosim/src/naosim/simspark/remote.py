"""NAOs on rcssserver3d servers, one server each."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np

from naosim.robots.nao import model_of
from naosim.simspark.batch import BatchSimulator
from naosim.simspark.client import RemoteBatch
from naosim.simspark.control import motor_speeds, settle, yaw_deg
from naosim.simspark.embedded import unloaded, upward_forces
from naosim.simspark.kinematics import body_poses
from naosim.simulator import Simulator, Truth

if TYPE_CHECKING:
    from collections.abc import Iterator

    from naosim.launchers import Launcher
    from naosim.robots import Robot
    from naosim.simspark.client import Act
    from naosim.simulator import Flags, Floats, Ints, Starts

_REPLY_TIMEOUT_S = 10.0
_START_TIMEOUT_S = 30.0

_IDLE_S = 20.0
"""Interval at which a standby server is stepped that waits for its robot: servers drop agents silent for 61 s."""

_NO_START = -1

_LANDING_M = 0.004
"""Height above its settled position from which a robot is let down."""

_LANDING_CYCLES = 30
"""Cycles in which it is driven into its own pose after that."""


@dataclass(slots=True)
class _Standby:
    """Server that prepares a robot's next start while the robot still runs on another."""

    server: int
    start: int = _NO_START
    """Start that it prepares, or has prepared; ``_NO_START`` if neither."""
    waiting_since: float = 0.0
    """When it was last stepped, s."""


class RemoteSimulator(Simulator):
    """NAOs on rcssserver3d servers, all driven from this process.

    Every start is simulated: the robot is untangled in the air, brought into the nominal pose there, let down at the
    position in which the embedded engine's robot has settled in this pose, and driven into its own pose for 30 cycles.
    To hide that time, each robot may have a standby server, which prepares the next start while the robot runs; at the
    start the two are exchanged. A robot whose server fails is marked in :attr:`lost`; its next start begins with a new
    server.

    Two robots or more are two groups: the servers of one compute while the caller processes the other.

    The torso's pose is as exact as the server sends it: coordinates change in steps of 0.005 (metres, matrix elements),
    unless every cycle asks for the full scene.

    Args:
        launcher: starts the servers.
        robot: a NAO.
        n: number of robots.
        max_failures: number of servers that may be replaced.
        standby_servers: whether there are two servers per robot.
        exact: ask for the full scene in every cycle; much slower.

    Raises:
        naosim.simulator.ServerLostError: if a server does not start; the message says why.
    """

    # a reply describes the state before the cycle that its command starts
    latency_steps = 2

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
        super().__init__(robot, n)
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
        if n > 1:
            self.groups = (slice(0, -(-n // 2)), slice(-(-n // 2), n))
        self._servers: Ints = np.arange(n)
        self._standbys = [_Standby(n + row) for row in range(n)] if standby_servers else []
        self._acts: dict[int, Act] = {}  # by server, of those that prepare a start
        self._speeds = np.zeros((self._remote.n, len(robot.joints)))
        self._sent: Flags = np.zeros(self._remote.n, dtype=np.bool_)  # servers whose replies are outstanding
        self._sources = {each.name: getattr(self._remote.perceptors, each.name) for each in robot.perceptors}
        self._views = {name: np.empty((n, source.shape[1])) for name, source in self._sources.items()}
        self.perceptors = self._views
        self.truth = Truth(np.empty((n, 3)), np.empty((n, 3, 3)))
        self._starts: Starts | None = None
        self._landing: Floats = np.zeros(3)
        self._refresh(slice(0, n))

    # steps

    def step_async(self, targets_rad: Floats, rows: slice, active: Flags | None = None) -> None:
        """Send joint speeds to the servers of these robots; they compute meanwhile."""
        self.require_open()
        self.require_group(rows)
        speeds = motor_speeds(targets_rad, self._views["joint_angles"][rows], self._model.max_speed)
        chosen = np.arange(rows.start, rows.stop)
        if active is not None:
            chosen, speeds = chosen[active], speeds[active]
        self._speeds[self._servers[chosen]] = speeds
        mask = np.zeros(self._remote.n, dtype=np.bool_)
        mask[self._servers[chosen]] = True
        self._send(mask, self._servers_of(chosen))

    def step_wait(self, rows: slice) -> None:
        """Read the replies of the servers of these robots."""
        self.require_open()
        self.require_group(rows)
        self._receive(self._servers_of(rows))
        self._refresh(rows)

    def _refresh(self, rows: slice | Ints) -> None:
        """Copy what the servers of these robots sent last."""
        servers = self._servers[rows]
        for name, view in self._views.items():
            view[rows] = self._sources[name][servers]
        self.truth.torso_position[rows] = self._remote.truth.torso_position[servers]
        self.truth.torso_rotation[rows] = self._remote.truth.torso_rotation[servers]

    def _servers_of(self, rows: Ints | slice) -> Flags:
        """Return the (servers,) mask of the servers of robots, standby servers among them."""
        mask = np.zeros((self._remote.n // self.n, self.n), dtype=np.bool_)
        mask[:, rows] = True
        # a standby server and its robot's server exchange roles, but both are a multiple of n from the row
        return mask.reshape(-1)

    def _send(self, mask: Flags, ours: Flags) -> None:
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

    def _receive(self, ours: Flags) -> None:
        """Finish the cycle of those of our servers whose replies are outstanding."""
        mask = self._sent & ours
        if mask.any():
            self._remote.receive(mask)
        self._sent &= ~ours

    # starts

    def load_starts(self, starts: Starts) -> None:
        """Replace the starts that :meth:`start` chooses from; what standby servers have prepared is dropped.

        Raises:
            ValueError: if starts are not upright.
        """
        self.require_open()
        if starts.orientations is not None:
            raise ValueError("starts: the NAO's simulators have upright starts only; leave orientations out")
        engine = BatchSimulator(1, self._model.robot_type, digits=None)
        settle(engine, self.robot.nominal[None], starts.position_m, starts.heading_rad)
        self._landing = engine.truth.torso_position[0] + np.array((0.0, 0.0, _LANDING_M))
        self._starts = starts
        self._acts.clear()
        for standby in self._standbys:
            standby.start = _NO_START

    def start(self, rows: Ints, starts: Ints, following: Ints | None = None) -> None:
        """Put robots into starts; standby servers prepare the ``following`` ones.

        Raises:
            naosim.simulator.ServerLostError: if more servers fail than are allowed, or a new one does not start.
        """
        self.require_open()
        self.require_starts(starts, 0 if self._starts is None else len(self._starts))
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
            # only these: the episodes of other lost robots have to be truncated first
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
        self._refresh(rows)

    def _prepare(self, standby: _Standby, start: int) -> None:
        standby.start = start
        self._acts[standby.server] = self._starting(standby.server, start)

    def _starting(self, server: int, start: int) -> Act:
        """Bring a server's robot into a start: yield the joint speeds of each cycle."""
        assert self._starts is not None
        remote, pose, yaw = self._remote, self._starts.poses_rad[start], yaw_deg(self._starts.heading_rad)
        yield from remote.untangling(server, self.robot.nominal)
        yield from remote.beaming(server, self._landing, yaw)
        for _ in range(_LANDING_CYCLES):
            yield motor_speeds(pose, remote.perceptors.joint_angles[server], self._model.max_speed)

    # what a viewer needs

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

    # servers

    @property
    def lost(self) -> Flags:
        """(n,) robots that lost their server; they stand still until they are started again."""
        return self._remote.failed[self._servers]

    @property
    def can_fail(self) -> bool:
        """Whether robots can be lost: with their server."""
        return True

    @property
    def failures(self) -> int:
        """Number of servers that have been replaced."""
        return self._remote.restarts

    def loss_reason(self, row: int) -> str:
        """Return why the robot ``row`` lost its server; empty if it did not."""
        return self._remote.reason(int(self._servers[row]))

    @contextmanager
    def keep_alive(self) -> Iterator[None]:
        """Keep servers from dropping their robots while nothing is stepped."""
        self.require_open()
        with self._remote.keep_alive():
            yield
        self._refresh(slice(0, self.n))

    def close(self) -> None:
        """Close all connections and stop the servers."""
        if not self.closed:
            super().close()
            self._remote.close()
