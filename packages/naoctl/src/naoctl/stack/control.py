"""Start a stack in the background, and find and stop it from another terminal."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable

import psutil

from naoctl.errors import StackError
from naoctl.stack.child import rotate, tail
from naoctl.stack.layout import Layout
from naoctl.stack.postgres import launch_command
from naoctl.stack.state import StackState, is_locked
from naoctl.stack.supervisor import WORKER_GRACE_S, Options, RunningStack, clear_leftovers, running_already

Say = Callable[[str, str], None]

DOWN_WITHIN_S = WORKER_GRACE_S + 60.0
"""Seconds that stopping may take: the grace period of the worker and of the other processes."""


class ReadyPipe:
    """Pipe to the process that started this one in the background: progress of the start, one JSON object a line."""

    def __init__(self, descriptor: int) -> None:
        os.set_inheritable(descriptor, False)
        self._file = os.fdopen(descriptor, "w", encoding="utf-8")

    def send(self, **message: object) -> None:
        """Send one message. Does nothing after ``close`` or if the reader is gone."""
        if self._file.closed:
            return
        with contextlib.suppress(BrokenPipeError):
            self._file.write(json.dumps(message) + "\n")
            self._file.flush()

    def close(self) -> None:
        """Close the pipe."""
        with contextlib.suppress(BrokenPipeError):
            self._file.close()


def start_detached(layout: Layout, options: Options, say: Say, *, tied: bool = False) -> RunningStack:
    """Start a stack in a session of its own and return once it is ready.

    Args:
        layout: the data folder.
        options: what the user chose.
        say: called with what happens during the start.
        tied: stop the stack when this very process ends, however it ends.

    Raises:
        StackError: when the start fails; nothing is left running then.
    """
    layout.make()
    log_path = layout.log("supervisor")
    rotate(log_path)
    read_end, write_end = os.pipe()
    command = [
        sys.executable,
        "-P",
        "-m",
        "naoctl",
        "up",
        "--data-dir",
        str(layout.root),
        "--ready-fd",
        str(write_end),
        "--workers",
        str(options.worker_concurrency),
        "--queues",
        options.worker_queues,
    ]
    if options.api_port is not None:
        command += ["--port", str(options.api_port)]
    if tied:
        command = launch_command(command, death_signal=signal.SIGTERM)
    with log_path.open("ab") as log:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            pass_fds=(write_end,),
            start_new_session=True,
            cwd=layout.root,
        )
    os.close(write_end)
    refusal: StackError | None = None
    try:
        with os.fdopen(read_end, encoding="utf-8") as pipe:
            for line in pipe:
                message = json.loads(line)
                if "say" in message:
                    say(*message["say"])
                elif "error" in message:
                    refusal = StackError(message["error"], fix=message["fix"])
                elif message.get("ready"):
                    return find_running(layout)
    except BaseException:
        # Interrupted while waiting: what was started must not stay.
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(DOWN_WITHIN_S)
        raise
    process.wait()
    if refusal:
        raise refusal
    raise StackError(f"The stack ended while starting\n{tail(log_path, 8)}", fix=f"The log is {log_path}.")


def find_running(layout: Layout) -> RunningStack:
    """Return the stack that is up on a folder.

    Raises:
        StackError: when there is none, or it is still starting.
    """
    state = StackState.load(layout) if layout.root.exists() else None
    if state is None or not is_locked(layout):
        raise StackError(f"No stack is running on {layout.root}", fix="Start one with `naoctl up`.")
    if not state.ready or state.supervisor is None or state.url is None:
        raise running_already(layout)
    return RunningStack(state.url, layout.admin_token.read_text(encoding="utf-8").strip(), state.supervisor.pid)


def stop(layout: Layout, say: Say, *, now: bool = False, within_s: float = DOWN_WITHIN_S) -> bool:
    """Stop the stack of a folder, or what a killed one left; return whether anything was running.

    Args:
        layout: the data folder.
        say: called with what happens.
        now: kill instead of asking; running jobs resume from their last checkpoint next time.
        within_s: seconds to wait for an orderly end.

    Raises:
        StackError: when the stack is still there after that.
    """
    state = StackState.load(layout) if layout.root.exists() else None
    if state is None:
        return False
    if not is_locked(layout):
        cleared = clear_leftovers(state, grace_s=0.0 if now else 15.0)
        if cleared:
            say("Cleared", f"{cleared} process{'es' if cleared > 1 else ''} of a killed stack stopped")
        return cleared > 0
    process = state.supervisor.process() if state.supervisor else None
    if process is None:
        raise StackError(f"{layout.root} is used by a process that is starting or stopping", fix="Try again.")
    say("Stopping", f"{layout.root}; a running job keeps its progress")
    process.send_signal(signal.SIGTERM)
    deadline = time.monotonic() + within_s
    if now:
        # Asked twice means without grace. A pause between, or the two signals may arrive as one.
        with contextlib.suppress(psutil.TimeoutExpired, psutil.NoSuchProcess):
            process.wait(0.5)
            return True
        with contextlib.suppress(psutil.NoSuchProcess):
            process.send_signal(signal.SIGTERM)
    try:
        process.wait(max(0.0, deadline - time.monotonic()))
    except psutil.TimeoutExpired:
        raise StackError(
            f"The stack (process {process.pid}) is still stopping after {within_s:g} s",
            fix="Wait, or use `naoctl down --now`.",
        ) from None
    except psutil.NoSuchProcess:
        pass
    return True
