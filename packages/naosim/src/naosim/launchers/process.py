"""Servers as local processes.

Ports are reserved by locks that other launchers on this machine respect, and a server counts as started only once this
very process answers on them. A server runs in a session and a home directory of its own, under a guard that kills it
when the process that started it ends in any way.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

from naospec.files import user_folder
from naospec.ports import free_ports

from naosim.launchers.server import Address, ServerHandle, ServerProgram

_GUARD = Path(__file__).with_name("guard.py")
_GRACE_S = 2.0
_ENDING_S = 0.5
_LOG, _LOG_TAIL = "server.log", 400
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
        lease = PortLease(2)
        home = Path(tempfile.mkdtemp(prefix="naosim-server-"))
        try:
            for name, content in self.program.files.items():
                (home / name).write_text(content, encoding="utf-8")
            address = Address("127.0.0.1", *lease.ports)
            arguments = self.program.process_command(address.agent_port, address.monitor_port, str(home))
            environment = {key: os.environ[key] for key in _PASSED_VARIABLES if key in os.environ}
            environment |= {"HOME": str(home), "SDL_VIDEODRIVER": "dummy", "OMP_NUM_THREADS": "1"} | self._environment
            guard = (sys.executable, "-I", "-S", str(_GUARD), str(home), str(int(self.program.stop_signal)))
            with (home / _LOG).open("wb") as log:
                process = subprocess.Popen(
                    [*guard, *self.command, *arguments],
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    cwd=home,
                    env=environment,
                    start_new_session=True,
                )
        except BaseException:
            lease.release()
            shutil.rmtree(home, ignore_errors=True)
            raise
        return _ServerProcess(process, home, lease, address)


class _ServerProcess:
    """One local server and its guard."""

    def __init__(self, process: subprocess.Popen[bytes], home: Path, lease: PortLease, address: Address) -> None:
        self.address = address
        self._process = process
        self._home = home
        self._lease = lease
        self._starting_bytes = 0
        """Bytes of its log from the time before it listened: plug-ins that it looked for, mostly."""

    @property
    def pid(self) -> int:
        """Return the process id of the guard, which leads the session."""
        return self._process.pid

    def alive(self) -> bool:
        return self._process.poll() is None

    def owns(self, port: int) -> bool:
        inodes = _listeners(port)
        for pid in _session(self._process.pid):
            with contextlib.suppress(OSError):
                for fd in os.listdir(f"/proc/{pid}/fd"):
                    with contextlib.suppress(OSError):
                        if os.readlink(f"/proc/{pid}/fd/{fd}") in inodes:
                            self._starting_bytes = self._starting_bytes or (self._home / _LOG).stat().st_size
                            return True
        return False

    def describe(self) -> str:
        # callers ask when its connections break, a moment before the process is gone
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_ENDING_S)
        code = self._process.returncode
        state = "runs" if code is None else f"exit code {code}"
        try:
            with (self._home / _LOG).open("rb") as log:
                log.seek(0, os.SEEK_END)
                log.seek(max(self._starting_bytes, log.tell() - _LOG_TAIL))
                words = " ".join(log.read().decode(errors="replace").split())
        except OSError:
            words = ""
        return f"process {self._process.pid}, {state}" + (f", log: ...{words}" if words else "")

    def stop(self) -> None:
        if self.alive():
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_GRACE_S)
        # the real server may ignore SIGTERM while no agent is connected
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._lease.release()
        shutil.rmtree(self._home, ignore_errors=True)


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
