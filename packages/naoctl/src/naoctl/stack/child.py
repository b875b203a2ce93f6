"""Processes of the stack."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from naoctl.stack.ports import Address
from naoctl.stack.postgres import Account, launch_command
from naoctl.stack.state import ProcessRecord

MAX_LOG_BYTES = 16 * 1024 * 1024
"""Size in bytes above which a log is renamed to ``NAME.log.1`` when its process starts."""
FIRST_BACKOFF_S, LAST_BACKOFF_S = 0.5, 30.0
"""Seconds before a process that died is restarted: the first delay, doubled with every death, and the longest."""
WELL_AFTER_S = 60.0
"""Uptime in seconds after which the restart delay is reset."""


@dataclass(frozen=True)
class Program:
    """Description of a process: how to run it, check it and stop it.

    Attributes:
        name: in messages, in the state file and as the log's name.
        title: for people.
        command: what to run.
        environment: variables on top of the supervisor's own.
        log: file that gets what it prints.
        is_ready: asks the running process itself; must not block longer than some seconds.
        stop_signal: asks it to end in order.
        death_signal: sent by the kernel when the supervisor dies; None: the same.
        stop_grace_s: seconds it gets for that before it is killed.
        ready_within_s: seconds it gets to become ready.
        account: run as this account instead of the supervisor's.
        listens: addresses of TCP that it listens on once it is ready, and no others.
        folder: its current folder; None: that of its log.
        stdin: file that it reads as its standard input; None: nothing.
    """

    name: str
    title: str
    command: list[str]
    environment: Mapping[str, str]
    log: Path
    is_ready: Callable[[], bool]
    stop_signal: signal.Signals = signal.SIGTERM
    death_signal: signal.Signals | None = None
    stop_grace_s: float = 10.0
    ready_within_s: float = 60.0
    account: Account | None = None
    listens: frozenset[Address] = frozenset()
    folder: Path | None = None
    stdin: Path | None = None


@dataclass
class StackProcess:
    """Running process of a program, and the delay before its next restart."""

    program: Program
    process: subprocess.Popen[bytes] | None = None
    record: ProcessRecord | None = None
    started_at: float = 0.0
    deaths: int = 0
    restart_at: float | None = None
    exit_code: int | None = field(default=None)

    def start(self) -> None:
        """Start the process in a session of its own, so that Ctrl-C in the terminal reaches the supervisor alone.

        Must be called from the supervisor's main thread: the kernel ties the signal at the parent's death to the
        thread that started the child.
        """
        program = self.program
        rotate(program.log)
        death_signal = program.death_signal or program.stop_signal
        command = launch_command(program.command, account=program.account, death_signal=death_signal)
        with program.log.open("ab") as log, (program.stdin or Path(os.devnull)).open("rb") as stdin:
            self.process = subprocess.Popen(
                command,
                stdin=stdin,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **program.environment},
                cwd=program.folder or program.log.parent,
                start_new_session=True,
            )
        self.record = ProcessRecord.of(program.name, self.process.pid)
        self.started_at = time.monotonic()
        self.restart_at = None
        self.exit_code = None

    @property
    def is_alive(self) -> bool:
        """Whether the process runs."""
        return self.process is not None and self.process.poll() is None

    def listening(self) -> frozenset[Address]:
        """Return the addresses of TCP that the process listens on."""
        with contextlib.suppress(psutil.Error):
            if self.process is not None:
                found = psutil.Process(self.process.pid).net_connections(kind="tcp")
                return frozenset((c.laddr.ip, c.laddr.port) for c in found if c.status == psutil.CONN_LISTEN)
        return frozenset()

    def note_death(self) -> float:
        """Record that the process died; return the seconds until its restart."""
        assert self.process is not None
        self.exit_code = self.process.returncode
        kill_group(self.process.pid)
        now = time.monotonic()
        self.deaths = 1 if now - self.started_at > WELL_AFTER_S else self.deaths + 1
        self.process = None
        self.record = None
        wait_s = min(FIRST_BACKOFF_S * 2.0 ** (self.deaths - 1), LAST_BACKOFF_S)
        self.restart_at = now + wait_s
        return wait_s

    def put_off(self) -> float:
        """Put off a restart that failed; return the seconds until the next."""
        self.deaths += 1
        wait_s = min(FIRST_BACKOFF_S * 2.0 ** (self.deaths - 1), LAST_BACKOFF_S)
        self.restart_at = time.monotonic() + wait_s
        return wait_s

    def ask_to_stop(self) -> None:
        """Ask the process to stop."""
        if self.process is not None and self.is_alive:
            self.process.send_signal(self.program.stop_signal)

    def stop_now(self) -> None:
        """Kill the process and its group."""
        if self.process is not None:
            kill_group(self.process.pid)
            self.process.wait()

    def last_words(self, lines: int = 8) -> str:
        """Return the end of the log."""
        return tail(self.program.log, lines)


def kill_group(pid: int) -> None:
    """Kill the remaining processes of a process group."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)


def rotate(log: Path) -> None:
    """Rename a log that is too long."""
    if log.exists() and log.stat().st_size > MAX_LOG_BYTES:
        log.replace(log.with_name(log.name + ".1"))


def tail(log: Path, lines: int) -> str:
    """Return the last lines of a log that may be long."""
    try:
        with log.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - 16384))
            text = file.read().decode("utf-8", errors="replace")
    except FileNotFoundError:
        return ""
    return "\n".join(text.splitlines()[-lines:])
