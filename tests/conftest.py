"""What all tests need of the process in which they run."""

from __future__ import annotations

import ctypes
import gc
import json
import os
import signal
import sys
from collections.abc import Generator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests import forking

# On processors with AVX-512, NumPy's sines and roots differ from the C library's in the last digit. Compiled code is
# held against NumPy bit for bit, so the tests use NumPy's other kernels. It reads this when it is imported, and warns
# of names that a processor does not have.
if "avx512dq" in Path("/proc/cpuinfo").read_text(encoding="utf-8"):
    os.environ.setdefault("NPY_DISABLE_CPU_FEATURES", "X86_V4")

# The C library takes blocks of 15 MB, which MuJoCo asks for with each robot, from the heap once one was freed. Nothing
# of them is used, but a heap that has grown to more than the machine's memory keeps a process from starting others.
_M_MMAP_THRESHOLD = -3
ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, 1 << 20)

# Without bytecode each process would compile our packages again, and rewrite the assertions of all tests.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

forking.install()

# how long an example takes says nothing on a machine that does other work, too
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect tests without looking for garbage, and leave what they are out of every later search.

    The modules of all tests and what they import are half a million objects, which stay until the end.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


SECONDS: dict[str, float] = json.loads(Path(__file__).with_name("seconds.json").read_text(encoding="utf-8"))
"""Seconds that the tests of a file take, of those that take long (`benchmarks/tests/run.py --record`)."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest: processes that share the tests out by file then end together."""
    items.sort(key=lambda item: -SECONDS.get(item.nodeid.partition("::")[0], 0.0))  # stable: the others stay in order


@pytest.fixture(autouse=True)
def default_signals() -> None:
    """Reset the handlers of SIGINT and SIGTERM, which a test before may have replaced.

    A shell starts programs in the background with SIGINT ignored, and so would every program be that a test interrupts.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
