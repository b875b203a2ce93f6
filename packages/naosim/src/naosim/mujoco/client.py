"""Booster robots on rcssservermj servers; see `naosim.fleet`.

Requirements of the server that this client meets:

- A robot that enters before the server's first cycle kills it, so a monitor waits for that cycle first.
- The joints' targets are uninitialised memory after a robot has entered, and one that is huge makes MuJoCo drop those
  of all joints: the first message commands every joint.
- A server drops agents that are silent for 5 s.
- The K1's first touch of the ball kills the server: the ball is put aside.
- The game's mode stays BeforeKickOff, in which beams are allowed and no robot is removed.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from naosim.fields import RCSSSERVERMJ
from naosim.fleet import Fleet, Motion, Rows
from naosim.launchers import Address, Launcher
from naosim.mujoco._mujoco import Exchange
from naosim.mujoco.batch import PERCEPTORS
from naosim.mujoco.world import PARKED_BALL_M, UNIFORM_NUMBER, Floats, gains
from naosim.simulator import BALL

if TYPE_CHECKING:
    from collections.abc import Mapping

    from naosim.robots import Robot

_QUIET_S = 0.1
"""Silence after which a server in sync mode is waiting for its agent."""

_FIRST_CYCLES = 5
"""Cycles in which a new robot takes its first commands and the ball is put aside."""

_MODE = "BeforeKickOff"

_LEAVE_S = 1.0
"""Time after which a connection that the server does not end is closed all the same."""


class MujocoFleet(Fleet):
    """One Booster robot of the left team on each of n servers; commands are target angles in rad.

    Args:
        servers: a launcher, which starts n servers and new ones for those that fail, or the addresses of servers that
            run already, which cannot be replaced.
        robot: the robot, with its gains.
        n: number of servers; only with a launcher.
        timeout_s: time without a reply after which a server has failed.
        start_timeout_s: the same for the start of a server and its first answers.
        max_failures: number of servers that may be replaced before `replace` raises.
        ball: whether the ball is perceived and can be placed, which keeps a monitor on every server.

    Attributes:
        perceptors: (n, width) arrays by name, in the units of ``robot.perceptors``; every step overwrites them.
        time: (n,) simulated seconds, as the servers print them.
        rotation: (n, 3, 3) rotations from the torso's frame into the world's, from the perceived quaternion.

    Raises:
        ValueError: an argument is out of range.
        ServerLostError: a server did not start; the message states why.
    """

    command_name: ClassVar[str] = "targets_rad"
    silence_s: ClassVar[float] = 1.5

    def __init__(
        self,
        servers: Launcher | Sequence[Address],
        robot: Robot,
        n: int | None = None,
        *,
        timeout_s: float = 10.0,
        start_timeout_s: float = 60.0,
        max_failures: int = 100,
        ball: bool = False,
    ) -> None:
        super().__init__(
            servers,
            n,
            len(robot.joints),
            timeout_s=timeout_s,
            start_timeout_s=start_timeout_s,
            max_failures=max_failures,
        )
        self.robot = robot
        self._monitors: dict[int, socket.socket] = {}
        self._keeps_monitors = ball
        kp, kd = gains(robot)
        effectors = [joint.effector for joint in robot.joints]
        self._exchange: Exchange = Exchange(
            self.n, [f"q_{name.replace('e', 'j')}" for name in effectors], effectors, kp.tolist(), kd.tolist(), ball
        )
        views: dict[str, Floats] = self._exchange.views()
        self.perceptors: Mapping[str, Floats] = {
            name: views[name] for name in (*PERCEPTORS, *((BALL,) if ball else ()))
        }
        self.time: Floats = views["time"]
        self.rotation: Floats = views["rotation"]
        self._idle[:] = robot.nominal
        self._start()

    # steps

    def renew(self) -> None:
        """Read what servers have sent, and step those to which nothing has been sent for a while.

        Their robots hold the last command.
        """
        super().renew()
        self._skip_frames()

    def starting(
        self, row: int, pose_rad: Floats, position_m: tuple[float, float], heading_rad: float, settle_steps: int
    ) -> Motion:
        """Beam one robot and drive it into a pose: yield the target angles of each cycle.

        The reply to the last of them is what the robot perceives after ``settle_steps`` steps.

        Args:
            row: which robot.
            pose_rad: (joints,) angles.
            position_m: x and y; x is not positive.
            heading_rad: direction the robot faces, counter-clockwise from +x.
            settle_steps: steps in which the motors hold the pose.
        """
        if self._exchange.play_mode(row) != _MODE:
            self._fail(row, f"the game left mode {_MODE!r}, in which robots can be moved: the ball crossed a line")
            return
        x, y = position_m
        self._exchange.prepend(row, f"(beam {x:.6f} {y:.6f} {np.rad2deg(heading_rad):.6f})")
        for _ in range(settle_steps + 1):
            yield pose_rad

    # servers

    def place_ball(self, row: int, position: Floats, velocity: Floats) -> None:
        """Place the ball of one server, (3,) in metres and (3,) in m/s; it is there when its next cycle ends."""
        numbers = [" ".join(f"{value:.4f}" for value in values.tolist()) for values in (position, velocity)]
        try:
            self._monitors[row].sendall(_framed(f"(ball (pos {numbers[0]})(vel {numbers[1]}))"))
        except (OSError, KeyError) as error:
            self._fail(row, f"monitor port: {error!r}")

    def messages(self, row: int) -> int:
        """Return how many messages one server has sent."""
        return self._exchange.messages(row)

    def _gather(self, rows: Rows) -> None:
        super()._gather(rows)
        self._skip_frames()

    def _skip_frames(self) -> None:
        for monitor in list(self._monitors.values()):
            with suppress(OSError):  # a lost server is noticed at its agent port
                while monitor.recv(1 << 20):
                    pass

    def _leave_monitor(self, row: int) -> None:
        monitor = self._monitors.pop(row, None)
        if monitor is not None:
            _leave(monitor)

    def close(self) -> None:
        """Close all connections and stop the servers that were started."""
        self._closing.set()
        for row in list(self._monitors):
            self._leave_monitor(row)
        super().close()

    def _enter(self, row: int, address: Address, deadline: float) -> None:
        monitor = self._watching(row, address, deadline)
        try:
            agent = self._connect_port(row, address.host, address.agent_port, deadline)
            self._exchange.attach(row, agent.detach(), -1)
            self._shake_hands(row, monitor, deadline)
        except BaseException:
            _leave(monitor)
            raise
        self._leave_monitor(row)
        if self._keeps_monitors:
            monitor.setblocking(False)
            self._monitors[row] = monitor
        else:
            _leave(monitor)

    def _watching(self, row: int, address: Address, deadline: float) -> socket.socket:
        """Return a connection to the monitor port that has received a frame.

        The first frame comes after the first cycle, and a robot that enters before that cycle kills the server.
        """
        pause = threading.Event()
        while True:
            monitor = self._connect_port(row, address.host, address.monitor_port, deadline)
            if self._receives_frame(row, monitor, deadline):
                return monitor
            # a container's port is open before the server in it listens
            monitor.close()
            if self._launcher is None or time.monotonic() > deadline:
                raise OSError(f"{address.host}:{address.monitor_port}: closed by the server")
            pause.wait(0.05)

    def _receives_frame(self, row: int, monitor: socket.socket, deadline: float) -> bool:
        """Wait for a frame; return whether one came before the connection was closed."""
        while True:
            monitor.settimeout(max(0.1, min(1.0, deadline - time.monotonic())))
            try:
                return bool(monitor.recv(65536))
            except TimeoutError:
                handle = self._handles[row]
                if time.monotonic() > deadline or (handle is not None and not handle.alive()):
                    raise OSError("monitor port: the server does not run a cycle") from None
            except ConnectionError:
                return False

    def _shake_hands(self, row: int, monitor: socket.socket, deadline: float) -> None:
        exchange, only = self._exchange, np.zeros(self.n, dtype=np.uint8)
        only[row] = 1

        def left_s() -> float:
            return max(0.1, deadline - time.monotonic())

        model = self.robot.data["model"]
        exchange.post(row, False, f"(init {model} naosprint {UNIFORM_NUMBER})".encode())
        exchange.collect(only, 1, 0, left_s())
        x, y = PARKED_BALL_M
        monitor.sendall(_framed(f"(ball (pos {x} {y} {RCSSSERVERMJ.ball_radius_m})(vel 0 0 0))"))
        for _ in range(_FIRST_CYCLES):
            if exchange.failure(row):
                break
            # not through `step`: other rows may be open, and the caller that replaces servers holds the lock
            exchange.dispatch(self._idle, only)
            exchange.gather(only, left_s(), False)
        exchange.drain(row, _QUIET_S, left_s())
        mode, messages = exchange.play_mode(row), exchange.messages(row)
        if messages > 1 + _FIRST_CYCLES:
            exchange.fail(
                row, f"got {messages} messages for {1 + _FIRST_CYCLES} commands: it must run in sync mode (--sync)"
            )
        if mode != _MODE:
            exchange.fail(row, f"the game is in mode {mode!r}, robots can enter in {_MODE!r} only; start a new server")


def _framed(text: str) -> bytes:
    return len(text).to_bytes(4, "big") + text.encode()


def _leave(monitor: socket.socket) -> None:
    """Close a connection to the monitor port once the server has stopped sending.

    With unread frames it would be reset, which kills a server that is sending to it.
    """
    with monitor, suppress(OSError):
        monitor.settimeout(_LEAVE_S)
        monitor.shutdown(socket.SHUT_WR)
        while monitor.recv(65536):
            pass
