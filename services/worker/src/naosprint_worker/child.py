"""Programs in a session of their own, which can be stopped together with their descendants."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import psutil

TRACEBACK_SIGNAL = signal.SIGUSR2
"""Signal on which a child prints the stacks of all its threads."""


class TrainingProcess:
    """A supervised process and its process group.

    The child's standard input is a pipe whose other end only this process has: when this process dies in any way, the
    child reads end-of-file (see `naosprint_worker.guard`). Standard output and error go to ``log_path``. When the
    leader ends, the rest of its group is killed before the leader is reaped, while no other process can get the group's
    number.
    """

    def __init__(
        self,
        argv: Sequence[str],
        *,
        env: Mapping[str, str],
        cwd: Path,
        log_path: Path,
        on_exit: Callable[[], None] | None = None,
    ) -> None:
        """Start ``argv``; ``on_exit`` is called from another thread once the whole group is gone."""
        with log_path.open("ab") as log:
            self._process = subprocess.Popen(
                argv,
                env=dict(env),
                cwd=cwd,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self.pid = self._process.pid
        self._lock = threading.Lock()
        self._gone = False
        self._used_s = 0.0
        self._exited = threading.Event()
        self._on_exit = on_exit
        self._waiter = threading.Thread(target=self._wait, name=f"child-{self.pid}", daemon=True)
        self._waiter.start()

    @property
    def returncode(self) -> int | None:
        """The leader's exit status (negative: the signal that ended it); None while it runs."""
        return self._process.returncode if self._exited.is_set() else None

    def runs(self) -> bool:
        """Return whether the group still exists."""
        return not self._exited.is_set()

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait until the group is gone; return the leader's exit status, or None after ``timeout_s`` seconds."""
        self._exited.wait(timeout_s)
        return self.returncode

    def terminate(self) -> None:
        """Ask the leader to stop (SIGTERM). What it started keeps running, since a checkpoint may still need it."""
        with self._lock:
            if not self._gone:
                os.kill(self.pid, signal.SIGTERM)

    def print_traceback(self) -> None:
        """Make the leader print where each of its threads is, even if it is suspended (see `child_process`)."""
        with self._lock:
            if not self._gone:
                for number in (TRACEBACK_SIGNAL, signal.SIGCONT):
                    os.kill(self.pid, number)

    def kill(self) -> None:
        """End the whole group at once (SIGKILL)."""
        with self._lock:
            if not self._gone:
                self._kill_group()

    def usage(self) -> tuple[int, float]:
        """Return the resident bytes of the leader and all its descendants, and the seconds of processors they used.

        When they are gone the former is 0, and the latter that of the leader and of the processes that it waited for.
        """
        resident, cpu_s = 0, 0.0
        if not self.runs():
            return resident, self._used_s
        with contextlib.suppress(psutil.Error):
            leader = psutil.Process(self.pid)
            ended = leader.cpu_times()
            cpu_s += ended.children_user + ended.children_system
            for process in [leader, *leader.children(recursive=True)]:
                with contextlib.suppress(psutil.Error), process.oneshot():
                    resident += process.memory_info().rss
                    times = process.cpu_times()
                    cpu_s += times.user + times.system
        return resident, cpu_s

    def _kill_group(self) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)

    def _wait(self) -> None:
        # WNOWAIT leaves the leader a zombie: its pid, and so the group's number, stays taken until it is reaped below.
        with contextlib.suppress(ChildProcessError):
            os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT)
        with contextlib.suppress(psutil.Error):
            self._used_s = sum(psutil.Process(self.pid).cpu_times()[:4])  # its own, and of those that it waited for
        with self._lock:
            self._kill_group()
            self._process.wait()
            self._gone = True
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        self._exited.set()
        if self._on_exit is not None:
            self._on_exit()
