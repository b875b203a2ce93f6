"""Processor time and memory of a training."""

from __future__ import annotations

import contextlib
import math
import time

import psutil

_SEARCH_S = 5.0
"""Seconds between two searches for new descendants: a search reads the whole table of processes."""


class Usage:
    """Processor time and memory of this process and its descendants, such as servers."""

    def __init__(self) -> None:
        """Start to measure."""
        self._processes = [psutil.Process()]
        self._searched_at = -math.inf
        self._cpu_s: dict[int, float] = {}
        """Processor time in seconds by process id."""
        self._read_at = time.monotonic()
        self.read()

    def read(self) -> dict[str, float]:
        """Return the processors in use since the last call, on average, and the present memory in MiB."""
        now = time.monotonic()
        if now - self._searched_at >= _SEARCH_S:
            self._searched_at = now
            self._processes[1:] = self._processes[0].children(recursive=True)
        before, self._cpu_s = self._cpu_s, {}
        cpu_s = resident = 0.0
        for process in self._processes:
            with contextlib.suppress(psutil.Error):
                times = process.cpu_times()
                self._cpu_s[process.pid] = times.user + times.system
                cpu_s += max(self._cpu_s[process.pid] - before.get(process.pid, 0.0), 0.0)
                resident += process.memory_info().rss
        elapsed_s, self._read_at = now - self._read_at, now
        return {"cpus": cpu_s / max(elapsed_s, 1e-3), "memory_mb": resident / 2**20}
