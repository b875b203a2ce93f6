"""A process is known by its number, its start and the boot, none of which the clock changes."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from naospec.processes import ProcessIdentity, start_ticks

SETTING = ["unshare", "--mount", "--map-root-user"]
"""Command that gives a process its own view of the files of the kernel, without rights on the machine."""

SCRIPT = """
import subprocess, sys
from pathlib import Path
from naospec.processes import ProcessIdentity

own, child = ProcessIdentity.current(), ProcessIdentity.of(int(sys.argv[1]))
text = Path("/proc/stat").read_text()
(line,) = (line for line in text.splitlines() if line.startswith("btime"))
fake = Path(sys.argv[2])
for step in (-86400, -2, 1, 3600):
    fake.write_text(text.replace(line, f"btime {int(line.split()[1]) + step}"))
    subprocess.run(["mount", "--bind", str(fake), "/proc/stat"], check=True)
    assert f"btime {int(line.split()[1]) + step}" in Path("/proc/stat").read_text()
    assert ProcessIdentity.current() == own and own.runs() and not own.is_gone()
    assert ProcessIdentity.of(child.pid) == child and child.runs() and not child.is_gone()
    subprocess.run(["umount", "/proc/stat"], check=True)
print("same")
"""


@pytest.fixture
def other() -> ProcessIdentity:
    """The identity of another process, which has ended."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        identity = ProcessIdentity.of(process.pid)
        assert identity is not None
        assert identity.runs()
        assert not identity.is_gone()
        process.send_signal(signal.SIGKILL)
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert not identity.runs(), "a zombie has ended"
        assert identity.is_gone()
    return identity


def test_identity_survives_its_text() -> None:
    own = ProcessIdentity.current()
    assert ProcessIdentity.parse(str(own)) == own == ProcessIdentity.of(os.getpid())
    for text in ("", "1", "1 2 boot", "a 2 boot place", "host 12@1.5"):
        assert ProcessIdentity.parse(text) is None


def test_a_process_that_ended_is_gone(other: ProcessIdentity) -> None:
    assert other.is_gone()
    assert not other.runs()
    assert ProcessIdentity.of(other.pid) is None


def test_a_number_that_is_used_again_is_another_process(other: ProcessIdentity) -> None:
    parent = ProcessIdentity.of(os.getppid())
    assert parent is not None
    for former in (replace(parent, ticks=parent.ticks - 1), replace(parent, boot="the boot before")):
        assert former.is_gone()
        assert not former.runs()


def test_nothing_is_said_of_processes_elsewhere(other: ProcessIdentity) -> None:
    away = replace(other, place="another host")
    assert not away.runs()
    assert not away.is_gone()


def test_own_number_is_never_gone() -> None:
    assert not replace(ProcessIdentity.current(), ticks=1).is_gone()


def test_a_name_may_hold_anything(tmp_path: Path) -> None:
    program = tmp_path / "a) Z 1"
    shutil.copy("/bin/sleep", program)
    with subprocess.Popen([program, "600"]) as process:
        assert (start_ticks(process.pid) or 0) > 1
        process.kill()


@pytest.mark.skipif(
    subprocess.run([*SETTING, "true"], check=False, capture_output=True).returncode != 0,
    reason="the system clock can be set for one process only where it may have namespaces",
)
def test_a_step_of_the_clock_changes_no_identity(tmp_path: Path) -> None:
    """The boot time of /proc/stat is what a step of the clock moves; every other start of a process stays."""
    command = [*SETTING, sys.executable, "-c", SCRIPT, str(os.getpid()), str(tmp_path / "stat")]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.stdout == "same\n", done.stderr
