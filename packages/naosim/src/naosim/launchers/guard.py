"""A guard that runs one command and kills it when the standard input ends, that is, when its owner has died.

Run as a file, with nothing but the standard library: `python guard.py HOME SIGNAL COMMAND...`. The command inherits the
guard's process group; the guard kills that whole group at the end, once it has removed the folder HOME, and the kernel
kills the command if the guard dies. SIGTERM to the guard is SIGNAL to the command.
"""

from __future__ import annotations

import ctypes
import os
import select
import shutil
import signal
import subprocess
import sys

_PR_SET_PDEATHSIG = 1
_LOOK_MS = 5000


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _take_down(child: subprocess.Popen[bytes], home: str) -> None:
    child.kill()
    child.wait()
    shutil.rmtree(home, ignore_errors=True)
    os.killpg(os.getpgrp(), signal.SIGKILL)


def main() -> int:
    """Run the command; return its exit code."""
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake)
    for number in (signal.SIGCHLD, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    home, stop_signal, *command = sys.argv[1:]
    child = subprocess.Popen(command, stdin=subprocess.DEVNULL, preexec_fn=_die_with_parent)
    poll = select.poll()
    poll.register(0, select.POLLIN | select.POLLHUP)
    poll.register(woken, select.POLLIN)
    owner = os.getppid()
    while child.poll() is None:
        # a process forked from the owner may keep the input open, so check the owner itself, too
        if os.getppid() != owner:
            _take_down(child, home)
        for fd, _ in poll.poll(_LOOK_MS):
            if fd == 0 and not os.read(0, 4096):
                _take_down(child, home)
            if fd == woken and signal.SIGTERM in os.read(woken, 4096):
                child.send_signal(int(stop_signal))
    return child.returncode if child.returncode >= 0 else 128 - child.returncode


if __name__ == "__main__":
    sys.exit(main())
