"""Many robots on servers, one server each, driven from one process: the part common to all kinds of servers.

A cycle first sends the commands of all servers, then collects the replies, so servers compute in parallel; `send` and
`receive` are the two halves, so that the caller can compute meanwhile. `step` does not raise when a server fails: the
environment is marked in `failed`, `reason` returns why, and `replace` starts another server in its place.

Servers drop robots whose agent is silent. A thread, and every wait for replies, reads what servers have sent and steps
those to which nothing was sent for a while, so a server that hangs costs no other server its robot. Where this process
was silent nevertheless, because it was stopped for example, servers are replaced without being counted as failed.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
import weakref
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from naosim.launchers import Address, Launcher, LauncherUnavailableError, ServerHandle
from naosim.simulator import Flags, Floats, ServerLostError, ServersUnavailableError

logger = logging.getLogger(__name__)

Motion = Iterator[Floats]
"""Motion of one environment over several cycles: yields the (joints,) commands of each."""

Rows = NDArray[np.uint8] | None


class Exchange(Protocol):
    """Connections to n servers, in C++."""

    def attach(self, row: int, agent: int, monitor: int) -> None:
        """Take over a server's sockets; -1 for no monitor."""

    def detach(self, row: int) -> None:
        """Close them."""

    def fail(self, row: int, reason: str) -> None:
        """Mark a server as failed, unless it has failed already."""

    def failure(self, row: int) -> str:
        """Return why a server has failed, or an empty string."""

    def dispatch(self, commands: Floats, rows: Rows) -> None:
        """Send (n, joints) commands."""

    def gather(self, rows: Rows, timeout_s: float, keeping: bool) -> int:
        """Read the answers, and renew others meanwhile; return how many servers have failed."""

    def admit(self, row: int) -> None:
        """Allow a server to be renewed from now on, until it is detached."""

    def set_silence(self, silence_s: float) -> None:
        """Set the time without a message after which a server is renewed."""

    def renew(self) -> int:
        """Read what servers have sent and step silent ones, waiting for nothing; return how many have failed."""

    def neglected(self, row: int) -> bool:
        """Return whether a server dropped its robot because nothing was sent to it."""


class Fleet(ABC):
    """One robot on each of n servers.

    Args:
        servers: a launcher, which starts n servers and new ones for those that fail, or the addresses of running
            servers, which cannot be replaced.
        n: number of servers; only with a launcher.
        joints: number of values in a robot's command.
        timeout_s: time without a reply after which a server has failed.
        start_timeout_s: the same for the start of a server and its first answers.
        max_failures: number of servers that may fail and be replaced before `replace` raises.

    Raises:
        ValueError: an argument is out of range.
    """

    command_name: ClassVar[str]
    """Name of the commands in error messages."""

    silence_s: ClassVar[float]
    """Time after which a server to which nothing has been sent is stepped, s; a third of what servers tolerate."""

    _exchange: Exchange

    def __init__(
        self,
        servers: Launcher | Sequence[Address],
        n: int | None,
        joints: int,
        *,
        timeout_s: float,
        start_timeout_s: float,
        max_failures: int,
    ) -> None:
        self._launcher: Launcher | None
        self._addresses: Sequence[Address]
        if isinstance(servers, Sequence):
            self._launcher, self._addresses = None, servers
            if n is not None and n != len(servers):
                raise ValueError(f"n: must equal the number of addresses, {len(servers)}, not {n}")
            n = len(servers)
        else:
            self._launcher, self._addresses = servers, ()
        if n is None or n < 1:
            raise ValueError(f"n: must be at least 1, not {n}")
        self.n = n
        self.restarts = 0
        """Number of servers that have failed and been replaced; without those that this process had left waiting."""
        self.failed: Flags = np.zeros(n, dtype=np.bool_)
        """(n,), environments whose server is lost; they keep still until replaced."""
        self._timeout_s, self._start_timeout_s, self._max_failures = timeout_s, start_timeout_s, max_failures
        self._entering: Flags = np.zeros(n, dtype=np.bool_)  # environments whose server is being started
        self._handles: list[ServerHandle | None] = [None] * n
        self._unavailable: set[int] = set()
        """Environments whose server could not be started because the engine that starts servers did not answer."""
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._idle = np.zeros((n, joints))
        """(n, joints) commands that hold the robots still."""

    @abstractmethod
    def _enter(self, row: int, address: Address, deadline: float) -> None:
        """Connect to a server and put the robot on the field; call `_exchange.fail` if the server does not comply.

        Raises:
            OSError: a port does not answer; another server is started then.
        """

    def _start(self) -> None:
        """Start or connect to all servers; the subclass calls this when it is ready.

        Raises:
            ServerLostError: a server did not start; the message states why.
        """
        self._exchange.set_silence(self.silence_s)
        threading.Thread(
            target=_beat, args=(weakref.ref(self), self._closing), name="keep servers alive", daemon=True
        ).start()
        try:
            self._open(range(self.n))
            for row in range(self.n):
                if self.failed[row]:
                    raise self._lost(row)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def reason(self, row: int) -> str:
        """Return why an environment has failed, or an empty string."""
        text = self._exchange.failure(row)
        handle = self._handles[row]
        if not text:
            return ""
        return f"{text} ({handle.describe()})" if handle is not None else text

    # steps

    def step(self, commands: ArrayLike, mask: ArrayLike | None = None) -> None:
        """Send commands and run one cycle on every server that has not failed.

        Args:
            commands: (n, joints).
            mask: (n,), which environments; the others keep still. Default all.

        Raises:
            ValueError: wrong shape, or a command is not finite; nothing has been sent then.
        """
        with self._lock:
            self.send(commands, mask)
            self.receive(mask)

    def send(self, commands: ArrayLike, mask: ArrayLike | None = None) -> None:
        """Send commands for one cycle and let the servers compute; `receive` reads their replies.

        Meanwhile servers that are not in the mask may be stepped, moved, reset or replaced, but not those in it.

        Args:
            commands: (n, joints).
            mask: (n,), which environments. Default all.

        Raises:
            ValueError: wrong shape, or a command is not finite, unless its server is lost; nothing has been sent then.
        """
        values = np.ascontiguousarray(commands, dtype=np.float64)
        if values.shape != self._idle.shape:
            raise ValueError(f"{self.command_name}: must have shape {self._idle.shape}, not {values.shape}")
        rows = self._rows(mask)
        if not np.isfinite(values[self._able(mask)]).all():
            raise ValueError(f"{self.command_name}: must be finite numbers")
        with self._lock:
            self._dispatch(values, rows)

    def _dispatch(self, commands: Floats, rows: Rows) -> None:
        self._exchange.dispatch(commands, rows)

    def receive(self, mask: ArrayLike | None = None) -> None:
        """Wait for the answers of servers to which `send` has sent, and read them.

        Args:
            mask: (n,), which environments. Default all.
        """
        with self._lock:
            self._gather(self._rows(mask))

    def _gather(self, rows: Rows) -> None:
        if self._exchange.gather(rows, self._timeout_s, True) != np.count_nonzero(self.failed):
            self._note_failures()

    def run_motions(self, motions: Mapping[int, Motion]) -> None:
        """Step the environments of `motions` in parallel until each motion has ended or its environment has failed."""
        motions = dict(motions)
        commands = self._idle.copy()
        with self._lock:
            while motions:
                mask = self.next_commands(motions, commands)
                if mask.any():
                    self.step(commands, mask)

    def next_commands(self, motions: dict[int, Motion], commands: Floats, among: Flags | None = None) -> Flags:
        """Get the next commands of every motion; drop motions that have ended or whose server is lost.

        Args:
            motions: by environment.
            commands: (n, joints), in which the rows are filled in.
            among: (n,), environments whose motions are advanced; default all.

        Returns:
            (n,), whose rows have been filled in and have to be stepped.
        """
        mask = np.zeros(self.n, dtype=np.bool_)
        with self._lock:  # motions send messages of their own
            for row, motion in list(motions.items()):
                if among is not None and not among[row]:
                    continue
                command = None if self.failed[row] else next(motion, None)
                if command is None:
                    del motions[row]
                else:
                    commands[row], mask[row] = command, True
        return mask

    # servers

    def replace(self, rows: Sequence[int] | None = None) -> list[int]:
        """Start new servers for environments that have failed, in parallel.

        Args:
            rows: which; default all that have failed.

        Returns:
            The environments that have a new server; their robots stand where players enter the field.

        Raises:
            ServerLostError: more than `max_failures` were lost, a new one does not start, or there is no launcher.
        """
        with self._lock:
            lost = [int(row) for row in (np.flatnonzero(self.failed) if rows is None else rows)]
            if not lost:
                return []
            if self._launcher is None:
                raise ServerLostError(f"server {lost[0]}: {self.reason(lost[0])}; it cannot be replaced")
        # without the lock: servers that wait must be kept alive meanwhile
        for row in lost:
            self.restarts += not self._exchange.neglected(row)
            reason = self.reason(row)
            logger.debug("server %d: %s; starting a replacement", row, reason)
            if self.restarts > self._max_failures:
                raise ServerLostError(
                    f"{self.restarts} servers were lost, {self._max_failures} are allowed; last: server {row}: {reason}"
                )
        self._open(lost)
        for row in lost:
            if self.failed[row]:
                raise self._lost(row)
        return lost

    def _lost(self, row: int) -> ServerLostError:
        error = ServersUnavailableError if row in self._unavailable else ServerLostError
        return error(f"server {row}: {self.reason(row)}")

    def renew(self) -> None:
        """Read what servers have sent, and step those to which nothing has been sent for `silence_s`.

        Joints are held still in those cycles; the world's clock advances by them.
        """
        with self._lock:
            if not self._closing.is_set() and self._exchange.renew() != np.count_nonzero(self.failed):
                self._note_failures()

    def close(self) -> None:
        """Close all connections and stop the servers that were started."""
        self._closing.set()
        with self._lock:
            for row in range(self.n):
                self._exchange.detach(row)
            handles = [handle for handle in self._handles if handle is not None]
            self._handles = [None] * self.n
            if handles:
                with ThreadPoolExecutor(max_workers=min(8, len(handles))) as pool:
                    list(pool.map(lambda handle: handle.stop(), handles))

    def _able(self, mask: ArrayLike | None) -> list[int]:
        """Return the environments of a mask that have not failed."""
        rows = self._rows(mask)
        able = ~self.failed if rows is None else rows.view(np.bool_) & ~self.failed
        return [int(row) for row in np.flatnonzero(able)]

    def _rows(self, mask: ArrayLike | None) -> Rows:
        if mask is None:
            return None
        rows = np.ascontiguousarray(mask)
        if rows.dtype != np.bool_ or rows.shape != (self.n,):
            raise ValueError(f"mask: must be bool of shape ({self.n},), not {rows.dtype} of {rows.shape}")
        return rows.view(np.uint8)

    def _note_failures(self) -> None:
        for row in range(self.n):
            if not self.failed[row] and not self._entering[row] and self._exchange.failure(row):
                self.failed[row] = True
                # `reason` asks the launcher, which may take long: not with the lock held
                logger.info("server %d is lost: %s", row, self._exchange.failure(row))

    def _fail(self, row: int, reason: str) -> None:
        """Mark a server as failed, unless it has failed already."""
        with self._lock:
            self._exchange.fail(row, reason)
            self._note_failures()

    def _open(self, rows: Sequence[int]) -> None:
        self._entering[list(rows)] = True
        with ThreadPoolExecutor(max_workers=min(8, len(rows))) as pool:
            list(pool.map(self._open_one, rows))

    def _open_one(self, row: int) -> None:
        try:
            self._open_server(row)
        finally:
            self._entering[row] = False

    def _open_server(self, row: int) -> None:
        self._exchange.detach(row)
        deadline = time.monotonic() + self._start_timeout_s
        problem = ""
        self._unavailable.discard(row)
        for _ in range(3):  # another process may take a port in the meantime
            handle, self._handles[row] = self._handles[row], None
            if handle is not None:
                handle.stop()
            try:
                if self._launcher is not None:
                    self._handles[row] = handle = self._launcher.start()
                    address = handle.address
                else:
                    address = self._addresses[row]
                self._enter(row, address, deadline)
            except OSError as error:
                problem = str(error)
                if isinstance(error, LauncherUnavailableError):
                    self._unavailable.add(row)
                    break
                continue
            problem = self._exchange.failure(row)
            if not problem:
                self.failed[row] = False
                self._exchange.admit(row)
                return
        self._exchange.fail(row, problem)
        self.failed[row] = True

    def _connect_port(self, row: int, host: str, port: int, deadline: float) -> socket.socket:
        pause = threading.Event()
        while True:
            handle = self._handles[row]
            if handle is not None and not handle.alive():
                raise OSError(f"the server has ended ({handle.describe()})")
            try:
                connection = socket.create_connection((host, port), timeout=max(0.1, deadline - time.monotonic()))
            except OSError as error:
                if time.monotonic() > deadline or self._launcher is None:
                    raise OSError(f"{host}:{port}: {error}") from error
                pause.wait(0.02)  # it does not listen yet
                continue
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setblocking(False)
            if handle is not None and not handle.owns(port):
                connection.close()
                raise OSError(f"{host}:{port}: another process answers")
            return connection


def _beat(fleet: weakref.ref[Fleet], closing: threading.Event) -> None:
    """Keep a fleet's servers alive until it is closed or forgotten."""
    alive = fleet()
    interval_s = alive.silence_s / 3 if alive is not None else 0.0
    del alive
    while not closing.wait(interval_s):
        alive = fleet()
        if alive is None:
            return
        alive.renew()
        del alive
