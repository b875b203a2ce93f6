"""Processes under a guard that ends them, and all that they have started, with the process that started them."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

_GUARD = Path(__file__).with_name("guard.py")
_LOG = "output.log"
_LOG_BYTES, _LOG_CHARACTERS = 2000, 400
_ENDING_S = 0.5


class GuardedProcess:
    """Process with a session and a temporary folder of its own, under a guard.

    If this process ends in any way, the guard kills the process group and removes the folder. The folder has a log of
    what is printed.

    Args:
        prefix: first characters of the folder's name.
    """

    def __init__(self, prefix: str) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix=prefix))
        self._process: subprocess.Popen[bytes] | None = None
        self._log, self._log_start = self.folder / _LOG, 0

    def start(
        self,
        command: Sequence[str],
        environment: Mapping[str, str] | None = None,
        cwd: Path | None = None,
        stop_signal: signal.Signals = signal.SIGTERM,
        *,
        piped: bool = False,
    ) -> None:
        """Start it; `stop` removes what is left if that fails.

        Args:
            command: the program and its arguments.
            environment: all its variables. Default: those of this process.
            cwd: its working directory. Default: its folder.
            stop_signal: signal to the program when the guard gets SIGTERM.
            piped: whether its standard output is a pipe to this process, not the log.

        Raises:
            OSError: if it cannot be started.
        """
        guard = (sys.executable, "-I", "-S", str(_GUARD), str(self.folder), str(int(stop_signal)))
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [*guard, *command],
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE if piped else log,
                stderr=log,
                cwd=cwd or self.folder,
                env=environment,
                start_new_session=True,
            )

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The guard, once it has been started."""
        assert self._process is not None
        return self._process

    @property
    def pid(self) -> int:
        """Process id of the guard, which leads the session."""
        return self.process.pid

    def alive(self) -> bool:
        """Return whether it runs."""
        return self.process.poll() is None

    def describe(self) -> str:
        """Return how it ended and the end of its log."""
        # callers ask when its connections break, a moment before the process is gone
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(_ENDING_S)
        code, words = self.process.returncode, ""
        with contextlib.suppress(OSError), self._log.open("rb") as log:
            log.seek(max(self._log_start, log.seek(0, os.SEEK_END) - _LOG_BYTES))
            words = " ".join(log.read().decode(errors="replace").split())[-_LOG_CHARACTERS:]
        return ("runs" if code is None else f"exit code {code}") + (f", log: ...{words}" if words else "")

    def stop(self) -> None:
        """Kill its process group, if it was started, and remove its folder."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    pipe.close()
        shutil.rmtree(self.folder, ignore_errors=True)
