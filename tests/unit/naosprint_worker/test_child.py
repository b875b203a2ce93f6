"""A child runs in a session of its own and is stopped as a group."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import psutil
import pytest
from naosprint_worker.child import TrainingProcess


def start(tmp_path: Path, program: str, *, on_exit: threading.Event | None = None) -> TrainingProcess:
    """Start a Python program that writes a file named ``ready`` when it is ready."""
    return TrainingProcess(
        [sys.executable, "-c", textwrap.dedent(program)],
        env=dict(os.environ),
        cwd=tmp_path,
        log_path=tmp_path / "child.log",
        on_exit=on_exit.set if on_exit else None,
    )


def announced_pid(tmp_path: Path) -> int:
    """Wait for the file ``ready`` (a named pipe the child opens) and return the number in it."""
    return int((tmp_path / "ready").read_text())


@pytest.fixture
def ready(tmp_path: Path) -> Path:
    """A named pipe: reading blocks until the child has written."""
    path = tmp_path / "ready"
    os.mkfifo(path)
    return path


GRANDPARENT = """
    import pathlib, subprocess, sys, time
    grandchild = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    pathlib.Path("ready").write_text(str(grandchild.pid))
    {then}
"""


def wait_gone(pid: int) -> bool:
    """Wait until a process that is not ours has ended (or is a zombie that only its reaper must collect)."""
    try:
        process = psutil.Process(pid)
        if process.status() == psutil.STATUS_ZOMBIE:
            return True
        process.wait(timeout=10)
    except psutil.NoSuchProcess:
        return True
    except psutil.TimeoutExpired:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    return True


def test_exit_status_and_output_are_kept(tmp_path: Path) -> None:
    child = start(tmp_path, "import sys; print('hello'); print('oh', file=sys.stderr); sys.exit(7)")
    assert child.wait(20) == 7
    assert (tmp_path / "child.log").read_text().split() == ["hello", "oh"]


def test_child_leads_its_own_session(tmp_path: Path, ready: Path) -> None:
    child = start(tmp_path, GRANDPARENT.format(then="time.sleep(600)"))
    grandchild = announced_pid(tmp_path)
    assert os.getsid(child.pid) == child.pid == os.getsid(grandchild)
    assert os.getsid(0) != child.pid
    assert child.usage()[0] > psutil.Process(child.pid).memory_info().rss // 2
    child.kill()
    assert child.wait(20) == -signal.SIGKILL
    assert wait_gone(grandchild)


def test_group_does_not_outlive_a_leader_that_exits(tmp_path: Path, ready: Path) -> None:
    gone = threading.Event()
    child = start(tmp_path, GRANDPARENT.format(then="sys.exit(3)"), on_exit=gone)
    grandchild = announced_pid(tmp_path)
    assert gone.wait(20)
    assert child.returncode == 3
    assert wait_gone(grandchild)


def test_terminate_spares_what_the_leader_started(tmp_path: Path, ready: Path) -> None:
    child = start(
        tmp_path,
        """
        import pathlib, signal, subprocess, sys
        grandchild = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(11 if grandchild.poll() is None else 12))
        pathlib.Path("ready").write_text(str(grandchild.pid))
        signal.pause()
        """,
    )
    grandchild = announced_pid(tmp_path)
    child.terminate()
    assert child.wait(20) == 11
    assert wait_gone(grandchild)


def test_stopping_a_child_that_is_gone_is_harmless(tmp_path: Path) -> None:
    child = start(tmp_path, "pass")
    assert child.wait(20) == 0
    child.terminate()
    child.kill()
    assert child.usage()[0] == 0


def test_what_a_child_used_is_known_after_its_end(tmp_path: Path) -> None:
    """With what the processes used that it waited for."""
    burn = "import time\nwhile time.process_time() < 0.4: pass"
    child = start(tmp_path, f"import subprocess, sys\nsubprocess.run([sys.executable, '-c', {burn!r}])\n{burn}")
    assert child.wait(60) == 0
    held, used_s = child.usage()
    assert held == 0
    assert 0.75 < used_s < 20.0


PARENT = """
    import os, pathlib, sys
    from naosprint_worker.child import TrainingProcess
    here = pathlib.Path(sys.argv[1])
    child = TrainingProcess([sys.executable, "-c", (here / "child.py").read_text()], env=dict(os.environ), cwd=here,
                  log_path=here / "child.log")
    child.wait()
"""

GUARDED = """
import os, pathlib, signal, subprocess, sys, threading
from naosprint_worker.guard import watch_parent
lost = threading.Event()
watch_parent(lost.set, lambda: pathlib.Path("last").touch(), grace_s=0.2)
inner = subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read(); import time; time.sleep(600)"])
pathlib.Path("ready").write_text(f"{os.getpid()} {inner.pid}")
lost.wait()
pathlib.Path("noticed").write_text("yes")
signal.pause()
"""


def test_child_and_its_children_end_when_the_parent_is_killed(tmp_path: Path, ready: Path) -> None:
    """The parent gets SIGKILL, so the child can only notice the closed pipe."""
    (tmp_path / "child.py").write_text(GUARDED)
    parent = subprocess.Popen([sys.executable, "-c", textwrap.dedent(PARENT), str(tmp_path)])
    leader, inner = (int(pid) for pid in ready.read_text(encoding="utf-8").split())
    assert psutil.pid_exists(leader)
    parent.kill()
    parent.wait()
    assert wait_gone(leader)
    assert wait_gone(inner)
    assert (tmp_path / "noticed").read_text() == "yes"
    assert (tmp_path / "last").exists()
