"""Forked programs of tests see what executed ones see."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from naosprint import threads

from tests import forking

PROBE = """
import atexit, json, os, signal, sys
atexit.register(lambda: print("last"))
shown = lambda name: open(f"/proc/self/{name}", encoding="utf-8").read().rstrip(chr(0)).split(chr(0))
status = dict(line.split(":", 1) for line in open("/proc/self/status", encoding="ascii"))
print(json.dumps({
    "name": __name__, "argv": sys.argv, "path": sys.path[:2], "cwd": os.getcwd(), "input": sys.stdin.read(),
    "environment": dict(os.environ), "command": shown("cmdline"), "shown": sorted(shown("environ")),
    "leads": os.getsid(0) == os.getpid(), "parent": os.getppid(), "umask": status["Umask"],
    # without the signals that the C library uses itself
    "signals": [int(status[name], 16) & 0x7FFFFFFF for name in ("SigBlk", "SigIgn", "SigCgt")],
    "descriptors": sorted(int(number) for number in os.listdir("/proc/self/fd")),
    "streams": [
        [s.encoding, s.errors, s.line_buffering, s.write_through, type(s.buffer).__name__, s.name]
        for s in (sys.stdin, sys.stdout, sys.stderr)
    ],
}))
if "wait" in sys.argv:
    sys.stdout.flush()
    signal.pause()
if "raise" in sys.argv:
    raise ValueError("wrong")
sys.exit("a message" if "message" in sys.argv else 3)
"""


OPTIONS = {"start_new_session": True, "umask": 0o27, "preexec_fn": forking.die_with_parent}


@pytest.fixture
def probe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the module `probe`, which is forked, and a copy `other` of it, which is executed."""
    for name in ("probe", "other"):
        (tmp_path / f"{name}.py").write_text(PROBE, encoding="utf-8")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text("import os; os.environ['CUSTOMIZED'] = '1'", encoding="utf-8")
    monkeypatch.setattr(forking, "HEAVY", ("probe",))
    return tmp_path


def run(folder: Path, module: str, *words: str, **options: Any) -> tuple[int, dict[str, Any], str, str]:
    done = subprocess.run(
        [sys.executable, "-m", module, *words], cwd=folder, input="äöü", capture_output=True, text=True, **options
    )
    first, _, rest = done.stdout.replace("other", "probe").partition("\n")
    return done.returncode, json.loads(first), rest, done.stderr.replace("other", "probe")


CHILD = {"PYTHONFAULTHANDLER": "1", "PYTHONUNBUFFERED": "1"}
"""What a worker sets for its children."""
SERVICE = {"PYTHONUTF8": "1", "PYTHONUNBUFFERED": "1"}
"""What `naoctl up` sets for its services."""


@pytest.mark.parametrize("variables", [{}, CHILD, SERVICE], ids=["plain", "child of a worker", "service"])
@pytest.mark.parametrize("words", [(), ("message",)])
@pytest.mark.parametrize("options", [{}, OPTIONS])
def test_it_is_the_same_process(
    probe: Path, words: tuple[str, ...], options: dict[str, Any], variables: dict[str, str]
) -> None:
    environment = {**os.environ, **variables, "PYTHONPATH": str(probe / "site"), "ONE": "=a b"}
    forked, executed = (run(probe, module, *words, env=environment, **options) for module in ("probe", "other"))
    assert forked == executed
    assert executed[1]["environment"]["CUSTOMIZED"] == "1"
    assert executed[0] == (1 if words else 3) and executed[1]["parent"] == os.getpid()


def test_an_error_ends_it_as_it_ends_any_program(probe: Path) -> None:
    code, _, rest, errors = run(probe, "probe", "raise")
    assert (code, rest) == (1, "last\n") and errors.endswith("ValueError: wrong\n")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, -15), (signal.SIGKILL, -9), (signal.SIGINT, -2)])
def test_signals_end_it(probe: Path, number: signal.Signals, code: int) -> None:
    command = [sys.executable, "-m", "probe", "wait"]
    options: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, cwd=probe, **options) as process:
        assert process.stdout is not None
        shown = json.loads(process.stdout.readline())
        assert shown["command"] == command
        process.send_signal(number)
    assert process.returncode == code


def test_the_template_loads_what_a_training_in_this_process_would() -> None:
    assert forking.QUIET == threads._QUIET
    environment = {**os.environ, **forking.QUIET}
    assert forking.Template(None, os.environ).suits(environment)  # type: ignore[arg-type]
    assert not forking.Template(None, os.environ).suits({**environment, "OMP_WAIT_POLICY": "ACTIVE"})  # type: ignore[arg-type]


def test_what_an_interpreter_reads_when_it_starts_is_executed(probe: Path) -> None:
    _, seen, _, _ = run(probe, "probe", env={**os.environ, "PYTHONUTF8": "0", "LC_ALL": "C"})
    assert seen["streams"][1][1] == "surrogateescape"


def test_packages_of_ones_own_are_loaded_before_the_fork(probe: Path) -> None:
    """They are on its path as in an executed program, and on that of no other."""
    site = probe / "packages"
    (site / "own-1.dist-info").mkdir(parents=True)
    (site / "own-1.dist-info" / "METADATA").write_text("Name: own\nVersion: 1\n", encoding="utf-8")
    forked, executed = (
        run(probe, module, env={**os.environ, "PYTHONPATH": str(site)}) for module in ("probe", "other")
    )
    assert forked == executed and forked[1]["path"][1] == str(site)
    _, without, _, _ = run(probe, "probe")
    assert str(site) not in without["path"]


def test_processes_of_tests_keep_their_bytecode() -> None:
    assert not sys.dont_write_bytecode
    assert "PYTHONDONTWRITEBYTECODE" not in os.environ


WAYS = {"launch": forking.LAUNCH, "guard": forking.GUARD}
SERVER = {"PATH": os.environ["PATH"], "LANG": "C.UTF-8", "OMP_NUM_THREADS": "1"}
"""What launchers set for servers."""


@pytest.fixture
def forked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The processes that templates fork in a test, in which programs of `probe` are servers."""
    monkeypatch.setattr(forking, "SERVERS", ("probe",))
    forked, fork = [], forking.Template.fork
    monkeypatch.setattr(forking.Template, "fork", lambda *all: forked.append(fork(*all)) or forked[-1])
    return forked


@pytest.mark.parametrize("way", WAYS)
def test_a_script_that_starts_it_is_the_same(probe: Path, way: str, forked: list[int]) -> None:
    """One script becomes the program, the other one watches it."""

    def started(module: str) -> tuple[int, dict[str, Any], str]:
        arguments = [str(os.getpid()), "9", "-"] if way == "launch" else [str(probe / "home"), "15"]
        command = [sys.executable, "-I", "-S", WAYS[way], *arguments, sys.executable, "-P", "-m", module]
        environment = {**(os.environ if way == "launch" else SERVER), "PYTHONPATH": str(probe)}
        with subprocess.Popen(
            command, cwd=probe, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        ) as process:
            assert process.stdin is not None and process.stdout is not None
            if way == "launch":
                process.stdin.close()
            first, rest = process.stdout.readline().replace("other", "probe"), process.stdout.read()
            code = process.wait()
        shown = json.loads(first)
        assert (shown["parent"] == os.getpid()) == (way == "launch")
        return code, {**shown, "parent": None}, rest

    assert started("probe") == started("other")
    assert len(forked) == 1


def test_a_server_ends_with_its_guard(probe: Path, forked: list[int]) -> None:
    command = [
        sys.executable,
        "-I",
        "-S",
        forking.GUARD,
        str(probe / "home"),
        "15",
        sys.executable,
        "-m",
        "probe",
        "wait",
    ]
    environment = {**SERVER, "PYTHONPATH": str(probe)}
    options: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "start_new_session": True}
    with subprocess.Popen(command, cwd=probe, env=environment, **options) as process:
        assert process.stdin is not None and process.stdout is not None
        assert json.loads(process.stdout.readline())["parent"] == process.pid
        assert forked == [process.pid]
        process.kill()
        assert process.stdout.read() == b""  # the other end is closed: nothing of it runs
