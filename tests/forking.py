"""Child processes of tests, forked from a process that has already loaded PyTorch, SQLAlchemy and FastAPI.

A fresh interpreter needs 2 to 4 seconds of processor time to load what a worker, a training or the API loads, and the
tests start several hundred of them. After `install`, `subprocess.Popen` forks the programs of this repository from a
template process instead of executing a new interpreter. They keep their entry points: `runpy` runs the same module with
the same arguments, environment, working folder, descriptors, session and exit status, and they are children of the
process that started them. Everything else, and each start whose options cannot be reproduced, is executed as usual.

How a fork becomes a child of the process that asked for it: the template forks twice and the process between ends, so
the kernel hands the program to the nearest ancestor that adopts orphans, which the asking process is while it waits.
A worker starts trainings itself, so a worker gets a template of its own, forked before it begins. Programs with
packages of their own on `PYTHONPATH` get a template that has loaded these, too.

Trainings of workers whose environment has ENDLESS_TRAININGS are slowed to a fifth of a core after a second of processor
time: tests of deaths and outages watch trainings that would never end, and those computed more than everything else.
"""

from __future__ import annotations

import atexit
import ctypes
import faulthandler
import fcntl
import gc
import io
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

PRELOADED = (
    "naosprint_worker.trainer",
    "naosprint_worker.evaluator",
    "naosprint_worker.match",
    "naosprint_worker.worker",
    "naosprint_worker.application",
    "naosprint_api.app",
    "naosprint.rl.ppo",
    "naosprint.rl.imitation",
    "naosprint.rl.kinds",
    "naosprint.rl.columns",
    "naosprint.rl.runner",
    "naosim.kinds",
    "naosim.simspark.embedded",
    "naosprint.analysis.evaluation",
    "naosprint.__main__",
    "naojobs.__main__",
    "naoctl.cli",
)
"""Modules that the template loads."""

HEAVY = ("naosprint_worker", "naosprint_api", "naosprint")
"""Packages whose programs start the template."""
LIGHT = ("naoctl", "naojobs")
"""Packages whose programs are forked when it runs already: alone they load faster than it does."""

STARTUP = (
    *("PYTHON", "LC_", "LANG", "LD_", "GLIBC_", "MALLOC_"),
    *("OMP_", "GOMP_", "KMP_", "MKL_", "OPENBLAS_", "NPY_", "ATEN_", "TORCH"),
)
"""Beginnings of the names of variables that an interpreter or a library reads when it is loaded."""
QUIET = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0", "KMP_BLOCKTIME": "0"}
"""Those with which the template loads PyTorch, as trainings do: one in this process leaves them in its environment."""
FAULT_HANDLER, UNBUFFERED = "PYTHONFAULTHANDLER", "PYTHONUNBUFFERED"
"""Those of them that a fork follows: a worker sets them for its children."""

TRAINER, ENDLESS = "naosprint_worker.trainer", "ENDLESS_TRAININGS"
"""Module of the program that trains in a worker's child process, and the variable with which it is slowed."""
UNSLOWED_S, RUNS_S, RESTS_S = 1.0, 0.005, 0.02
"""Seconds of processor time after which a training is slowed, and for how long it then runs and rests in turns."""

_SET_DEATH_SIGNAL, _SET_SUBREAPER = 1, 36
"""Operations of prctl(2)."""

_libc = ctypes.CDLL(None)


def die_with_parent() -> None:
    """Make the kernel end this process when the process that started it dies without cleaning up (Linux).

    The one ``preexec_fn`` that a forked program may have.
    """
    _libc.prctl(_SET_DEATH_SIGNAL, signal.SIGKILL)


def leads_session(pid: int) -> bool:
    """Return whether a worker's child is one that it supervises, rather than the template of these."""
    try:
        return os.getsid(pid) == pid
    except ProcessLookupError:
        return False


class Template:
    """The asking end of a template process."""

    def __init__(self, control: socket.socket, environment: Mapping[str, str]) -> None:
        self.packages = _packages(environment)
        self._control = control
        self._startup = _startup(environment)
        self._lock = threading.Lock()

    def suits(self, environment: Mapping[str, str]) -> bool:
        """Return whether a program with this environment would have loaded its libraries as the template has."""
        return _startup(environment) == self._startup

    def fork(self, request: Mapping[str, Any], descriptors: Sequence[int]) -> int:
        """Fork a program; return its process id."""
        with self._lock:
            _libc.prctl(_SET_SUBREAPER, 1)
            try:
                socket.send_fds(self._control, [json.dumps(request).encode()], descriptors)
                return int(self._control.recv(20))
            finally:
                _libc.prctl(_SET_SUBREAPER, 0)


def install(template: Template | None = None) -> None:
    """Make `subprocess.Popen` of this process fork our programs; it starts a template when it needs one.

    Args:
        template: one that runs already.
    """
    execute: Callable[..., int] = subprocess._fork_exec  # type: ignore[attr-defined]
    templates = {} if template is None else {template.packages: template}
    starting = threading.Lock()

    def fork_exec(*options: Any) -> int:
        request, descriptors = _request(*options)
        if request is not None:
            packages = _packages(request["environment"])
            with starting:
                if packages not in templates and request["module"].partition(".")[0] in HEAVY:
                    templates[packages] = _start(packages)
                template = templates.get(packages)
            if template is not None and template.suits(request["environment"]):
                return template.fork(request, descriptors)
        return execute(*options)

    subprocess._fork_exec = fork_exec  # type: ignore[attr-defined]


def _start(packages: str) -> Template:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    if packages:
        environment["PYTHONPATH"] = packages
    with theirs:
        # Forked programs show their own environment in the place of this variable.
        process = subprocess.Popen(
            [sys.executable, "-P", __file__, str(theirs.fileno())],
            env=environment | {"ROOM": "x" * 65_000},
            stdin=subprocess.DEVNULL,
            pass_fds=(theirs.fileno(),),
        )

    def stop() -> None:
        ours.close()
        process.wait()

    atexit.register(stop)
    return Template(ours, environment)


def _packages(environment: Mapping[str, str]) -> str:
    """Return the PYTHONPATH of an environment if packages are on it: plug-ins are found when modules are loaded."""
    path = environment.get("PYTHONPATH", "")
    return path if any(any(Path(item).glob("*.dist-info")) for item in path.split(os.pathsep) if item) else ""


def _startup(environment: Mapping[str, str]) -> dict[str, str]:
    followed = ("PYTHONPATH", FAULT_HANDLER, UNBUFFERED)
    read = {key: value for key, value in environment.items() if key.startswith(STARTUP) and key not in followed}
    return {**QUIET, **read}


def _request(
    argv: Sequence[Any],
    _executables: object,
    close_fds: bool,
    keep: Sequence[int],
    cwd: Any,
    environment: Sequence[bytes] | None,
    stdin: int,
    _stdin_write: int,
    _stdout_read: int,
    stdout: int,
    _stderr_read: int,
    stderr: int,
    _error_read: int,
    error_write: int,
    restore_signals: bool,
    start_new_session: bool,
    process_group: int,
    gid: int | None,
    groups: Sequence[int] | None,
    uid: int | None,
    umask: int,
    preexec_fn: Callable[[], None] | None,
    *_vfork: object,
) -> tuple[dict[str, Any] | None, list[int]]:
    """Return what a template needs to start a program and its descriptors, or None if it cannot start this one."""
    words = [os.fsdecode(word) for word in argv]
    if words[0] == sys.executable:
        options = words[1:]
        safe = options[:1] == ["-P"]
        if options[safe : safe + 1] != ["-m"]:
            return None, []
        module, arguments = options[safe + 1], options[safe + 2 :]
    elif Path(words[0]).parent == Path(sys.executable).parent and Path(words[0]).name in ("naoctl", "naosprint"):
        safe, module, arguments = True, Path(words[0]).name, words[1:]
    else:
        return None, []
    ordinary = close_fds and restore_signals and process_group == -1 and gid is groups is uid is None
    if module.partition(".")[0] not in HEAVY + LIGHT or not ordinary or preexec_fn not in (None, die_with_parent):
        return None, []
    if environment is None:
        variables = dict(os.environ)
    else:
        variables = dict(os.fsdecode(item).split("=", 1) for item in environment)
    passed = [number for number in keep if number != error_write]
    request = {
        "argv": words,
        "module": module,
        "arguments": arguments,
        "safe": safe,
        "cwd": os.path.abspath(os.fsdecode(cwd) if cwd is not None else os.curdir),
        "environment": variables,
        "umask": _umask() if umask == -1 else umask,
        "session": start_new_session,
        "dies": preexec_fn is not None,
        "descriptors": [0, 1, 2, *passed],
    }
    standard = [given if given != -1 else own for own, given in enumerate((stdin, stdout, stderr))]
    return request, [*standard, *passed]


def _umask() -> int:
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(next(line for line in status.splitlines() if line.startswith("Umask")).split()[1], 8)


# --- in the template ---


def serve(control: socket.socket) -> dict[str, Any] | None:
    """Fork a program for each request; return the request in the fork, and None once the other end has closed."""
    gc.freeze()  # the collector would write to all pages, which then are shared no longer
    while True:
        message, received, _, _ = socket.recv_fds(control, 1 << 20, 64)
        if not message:
            return None
        pid_read, pid_write = os.pipe()
        go_read, go_write = os.pipe()
        between = os.fork()
        if between == 0:
            child = os.fork()
            if child:
                os.write(pid_write, str(child).encode())
                os._exit(0)
            os.close(go_write)
            os.read(go_read, 1)  # until the process between is gone
            request: dict[str, Any] = json.loads(message)
            _become(request, received)
            return request
        os.waitpid(between, 0)
        control.send(os.read(pid_read, 20))
        for number in (*received, pid_read, pid_write, go_read, go_write):
            os.close(number)


def _become(request: Mapping[str, Any], received: Sequence[int]) -> None:
    """Give this process what the kernel gives to a program that is executed, and what its interpreter makes of it."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    high = [fcntl.fcntl(number, fcntl.F_DUPFD, 1000) for number in received]
    os.closerange(3, 1000)
    for target, number in zip(request["descriptors"], high, strict=True):
        os.dup2(number, target)
    os.closerange(1000, 1000 + len(high) + 1)
    os.chdir(request["cwd"])
    os.umask(request["umask"])
    if request["session"]:
        os.setsid()
    if request["dies"]:
        die_with_parent()
    environment: dict[str, str] = request["environment"]
    os.environ.clear()
    os.environ.update(environment)
    _show(request["argv"], environment)
    path = [item for item in environment.get("PYTHONPATH", "").split(os.pathsep) if item]
    others = [item for item in sys.path if item not in path]
    sys.path[:] = [*([] if request["safe"] else [request["cwd"]]), *path, *others]
    sys.argv[:] = [request["argv"][0], *request["arguments"]]
    sys.orig_argv[:] = request["argv"]
    for name, number, mode in (("stdin", 0, "r"), ("stdout", 1, "w"), ("stderr", 2, "w")):
        before = getattr(sys, name)
        new = _stream(number, mode, before.encoding, before.errors, unbuffered=bool(environment.get(UNBUFFERED)))
        setattr(sys, name, new)
        setattr(sys, f"__{name}__", new)
    if environment.get(FAULT_HANDLER):
        faulthandler.enable()
    else:
        faulthandler.disable()
    for seeded in ("random", "numpy.random"):
        sys.modules[seeded].seed()
    if any(Path(item, "sitecustomize.py").exists() for item in path):
        sys.modules.pop("sitecustomize", None)
        __import__("sitecustomize")
    if request["module"] == TRAINER and ENDLESS in environment:
        signal.signal(signal.SIGPROF, lambda *_: time.sleep(RESTS_S))
        signal.setitimer(signal.ITIMER_PROF, UNSLOWED_S, RUNS_S)


def _stream(number: int, mode: str, encoding: str, errors: str, *, unbuffered: bool) -> io.TextIOWrapper:
    """Return one of the three standard streams as an interpreter opens it."""
    raw: Any = io.FileIO(number, mode, closefd=False)
    raw.name = ("<stdin>", "<stdout>", "<stderr>")[number]
    binary = raw if unbuffered and mode == "w" else (io.BufferedReader if mode == "r" else io.BufferedWriter)(raw)
    return io.TextIOWrapper(
        binary,
        encoding,
        errors,
        newline="\n",
        line_buffering=not unbuffered and (number == 2 or raw.isatty()),
        write_through=unbuffered,
    )


def _show(argv: Sequence[str], environment: Mapping[str, str]) -> None:
    """Replace the command line and the environment that /proc shows of this process, as far as there is room."""
    fields = Path("/proc/self/stat").read_bytes().rpartition(b")")[2].split()
    for place, words in ((45, argv), (47, [f"{name}={value}" for name, value in environment.items()])):
        start, end = int(fields[place]), int(fields[place + 1])
        text = b"".join(os.fsencode(word) + b"\0" for word in words)[: end - start - 1]
        ctypes.memmove(start, text.ljust(end - start, b"\0"), end - start)


def _main() -> None:
    status: list[int] = []

    # Registered first, so it runs last, after the program's own: what is left of an interpreter's end is to free each
    # object of each library, which copies the pages that are shared.
    @atexit.register
    def leave() -> None:
        if status:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status[0])

    from naosprint.threads import quiet_openmp

    given = dict(os.environ)
    quiet_openmp()  # as trainings do before they load PyTorch
    for module in PRELOADED:
        __import__(module)
    for name in os.environ.keys() - given.keys():
        del os.environ[name]
    request = serve(socket.socket(fileno=int(sys.argv[1])))
    if request is not None and request["module"] == "naosprint_worker":
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        if os.fork() == 0:
            ours.close()
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)  # it ends with its worker
            null = os.open(os.devnull, os.O_RDWR)
            for number in (0, 1, 2):
                os.dup2(null, number)
            request = serve(theirs)
        else:
            theirs.close()
            install(Template(ours, request["environment"]))
    if request is None:
        os._exit(0)
    for loaded in (request["module"], f"{request['module']}.__main__"):
        sys.modules.pop(loaded, None)
    try:
        runpy._run_module_as_main(request["module"])  # type: ignore[attr-defined]
        status.append(0)
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):
            status.append((end.code or 0) & 0xFF)
        raise


if __name__ == "__main__":
    _main()
