"""Put simulators behind one interface."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Protocol

import numpy as np
from naosim.robots import nao_model
from naosim.simspark import BatchSimulator

from naosprint.actuation import Actuation
from naosprint.servers import RemoteSimulator, require_servers, server_launcher
from naosprint.starts import DROP_M, settle

if TYPE_CHECKING:
    from naosim.robots.nao_model import RobotModel
    from naospec import SimulatorName, Task

    from naosprint.arrays import BoolArray, ByteArray, FloatArray, IntArray


class Perceptors(Protocol):
    """What the reply to the last command carries, for n environments; no foot record where nothing is touched."""

    @property
    def joint_angles(self) -> FloatArray:
        """Return (n, J) angles in degrees."""

    @property
    def gyro(self) -> FloatArray:
        """Return (n, 3) rates in degrees per second, torso frame."""

    @property
    def accel(self) -> FloatArray:
        """Return (n, 3) accelerations in m/s^2, torso frame."""

    @property
    def foot_left(self) -> FloatArray:
        """Return (n, 6) centre of pressure in metres and force in newtons, foot frame; NaN where none was sent."""

    @property
    def foot_right(self) -> FloatArray:
        """Return the same of the right foot."""


class Truth(Protocol):
    """Where n robots really are, now."""

    @property
    def torso_position(self) -> FloatArray:
        """Return (n, 3) positions in metres, world frame."""

    @property
    def torso_rotation(self) -> FloatArray:
        """Return (n, 3, 3) rotations from the torso's frame into the world's."""

    @property
    def bodies(self) -> FloatArray:
        """Return (n, B, 13) states of all bodies: position, quaternion w x y z, velocity, angular velocity.

        Velocities are NaN where the simulator does not tell them.
        """


class Simulator(Protocol):
    """Run n robots, each on a field of its own."""

    n: int
    model: RobotModel
    groups: tuple[slice, ...]
    """Robots that are best stepped together: while one group computes, the caller may see to another."""

    @property
    def perceptors(self) -> Perceptors:
        """What the robots perceive; valid until the next call."""

    @property
    def truth(self) -> Truth:
        """Where the robots are; valid until the next call."""

    @property
    def lost(self) -> BoolArray:
        """Which of the n robots have lost what runs them; they stand still until they are started again."""

    @property
    def failures(self) -> int:
        """How often a lost robot has been given a new place to run."""

    def loss_reason(self, row: int) -> str:
        """Say why the robot ``row`` is lost; empty if it is not."""

    def keep_alive(self) -> AbstractContextManager[None]:
        """Return a context in which the robots survive, however long nothing is stepped."""

    def load_starts(self, poses_rad: FloatArray) -> None:
        """Make (k, J) start poses known, in radians."""

    def start(self, rows: IntArray, starts: IntArray, following: IntArray | None = None) -> None:
        """Put the robots ``rows`` on the start line, settled in the start poses ``starts``.

        Args:
            rows: (k,) robots.
            starts: (k,) start poses.
            following: (k,) the start poses after these, where they are known, for a simulator that prepares them.
        """

    def step(self, speeds: FloatArray, active: BoolArray | None = None) -> None:
        """Advance by one cycle with (n, J) joint speeds in rad/s; only the robots of the mask, where one is given."""

    def send(self, speeds: FloatArray, group: slice) -> None:
        """Begin a cycle of a group's robots with (k, J) joint speeds in rad/s."""

    def receive(self, group: slice) -> None:
        """Finish the cycle that :meth:`send` has begun."""

    def snapshot(self) -> ByteArray | None:
        """Return the complete state of every robot as (n, S) bytes; None where the simulator cannot."""

    def restore(self, state: ByteArray) -> None:
        """Go back to a snapshot."""

    def close(self) -> None:
        """Give back what the simulator holds."""


class EmbeddedSimulator:
    """Run n robots in the embedded engine.

    Starts are simulated once, by putting the robot down with straight joints and driving it into the start pose for
    60 cycles, and restored from a snapshot ever after.
    """

    def __init__(self, n: int, *, robot_type: int, task: Task, threads: int = 1, digits: int | None = 2) -> None:
        self.n = n
        self.model: RobotModel = nao_model.model(robot_type)
        self.groups: tuple[slice, ...] = (slice(0, n),)
        self._sent: FloatArray = np.zeros((n, len(self.model.joints)))
        self._actuation = Actuation(self.model)
        self._start_position = (task.start_x_m, task.start_y_m, self.model.standing_height + DROP_M)
        self._threads = threads
        self._digits = digits
        self._engine = BatchSimulator(n, robot_type=robot_type, threads=threads, digits=digits)
        self._robot_type = robot_type
        self._starts: ByteArray | None = None
        self._lost: BoolArray = np.zeros(n, dtype=np.bool_)

    @property
    def perceptors(self) -> Perceptors:
        """What the robots perceive; valid until the next call."""
        return self._engine.perceptors

    @property
    def truth(self) -> Truth:
        """Where the robots are; valid until the next call."""
        return self._engine.truth

    @property
    def lost(self) -> BoolArray:
        """Which robots are lost: none ever is."""
        return self._lost

    @property
    def failures(self) -> int:
        """How many robots were lost so far: none."""
        return 0

    def loss_reason(self, row: int) -> str:
        """Return an empty string: no robot is lost."""
        del row
        return ""

    def keep_alive(self) -> AbstractContextManager[None]:
        """Return a context that does nothing: the engine waits for ever."""
        return nullcontext()

    def load_starts(self, poses_rad: FloatArray) -> None:
        """Simulate (k, J) start poses, in radians, and keep what came of them."""
        engine = BatchSimulator(len(poses_rad), robot_type=self._robot_type, threads=self._threads, digits=self._digits)
        settle(engine, self._actuation, poses_rad, self._start_position)
        self._starts = np.array(engine.snapshot())

    def start(self, rows: IntArray, starts: IntArray, following: IntArray | None = None) -> None:
        """Put the robots ``rows`` on the start line, settled in the start poses ``starts``."""
        del following  # a start is a snapshot, there is nothing to prepare
        if self._starts is None:
            raise RuntimeError("no start poses: call load_starts first")
        mask = np.zeros(self.n, dtype=np.bool_)
        mask[rows] = True
        # restore fills the masked robots in ascending order
        order = np.argsort(rows, kind="stable")
        self._engine.restore(self._starts[starts[order]], mask=mask)

    def step(self, speeds: FloatArray, active: BoolArray | None = None) -> None:
        """Advance by one cycle with (n, J) joint speeds in rad/s; only the robots of the mask, where one is given."""
        if active is None:
            self._engine.step(speeds)
        else:
            self._engine.step(speeds, active)

    def send(self, speeds: FloatArray, group: slice) -> None:
        """Keep (n, J) joint speeds in rad/s for :meth:`receive`: there is one group, all robots."""
        del group
        self._sent = speeds

    def receive(self, group: slice) -> None:
        """Advance by one cycle."""
        del group
        self.step(self._sent)

    def snapshot(self) -> ByteArray:
        """Return the complete state of every robot as (n, S) bytes."""
        return np.array(self._engine.snapshot())

    def restore(self, state: ByteArray) -> None:
        """Go back to a snapshot."""
        self._engine.restore(state)

    def close(self) -> None:
        """Do nothing: the engine holds memory alone."""


def open_simulator(
    name: SimulatorName,
    n: int,
    *,
    robot_type: int,
    task: Task,
    threads: int,
    digits: int | None,
    max_server_failures: int,
    standby_servers: bool = False,
) -> Simulator:
    """Open the simulator called ``name`` for n robots.

    Args:
        name: ``embedded`` or ``rcssserver3d``.
        n: number of robots.
        robot_type: 0 to 4.
        task: says where the robots start.
        threads: threads of the embedded engine.
        digits: decimals of the perceptors; a server that is not ours has its own.
        max_server_failures: so many servers may be replaced.
        standby_servers: whether each robot on a server has a second server that prepares its next start.

    Raises:
        ValueError: if there is no such simulator, or this machine cannot carry so many servers.
        FileNotFoundError: if the server's program is not here.
        naosim.ServerLostError: if a server does not start.
    """
    if name == "embedded":
        return EmbeddedSimulator(n, robot_type=robot_type, task=task, threads=threads, digits=digits)
    if name == "rcssserver3d":
        require_servers(n)
        launcher = server_launcher(digits)
        return RemoteSimulator(
            launcher,
            n,
            robot_type=robot_type,
            task=task,
            max_failures=max_server_failures,
            standby_servers=standby_servers,
        )
    raise ValueError(f"simulator: {name!r} is unknown; use 'embedded' or 'rcssserver3d'")
