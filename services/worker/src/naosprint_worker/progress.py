"""Sign of life of a child process: a file that it touches with each step."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path

PROGRESS_FILE = "progress"

_PERIOD_S, _LONGEST_LOOK_S = 1.0, 5.0
"""Seconds between two touches, and the longest time that one check of the file counts for."""


class Progress:
    """The child's side."""

    def __init__(self, workdir: Path) -> None:
        """Nothing has been done yet."""
        self._path = workdir / PROGRESS_FILE
        self._marked_at = -math.inf

    def mark(self) -> None:
        """Record that something was done, or that there is a reason to wait; cheap enough for every step."""
        now = time.monotonic()
        if now - self._marked_at >= _PERIOD_S:
            self._marked_at = now
            with contextlib.suppress(OSError):  # a full disk is noticed elsewhere
                self._path.touch()

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Mark progress as long as the block runs, which waits for a service and has its own limits of time."""
        over = threading.Event()

        def mark() -> None:
            self.mark()
            while not over.wait(_PERIOD_S):
                self.mark()

        thread = threading.Thread(target=mark, name="waiting", daemon=True)
        try:
            thread.start()
            yield
        finally:
            over.set()


class ProgressWatch:
    """The worker's side: seconds without a sign of life.

    Only time in which the worker itself ran counts, so a child does not count as stalled after its machine was
    suspended.
    """

    def __init__(self, workdir: Path) -> None:
        """Start to count."""
        self._path = workdir / PROGRESS_FILE
        self._touched: int | None = None
        self._looked_at = time.monotonic()
        self.idle_s = 0.0

    def look(self) -> float:
        """Return the seconds since the last sign of life."""
        now = time.monotonic()
        self.idle_s += min(now - self._looked_at, _LONGEST_LOOK_S)
        self._looked_at = now
        touched = None
        with contextlib.suppress(OSError):
            touched = self._path.stat().st_mtime_ns
        if touched != self._touched:
            self._touched = touched
            self.idle_s = 0.0
        return self.idle_s
