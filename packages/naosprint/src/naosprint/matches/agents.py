"""Agents as processes with limits."""

from __future__ import annotations

import contextlib
import glob
import json
import os
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from naosim.launchers import GuardedProcess
from naospec.processes import ProcessStat

from naosprint.matches import confine

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from naosim.launchers import Address

    from naosprint.matches.teams import Team

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
MOST_DISK_BYTES = 256 << 20
"""Most bytes of what an agent writes in all, its output included."""
_BLOCK_BYTES, _LOOK_S = 4096, 1.0
"""Least bytes that a file or folder counts, and seconds between two looks at them."""
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


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


class AgentProcess(GuardedProcess):
    """One agent of a team, in a process.

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
        super().__init__("naosprint-agent-")
        self.number = number
        self.cpu_s = 0.0
        self._looked_at, self._too_much = 0.0, ""
        self._enforced: list[str] = []
        # the agent may use no other part of its folder
        home, self._report = self.folder / "home", self.folder / "enforced.json"
        command = team.agent(host=server.host, port=server.agent_port, team=name, number=number, players=players)
        options = json.dumps(
            {
                "cpu_s": limits.cpu_s,
                "memory_mb": limits.memory_mb,
                "reads": [*_SYSTEM, sys.prefix, sys.base_prefix, str(team.folder), *team.reads],
                "writes": [str(home), "/dev/null"],
                "port": server.agent_port,
                "report": str(self._report),
            }
        )
        environment = {key: os.environ[key] for key in ("PATH", "LANG", "LC_ALL") if key in os.environ}
        environment |= dict.fromkeys(_ONE_THREAD, "1") | {"HOME": str(home), "TMPDIR": str(home)}
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        try:
            home.mkdir()
            self.start([sys.executable, "-I", "-S", confine.__file__, options, *command], environment, team.folder)
        except BaseException:
            super().stop()
            raise

    @property
    def enforced(self) -> list[str]:
        """Limits that the kernel enforces, once the agent has started."""
        self._note_enforced()
        return self._enforced

    def _note_enforced(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            self._enforced = json.loads(self._report.read_text(encoding="utf-8"))

    def alive(self) -> bool:
        """Return whether it runs; one that has written too much is stopped."""
        if super().alive() and time.monotonic() - self._looked_at > _LOOK_S:
            self._looked_at = time.monotonic()
            if _disk_bytes(self.folder) > MOST_DISK_BYTES:
                self._too_much = f"stopped: its files and its output have more than {MOST_DISK_BYTES >> 20} MiB"
                self.stop()
        return super().alive()

    def describe(self) -> str:
        """Return how it ended and the end of its log."""
        return self._too_much or super().describe()

    def stop(self) -> None:
        """Kill it and everything that it started; its processor time and what was enforced stay known."""
        self.note_cpu(cpu_by_session())
        self._note_enforced()
        super().stop()

    def note_cpu(self, used_s: Mapping[int, float]) -> None:
        """Note the processor time that it has used so far, from that of all sessions."""
        self.cpu_s = max(self.cpu_s, used_s.get(self.pid, 0.0))


def _disk_bytes(folder: Path) -> int:
    """Return the bytes on the disk of what is in a folder, counted no further than beyond MOST_DISK_BYTES."""
    used = 0
    for path, folders, files in os.walk(folder):
        for name in (*folders, *files):
            with contextlib.suppress(OSError):  # removed meanwhile
                used += max(_BLOCK_BYTES, 512 * os.lstat(os.path.join(path, name)).st_blocks)
        if used > MOST_DISK_BYTES:
            break
    return used


def cpu_by_session() -> dict[int, float]:
    """Return the processor time of the processes of each session, seconds; this reads the state of all processes."""
    ticks: dict[int, int] = {}
    for entry in os.listdir("/proc"):
        if entry.isdecimal():
            with contextlib.suppress(OSError):
                stat = ProcessStat.of(int(entry))
                if not stat.has_ended:
                    ticks[stat.session] = ticks.get(stat.session, 0) + stat.cpu_ticks
    return {session: used / os.sysconf("SC_CLK_TCK") for session, used in ticks.items()}
