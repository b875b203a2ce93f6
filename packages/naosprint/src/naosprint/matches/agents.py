"""Agents as processes with limits."""

from __future__ import annotations

import contextlib
import glob
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import naosim.launchers

from naosprint.matches import confine

if TYPE_CHECKING:
    from collections.abc import Mapping

    from naosim.launchers import Address

    from naosprint.matches.teams import Team

_GUARD = Path(naosim.launchers.__file__).with_name("guard.py")
_SETTINGS = (
    *("ld.so.*", "localtime", "timezone", "locale*", "os-release", "mime.types", "fonts", "java*", "python*"),
    *("nsswitch.conf", "passwd", "group", "host.conf", "hosts", "resolv.conf", "gai.conf", "protocols", "services"),
    *("ssl/certs", "ssl/openssl.cnf", "ca-certificates", "crypto-policies"),
    *("pki/ca-trust", "pki/tls/certs", "pki/tls/openssl.cnf"),
)
"""Files and folders of /etc that programs need; the others may have secrets."""
_SYSTEM = (
    *("/usr", "/lib", "/lib64", "/bin", "/sbin", "/sys/devices/system/cpu", "/proc/self"),
    *(f"/dev/{name}" for name in ("null", "zero", "full", "random", "urandom")),
    *(f"/etc/{name}" for pattern in _SETTINGS for name in glob.glob(pattern, root_dir="/etc")),
)
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_LOG_TAIL, _GRACE_S = 2000, 1.0


@dataclass(frozen=True)
class Limits:
    """Limits of one agent.

    Attributes:
        cpu_s: processor time, seconds.
        memory_mb: address space, MiB.
    """

    cpu_s: int = 3600
    memory_mb: int = 4096

    def __post_init__(self) -> None:
        """Check.

        Raises:
            ValueError: naming the limit.
        """
        for name, value in (("cpu_seconds", self.cpu_s), ("memory_mb", self.memory_mb)):
            if value < 1:
                raise ValueError(f"{name}: must be at least 1, not {value}")


class AgentProcess:
    """One agent of a team, in a process group of its own under a guard that ends it with this process.

    Args:
        team: the team.
        name: name with which it enters the game.
        number: its uniform number.
        players: number of players of its team.
        server: address of its endpoint to the server.
        limits: what it may use.

    Raises:
        OSError: if it cannot be started.
    """

    def __init__(self, team: Team, name: str, number: int, players: int, server: Address, limits: Limits) -> None:
        self.number = number
        self.cpu_s = 0.0
        self._home = Path(tempfile.mkdtemp(prefix="naosprint-agent-"))
        self._folder = Path(tempfile.mkdtemp(prefix="naosprint-agent-log-"))
        self._log, self._report = self._folder / "output", self._folder / "enforced.json"
        command = team.agent(host=server.host, port=server.agent_port, team=name, number=number, players=players)
        reads = [*_SYSTEM, sys.prefix, sys.base_prefix, str(team.folder), *team.reads]
        options = json.dumps(
            {
                "cpu_s": limits.cpu_s,
                "memory_mb": limits.memory_mb,
                "reads": reads,
                "writes": [str(self._home), "/dev/null"],
                "port": server.agent_port,
                "report": str(self._report),
            }
        )
        isolated = (sys.executable, "-I", "-S")
        guard = (*isolated, str(_GUARD), str(self._home), str(int(signal.SIGTERM)))
        confined = (*isolated, confine.__file__, options)
        environment = {key: os.environ[key] for key in ("PATH", "LANG", "LC_ALL") if key in os.environ}
        environment |= dict.fromkeys(_ONE_THREAD, "1") | {"HOME": str(self._home), "TMPDIR": str(self._home)}
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [*guard, *confined, *command],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=team.folder,
                env=environment,
                start_new_session=True,
            )

    @property
    def enforced(self) -> list[str]:
        """Limits that the kernel enforces, once the agent has started."""
        try:
            found: list[str] = json.loads(self._report.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return []
        return found

    def alive(self) -> bool:
        """Return whether it runs."""
        return self._process.poll() is None

    def describe(self) -> str:
        """Return how it ended and the end of what it printed."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_GRACE_S)
        code = self._process.returncode
        with contextlib.suppress(OSError), self._log.open("rb") as log:
            log.seek(max(0, self._log.stat().st_size - _LOG_TAIL))
            words = " ".join(log.read().decode(errors="replace").split())
            return f"{'runs' if code is None else f'exit code {code}'}" + (
                f", output: ...{words[-400:]}" if words else ""
            )
        return "no output"

    def stop(self) -> None:
        """End it and everything that it started."""
        self.note_cpu(cpu_by_session())
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()
        for folder in (self._home, self._folder):
            shutil.rmtree(folder, ignore_errors=True)

    def note_cpu(self, used_s: Mapping[int, float]) -> None:
        """Note the processor time that it has used so far, from that of all sessions."""
        self.cpu_s = max(self.cpu_s, used_s.get(self._process.pid, 0.0))


def cpu_by_session() -> dict[int, float]:
    """Return the processor time of the processes of each session, seconds; this reads the state of all processes."""
    ticks: dict[int, int] = {}
    for entry in os.listdir("/proc"):
        if entry.isdecimal():
            with contextlib.suppress(OSError, ValueError, IndexError):
                fields = Path(f"/proc/{entry}/stat").read_text(encoding="ascii", errors="replace").rsplit(")", 1)[1]
                state, _, _, session, *rest = fields.split()
                if state != "Z":
                    ticks[int(session)] = ticks.get(int(session), 0) + int(rest[7]) + int(rest[8])
    return {session: used / os.sysconf("SC_CLK_TCK") for session, used in ticks.items()}
