"""Child processes of tests, forked from a process that has already loaded PyTorch, SQLAlchemy and FastAPI.

A fresh interpreter needs 2 to 4 seconds of processor time to load what a worker, a training or the API loads, and the
tests start several hundred of them. After `install`, `subprocess.Popen` forks the programs of this repository from a
template process instead of executing a new interpreter. They keep their entry points: `runpy` runs the same module with
the same arguments, environment, working folder, descriptors, session and exit status, and they are children of the
process that started them. Everything else, and each start whose options cannot be reproduced, is executed as usual.

How a fork becomes a child of the process that asked for it: the template forks twice and the process between ends, so
the kernel hands the program to the nearest ancestor that adopts orphans, which the asking process is while it waits.
A worker starts trainings itself and `naoctl up` workers, so these get a template of their own, forked before they
begin. Programs with packages of their own on `PYTHONPATH` get a template that has loaded these, too.

Some programs are started through a script of ours, which watches them (`naosim.launchers.guard`) or becomes them
(`naoctl.stack.launch`): a fork runs the script, and where it would execute the program, it becomes that. Servers, which
launchers start with few variables, have a template of their own that has loaded MuJoCo.

Trainings of workers whose environment has ENDLESS_TRAININGS are slowed to a fifth of a core after a second of processor
time: tests of deaths and outages watch trainings that would never end, and those computed more than everything else.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import faulthandler
import fcntl
import gc
import importlib.util
import io
import json
import locale
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

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
    "naosim.mujoco.kinds",
    "naosim.simspark.embedded",
    "naosim.simspark.kinds",
    "naosprint.analysis.evaluation",
    "naosprint.analysis.report",
    "naosprint.__main__",
    "naojobs.__main__",
    "naoctl.cli",
    # what PyTorch's first optimizer and Celery's worker load later
    "torch._dynamo",
    "celery.apps.worker",
    "celery.backends.base",
    "celery.concurrency.thread",
    "celery.fixups.django",
    "kombu.transport.redis",
)
"""Modules that the template loads."""

PRELOADED_BY_SERVERS = (
    "rcsssmj.games.soccer.server.soccer_server",
    "rcsssmj.games.soccer.sim.soccer_referee",
    "rcsssmj.games.soccer.soccer_fields",
    "rcsssmj.games.soccer.soccer_rules",
    "naosim.cli",
)
"""Modules that the template of servers loads."""

HEAVY = ("naosprint_worker", "naosprint_api", "naosprint")
"""Packages whose programs start the template."""
LIGHT = ("naoctl", "naojobs")
"""Packages whose programs are forked when it runs already: alone they load faster than it does."""
SERVERS = ("rcsssmj", "naosim")
"""Packages whose programs are servers if a guard watches them."""


def _script(package: str, path: str) -> str:
    """Return the path of a package's file; nothing is imported, since that may load NumPy too early."""
    found = importlib.util.find_spec(package)
    assert found is not None and found.origin is not None
    return str(Path(found.origin).parent / path)


GUARD, LAUNCH = _script("naosim", "launchers/guard.py"), _script("naoctl", "stack/launch.py")
"""Scripts that start programs: their arguments end with a command."""

STARTUP = (
    *("PYTHON", "LC_", "LANG", "LD_", "GLIBC_", "MALLOC_"),
    *("OMP_", "GOMP_", "KMP_", "MKL_", "OPENBLAS_", "NPY_", "ATEN_", "TORCH"),
)
"""Beginnings of the names of variables that an interpreter or a library reads when it is loaded."""
QUIET = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0", "KMP_BLOCKTIME": "0"}
"""Those with which the template loads PyTorch, as trainings do: one in this process leaves them in its environment."""
FAULT_HANDLER, UNBUFFERED, UTF8 = "PYTHONFAULTHANDLER", "PYTHONUNBUFFERED", "PYTHONUTF8"
"""Those of them that a fork follows: a worker sets them for its children, and `naoctl up` for its services."""

TRAINER, ENDLESS = "naosprint_worker.trainer", "ENDLESS_TRAININGS"
"""Module of the program that trains in a worker's child process, and the variable with which it is slowed."""
UNSLOWED_S, RUNS_S, RESTS_S = 1.0, 0.005, 0.02
"""Seconds of processor time after which a training is slowed, and for how long it then runs and rests in turns."""

_SET_DEATH_SIGNAL, _SET_SUBREAPER = 1, 36
"""Operations of prctl(2)."""

_PREEXEC_FN = 21
"""Place of the argument `preexec_fn` of `subprocess._fork_exec`."""

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
    templates = {} if template is None else {(template.packages, False): template}
    starting = threading.Lock()

    def fork_exec(*options: Any) -> int:
        request, descriptors = _request(*options)
        if request is not None:
            packages, serves = _packages(request["environment"]), request.get("script") == GUARD
            with starting:
                template = templates.get((packages, serves))
                if template is None and (serves or _starts_others(request) or _top(request["module"]) in HEAVY):
                    template = _start(packages, request["environment"] if serves else os.environ, serves=serves)
                    templates[packages, serves] = template
            if template is not None and template.suits(request["environment"]):
                return template.fork(request, descriptors)
        return execute(*options)

    subprocess._fork_exec = fork_exec  # type: ignore[attr-defined]


def _top(module: str) -> str:
    return module.partition(".")[0]


def _starts_others(request: Mapping[str, Any]) -> bool:
    """Return whether a program starts programs that can be forked: trainings, a whole service, an export."""
    starts = {"up", "demo", "report", "export", "policies"}.intersection(request["arguments"])
    return request["module"] == "naosprint_worker" or (request["module"] == "naoctl" and bool(starts))


def _start(packages: str, environment: Mapping[str, str], *, serves: bool) -> Template:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    environment = {name: value for name, value in environment.items() if name != "PYTHONPATH"}
    if packages:
        environment["PYTHONPATH"] = packages
    kind = "servers" if serves else "programs"
    with theirs:
        # Forked programs show their own environment in the place of this variable.
        process = subprocess.Popen(
            [sys.executable, "-P", __file__, str(theirs.fileno()), kind],
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
    followed = ["PYTHONPATH", FAULT_HANDLER, UNBUFFERED]
    if environment.get(UTF8) == "1" and locale.getencoding() == "UTF-8":
        followed.append(UTF8)  # only errors of the standard streams differ
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
    program: Mapping[str, Any] | None = None,
) -> tuple[dict[str, Any] | None, list[int]]:
    """Return what a template needs to start a program and its descriptors, or None if it cannot start this one."""
    words = [os.fsdecode(word) for word in argv]
    program = program or _program(words)
    ordinary = close_fds and restore_signals and process_group == -1 and gid is groups is uid is None
    if program is None or not ordinary or preexec_fn not in (None, die_with_parent):
        return None, []
    if environment is None:
        variables = dict(os.environ)
    else:
        variables = dict(os.fsdecode(item).split("=", 1) for item in environment)
    passed = [number for number in keep if number != error_write]
    request = {
        **program,
        "cwd": os.path.abspath(os.fsdecode(cwd) if cwd is not None else os.curdir),
        "environment": variables,
        "umask": _umask() if umask == -1 else umask,
        "session": start_new_session,
        "dies": preexec_fn is not None,
        "descriptors": [0, 1, 2, *passed],
    }
    standard = [given if given != -1 else own for own, given in enumerate((stdin, stdout, stderr))]
    return request, [*standard, *passed]


def _program(words: list[str]) -> dict[str, Any] | None:
    """Return what a command of ours runs, or None if it is another's.

    Returns:
        `argv`; `module`, its `arguments`, and whether its path is without the working folder, `safe`. With a `script`,
        which is run first, `arguments` are those of the script.
    """
    if words[0] == sys.executable and words[1:3] == ["-I", "-S"]:
        program = None
        if words[3] == GUARD:  # home, signal, command
            program = _program_of(words[6:], SERVERS)
        elif words[3] == LAUNCH and words[6:7] == ["-"]:  # parent, signal, the account of this process, command
            program = _program_of(words[7:], HEAVY + LIGHT)
        return program and {**program, "argv": words, "arguments": words[4:], "safe": True, "script": words[3]}
    return _program_of(words, HEAVY + LIGHT)


def _program_of(words: list[str], packages: Collection[str] | None = None) -> dict[str, Any] | None:
    if not words:
        return None
    safe, program = words[1:2] == ["-P"], Path(words[0])
    if words[0] == sys.executable and words[1 + safe : 2 + safe] == ["-m"]:
        module, arguments = words[2 + safe], words[3 + safe :]
    elif program.parent == Path(sys.executable).parent and program.name in ("naoctl", "naosprint"):
        safe, module, arguments = True, program.name, words[1:]
    else:
        return None
    if packages is not None and _top(module) not in packages:
        return None
    return {"argv": words, "module": module, "arguments": arguments, "safe": safe}


def _umask() -> int:
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(next(line for line in status.splitlines() if line.startswith("Umask")).split()[1], 8)


# --- in the template ---


def serve(control: socket.socket) -> dict[str, Any] | None:
    """Fork a program for each request; return the request in the fork, and None once the other end has closed."""
    gc.freeze()  # the collector would write to all pages, which then are shared no longer
    for finalizer in list(weakref.finalize._registry):  # type: ignore[attr-defined]
        finalizer.atexit = False  # PyTorch's remove thousands of operators
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
            control.detach()  # closed with all others
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
    path = [item for item in environment.get("PYTHONPATH", "").split(os.pathsep) if item]
    others = [item for item in sys.path if item not in path]
    sys.path[:] = [*([] if request["safe"] else [request["cwd"]]), *path, *others]
    _take_arguments(request, environment)
    for name, number, mode in (("stdin", 0, "r"), ("stdout", 1, "w"), ("stderr", 2, "w")):
        before = getattr(sys, name)
        errors = "surrogateescape" if environment.get(UTF8) and name != "stderr" else before.errors
        new = _stream(number, mode, before.encoding, errors, unbuffered=bool(environment.get(UNBUFFERED)))
        setattr(sys, name, new)
        setattr(sys, f"__{name}__", new)
    if environment.get(FAULT_HANDLER):
        faulthandler.enable()
    else:
        faulthandler.disable()
    for seeded in ("random", "numpy.random"):
        if seeded in sys.modules:
            sys.modules[seeded].seed()
    if any(Path(item, "sitecustomize.py").exists() for item in path):
        sys.modules.pop("sitecustomize", None)
        __import__("sitecustomize")
    if request["module"] == TRAINER and ENDLESS in environment:
        signal.signal(signal.SIGPROF, lambda *_: time.sleep(RESTS_S))
        signal.setitimer(signal.ITIMER_PROF, UNSLOWED_S, RUNS_S)


def _take_arguments(request: Mapping[str, Any], environment: Mapping[str, str]) -> None:
    _show(request["argv"], environment)
    sys.argv[:] = [request.get("script", request["argv"][0]), *request["arguments"]]
    sys.orig_argv[:] = request["argv"]


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

    control, kind = socket.socket(fileno=int(sys.argv[1])), sys.argv[2]
    if kind == "programs":
        _load_programs()
    else:
        _load_servers()
    request = serve(control)
    while request is not None and _starts_others(request):
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        pid = os.fork()
        if pid:
            theirs.close()
            install(Template(ours, request["environment"]))
            atexit.register(_end_template, ours, pid)
            break
        ours.close()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)  # it ends with its program
        null = os.open(os.devnull, os.O_RDWR)
        for number in (0, 1, 2):
            os.dup2(null, number)
        request = serve(theirs)
    if request is None:
        os._exit(0)
    try:
        _run(request)
        status.append(0)
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):
            status.append((end.code or 0) & 0xFF)
        raise


def _end_template(control: socket.socket, pid: int) -> None:
    control.close()
    with contextlib.suppress(ChildProcessError):
        os.waitpid(pid, 0)


def _load_programs() -> None:
    from naosprint.threads import quiet_openmp

    given = dict(os.environ)
    quiet_openmp()  # as trainings do before they load PyTorch
    for module in PRELOADED:
        __import__(module)
    from naospec import plugins
    from sqlalchemy.orm import configure_mappers

    configure_mappers()
    for group in (plugins.TASKS, plugins.ROBOTS, plugins.SIMULATORS, plugins.LEARNERS, plugins.ROBOT_DEFAULTS):
        plugins.names(group)
    for name in os.environ.keys() - given.keys():
        del os.environ[name]


def _load_servers() -> None:
    for module in PRELOADED_BY_SERVERS:
        __import__(module)
    from rcsssmj.resources.spec_provider import ModelSpecProvider

    for robot in ("T1", "K1"):  # MuJoCo keeps the meshes that it has read
        spec = ModelSpecProvider().load_robot_spec(robot)
        assert spec is not None
        spec.compile()


class _BecomesError(BaseException):
    """Raised in a process by a script that would be replaced by another program, which this process now becomes."""

    def __init__(self, program: Mapping[str, Any]) -> None:
        self.program = program


def _run(request: Mapping[str, Any]) -> None:
    """Run a script until it becomes a program, and run the program."""
    program = request
    if "script" in request:
        execute, execv = subprocess._fork_exec, os.execv  # type: ignore[attr-defined]
        subprocess._fork_exec, os.execv = _fork_from_guard, _become_program  # type: ignore[attr-defined]
        try:
            runpy.run_path(request["script"], run_name="__main__")
            return
        except _BecomesError as replaced:
            program = replaced.program
        finally:
            subprocess._fork_exec, os.execv = execute, execv  # type: ignore[attr-defined]
    for loaded in (program["module"], f"{program['module']}.__main__"):
        sys.modules.pop(loaded, None)
    runpy._run_module_as_main(program["module"])  # type: ignore[attr-defined]


def _fork_from_guard(*options: Any) -> int:
    """Fork the guard, which has loaded what servers load and has no threads, where it would execute a server."""
    plain = list(options)
    plain[_PREEXEC_FN] = None
    words = [os.fsdecode(word) for word in options[0]]
    program = _program_of(words)
    assert program is not None
    request, descriptors = _request(*plain, program=program)
    pid = os.fork()
    if pid:
        return pid
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    _become(request, descriptors)
    options[_PREEXEC_FN]()
    _run_to_the_end(request)


def _run_to_the_end(request: Mapping[str, Any]) -> NoReturn:
    """Run a program and end this process as an interpreter ends, without a return to the frames that have forked it."""
    code = 1
    try:
        _run(request)
        code = 0
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):
            code = (end.code or 0) & 0xFF
        else:
            sys.stderr.write(f"{end.code}\n")
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    except BaseException:
        sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _become_program(_path: str, words: list[str]) -> None:
    """Become a program where `os.execv` would execute it."""
    program = _program_of(words)
    assert program is not None
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # as a new interpreter does
    _take_arguments(program, os.environ)
    raise _BecomesError(program)


if __name__ == "__main__":
    _main()
