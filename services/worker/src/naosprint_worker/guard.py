"""The child's side of supervision: end after the worker's death, and first when memory runs out."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path

_BEFORE_KILL_S = 3.0
"""Seconds after the grace period for which an orphan that still runs may settle its work."""


def watch_parent(on_lost: Callable[[], None], before_kill: Callable[[], None], *, grace_s: float) -> threading.Thread:
    """End this process's whole group ``grace_s`` seconds after the worker that started it has died.

    Standard input must be the pipe that the worker keeps open. It is moved to another descriptor first, so that nothing
    this process starts inherits it. On end-of-file ``on_lost`` is called, which should request a checkpoint; all
    processes of the group that still run after the grace period are killed, this one included, after ``before_kill``
    was called, which has a few seconds.
    """
    pipe = os.dup(0)  # close-on-exec, unlike descriptor 0
    with open(os.devnull, "rb") as null:
        os.dup2(null.fileno(), 0)

    def watch() -> None:
        while os.read(pipe, 4096):
            pass
        on_lost()
        threading.Event().wait(grace_s)
        last = threading.Thread(target=before_kill, name="before-kill", daemon=True)
        last.start()
        last.join(_BEFORE_KILL_S)
        os.killpg(os.getpgid(0), signal.SIGKILL)

    thread = threading.Thread(target=watch, name="parent-watch", daemon=True)
    thread.start()
    return thread


def prefer_as_oom_victim(score: int) -> None:
    """Make the kernel end this process before others when memory runs out (Linux; no effect elsewhere)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(score), encoding="ascii")
