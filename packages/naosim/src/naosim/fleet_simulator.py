"""Simulators whose robots run on servers: groups, starts prepared in advance, lost servers."""

from __future__ import annotations

from abc import abstractmethod
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from naosim.simulator import PLAIN, TOUCHING, BodyState, NativeHandle, Scene, Simulator, Truth, halves

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from naosim.fleet import Fleet, Motion
    from naosim.robots import Robot
    from naosim.simulator import Flags, Floats, Ints, Starts

_NO_START = -1
_MOTION = ((3,), (3, 3), (3,), (3,))  # shapes of a body's position, rotation, velocity and spin


@dataclass(slots=True)
class Standby:
    """Server that prepares a robot's next start while the robot still runs on another."""

    server: int
    start: int = _NO_START
    """Start that it prepares, or has prepared; ``_NO_START`` if neither."""


class FleetSimulator(Simulator):
    """Robots on servers, all driven from this process.

    Every start is simulated on the server. To hide that time, each robot may have a standby server, which prepares the
    next start while the robot runs; at the start the two are exchanged. A robot whose server fails is marked in
    :attr:`lost`; its next start begins with a new server. Two robots or more are two groups: the servers of one compute
    while the caller processes the other.

    Args:
        fleet: n servers, or 2 n with standby servers.
        robot: the robot that runs on them.
        n: number of robots.
        sources: the servers' latest perceptors by name, (servers, width) arrays.
        truth: the servers' latest torso poses.
        scene: what is reported besides the robot.
    """

    # a reply describes the state before the cycle that its command starts
    latency_steps = 2
    native = NativeHandle()

    def __init__(
        self,
        fleet: Fleet,
        robot: Robot,
        n: int,
        *,
        sources: Mapping[str, Floats],
        truth: Truth,
        scene: Scene = PLAIN,
    ) -> None:
        super().__init__(robot, n, scene)
        self._fleet = fleet
        self.groups = halves(n)
        self._servers: Ints = np.arange(n)
        self._standbys = [Standby(n + row) for row in range(n)] if fleet.n > n else []
        self.prepares_starts = bool(self._standbys)
        self._motions: dict[int, Motion] = {}  # by server, of those that prepare a start
        self._commands = np.zeros((fleet.n, len(robot.joints)))
        self._sent: Flags = np.zeros(fleet.n, dtype=np.bool_)  # servers whose replies are outstanding
        self._sources, self._source_truth = sources, truth
        self._views = {name: np.empty((n, source.shape[1])) for name, source in sources.items()}
        self.perceptors = self._views
        bodies = {name: BodyState(*(np.zeros((n, *shape)) for shape in _MOTION)) for name in scene.moving}
        contacts = {name: np.zeros(n) for name in TOUCHING} if scene.ball else {}
        self.truth = Truth(np.empty((n, 3)), np.empty((n, 3, 3)), bodies, contacts)
        self._starts: Starts | None = None
        self._refresh(slice(0, n))

    # what depends on the kind of server

    @abstractmethod
    def _commands_of(self, targets_rad: Floats, rows: slice) -> Floats:
        """Return the (k, J) commands that drive robots to (k, J) target angles.

        Raises:
            ValueError: if the targets are malformed.
        """

    @abstractmethod
    def _starting(self, server: int, start: int) -> Motion:
        """Move a server's robot to a start: yield the command of each cycle."""

    def _require_possible(self, starts: Starts) -> None:
        """Raise ValueError if the servers cannot move robots to these starts."""

    # steps

    def step_async(self, targets_rad: Floats, rows: slice, active: Flags | None = None) -> None:
        """Send commands to the servers of these robots; they compute meanwhile."""
        self.require_open()
        self.require_group(rows)
        commands = self._commands_of(targets_rad, rows)
        chosen = np.arange(rows.start, rows.stop)
        if active is not None:
            chosen, commands = chosen[active], commands[active]
        self._commands[self._servers[chosen]] = commands
        mask = np.zeros(self._fleet.n, dtype=np.bool_)
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
        self.truth.torso_position[rows] = self._source_truth.torso_position[servers]
        self.truth.torso_rotation[rows] = self._source_truth.torso_rotation[servers]

    def _servers_of(self, rows: Ints | slice) -> Flags:
        """Return the (servers,) mask of the servers of robots, standby servers among them."""
        mask = np.zeros((self._fleet.n // self.n, self.n), dtype=np.bool_)
        mask[:, rows] = True
        # a standby server and its robot's server exchange roles, but both are a multiple of n from the row
        return mask.reshape(-1)

    def _send(self, mask: Flags, ours: Flags) -> None:
        """Begin a cycle on the servers of ``mask`` and on those of ``ours`` that prepare a start."""
        if self._motions:
            mask |= self._fleet.next_commands(self._motions, self._commands, ours)
        if mask.any():
            self._fleet.send(self._commands, mask)
        self._sent |= mask

    def _receive(self, ours: Flags) -> None:
        """Finish the cycle of the servers of ``ours`` whose replies are outstanding."""
        mask = self._sent & ours
        if mask.any():
            self._fleet.receive(mask)
        self._sent &= ~ours

    # starts

    def load_starts(self, starts: Starts) -> None:
        """Replace the starts that :meth:`start` chooses from; what standby servers have prepared is dropped.

        Raises:
            ValueError: if the servers cannot move robots to these starts.
        """
        self.require_open()
        self._require_possible(starts)
        self._starts = starts
        self._motions.clear()
        for standby in self._standbys:
            standby.start = _NO_START

    def start(self, rows: Ints, starts: Ints, following: Ints | None = None) -> None:
        """Move robots to starts; standby servers prepare the ``following`` ones.

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
                self._motions[int(self._servers[row])] = self._starting(int(self._servers[row]), start)
        for row, start in zip(rows.tolist(), [] if following is None else following.tolist(), strict=False):
            if self._standbys:
                self._prepare(self._standbys[row], start)
        ours = self._servers_of(rows)
        entering = dict(zip(self._servers[rows].tolist(), starts.tolist(), strict=True))
        standbys = [self._standbys[row] for row in rows.tolist()] if self._standbys else []
        preparing = entering | {standby.server: standby.start for standby in standbys}
        while entering:
            # only these: the episodes of other lost robots have to be truncated first
            for server in self._fleet.replace([server for server in preparing if self._fleet.failed[server]]):
                if preparing[server] != _NO_START:
                    self._motions[server] = self._starting(server, preparing[server])
            self._send(np.zeros(self._fleet.n, dtype=np.bool_), ours)
            self._receive(ours)
            entering = {
                server: start
                for server, start in entering.items()
                if server in self._motions or self._fleet.failed[server]
            }
        self._refresh(rows)

    def _prepare(self, standby: Standby, start: int) -> None:
        standby.start = start
        self._motions[standby.server] = self._starting(standby.server, start)

    # servers

    @property
    def lost(self) -> Flags:
        """(n,) robots that lost their server; they stand still until they are started again."""
        return self._fleet.failed[self._servers]

    @property
    def can_fail(self) -> bool:
        """Whether robots can be lost: with their server."""
        return True

    @property
    def failures(self) -> int:
        """Number of servers that have failed and been replaced."""
        return self._fleet.restarts

    def loss_reason(self, row: int) -> str:
        """Return why the robot ``row`` lost its server; empty if it did not."""
        return self._fleet.reason(int(self._servers[row]))

    @contextmanager
    def keep_alive(self) -> Iterator[None]:
        """Return a context in which the fleet keeps the servers' robots while nothing is stepped."""
        self.require_open()
        yield
        self._refresh(slice(0, self.n))

    def close(self) -> None:
        """Close all connections and stop the servers."""
        if not self.closed:
            super().close()
            self._fleet.close()
