"""Servers as local processes.

Ports are reserved by locks that other launchers on this machine respect, and a server counts as started only once this
very process answers on them. A server's home directory is the folder of its :class:`GuardedProcess`.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

from naospec.files import user_folder
from naospec.ports import free_ports

from naosim.launchers.guarded import GuardedProcess
from naosim.launchers.server import Address, ServerHandle, ServerProgram

_GRACE_S = 2.0
_PASSED_VARIABLES = (
    *("PATH", "LD_LIBRARY_PATH", "LANG", "LC_ALL", "PYTHONPATH"),
    *("RCSS_BUNDLE_PATH", "RCSS_FIND_SCRIPT_PATH"),
)


class PortLease:
    """Free TCP ports of this machine, reserved among all launchers while the lease lives."""

    def __init__(self, count: int, host: str = "127.0.0.1") -> None:
        self.ports: list[int] = []
        self._locks: list[IO[str]] = []
        folder = user_folder("naosim-ports")
        for left in folder.iterdir():  # by owners that were killed
            if (lock := _lock(left)) is not None:
                left.unlink(missing_ok=True)
                lock.close()
        try:
            for port in free_ports(host):
                if (lock := _lock(folder / str(port))) is not None:
                    self._locks.append(lock)
                    self.ports.append(port)
                if len(self.ports) == count:
                    return
            raise OSError(f"this machine has no {count} free ports")
        except OSError:
            self.release()
            raise

    def release(self) -> None:
        """Release the ports."""
        for lock in self._locks:
            with contextlib.suppress(OSError):
                os.unlink(lock.name)
            lock.close()
        self._locks = []


def _lock(path: Path) -> IO[str] | None:
    """Return the locked file at `path`, made if need be; none if another process has it locked, or deletes it."""
    try:
        # without O_TRUNC and links: nothing that lies here by accident or malice is changed
        file = open(path, "a", opener=_open_no_link, encoding="utf-8")  # noqa: SIM115 - the caller closes it
    except OSError:
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(file.fileno()), path.stat()):
            return file
    except OSError:
        pass
    file.close()
    return None


def _open_no_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW, 0o600)


class ProcessLauncher:
    """Launcher of servers that are processes of this machine.

    Args:
        program: the kind of server.
        command: the program and its first arguments. Default: the program's name.
        environment: variables to set besides a few that are passed on.

    Raises:
        FileNotFoundError: if there is no such program.
    """

    def __init__(
        self,
        program: ServerProgram,
        command: Sequence[str] | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        first, *others = command or (program.name,)
        path = shutil.which(first)
        if path is None:
            raise FileNotFoundError(f"{first}: no such program; install {program.name} or give its path")
        self.program = program
        self.command = (path, *others)
        self._environment = dict(environment or {})

    def start(self) -> ServerHandle:
        """Start a server; it may not listen yet.

        Raises:
            OSError: if it cannot be started.
        """
        server = _ServerProcess()
        try:
            server.launch(self.program, self.command, self._environment)
        except BaseException:
            server.stop()
            raise
        return server


class _ServerProcess(GuardedProcess):
    """One local server."""

    def __init__(self) -> None:
        self._lease = PortLease(2)
        self.address = Address("127.0.0.1", *self._lease.ports)
        super().__init__("naosim-server-")

    def launch(self, program: ServerProgram, command: Sequence[str], more: Mapping[str, str]) -> None:
        """Write the files of its home directory and start it, with more variables than those that are passed on."""
        for name, content in program.files.items():
            (self.folder / name).write_text(content, encoding="utf-8")
        arguments = program.process_command(self.address.agent_port, self.address.monitor_port, str(self.folder))
        environment = {key: os.environ[key] for key in _PASSED_VARIABLES if key in os.environ}
        environment |= {"HOME": str(self.folder), "SDL_VIDEODRIVER": "dummy", "OMP_NUM_THREADS": "1", **more}
        self.start([*command, *arguments], environment, stop_signal=program.stop_signal)

    def owns(self, port: int) -> bool:
        inodes = _listeners(port)
        for pid in _session(self.pid):
            with contextlib.suppress(OSError):
                for fd in os.listdir(f"/proc/{pid}/fd"):
                    with contextlib.suppress(OSError):
                        if os.readlink(f"/proc/{pid}/fd/{fd}") in inodes:
                            # before it listened it has printed which plug-ins it looked for, mostly
                            self._log_start = self._log_start or self._log.stat().st_size
                            return True
        return False

    def describe(self) -> str:
        return f"process {self.pid}, {super().describe()}"

    def stop(self) -> None:
        if self._process is not None and self.alive():
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_GRACE_S)
        # the real server may ignore SIGTERM while no agent is connected
        super().stop()
        self._lease.release()


def _session(leader: int) -> list[int]:
    found = []
    for entry in os.listdir("/proc"):
        if entry.isdecimal():
            with contextlib.suppress(OSError):
                if os.getsid(int(entry)) == leader:
                    found.append(int(entry))
    return found


def _listeners(port: int) -> set[str]:
    """Return the sockets that listen on a port, as /proc/<pid>/fd names them."""
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        with contextlib.suppress(OSError), open(table, encoding="utf-8") as lines:
            for line in list(lines)[1:]:
                fields = line.split()
                if fields[3] == "0A" and int(fields[1].rsplit(":", 1)[1], 16) == port:
                    found.add(f"socket:[{fields[9]}]")
    return found
