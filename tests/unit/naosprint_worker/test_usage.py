"""Processor time and memory of a training."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest
from naosprint_worker import usage as module
from naosprint_worker.usage import Usage


def test_the_work_of_this_process_counts() -> None:
    usage = Usage()
    until = time.process_time() + 0.2
    began = time.monotonic()
    while time.process_time() < until:
        pass
    elapsed_s = time.monotonic() - began
    found = usage.read()
    assert found["cpus"] == pytest.approx(0.2 / elapsed_s, rel=0.4)
    assert 10 < found["memory_mb"] < 10_000


def test_descendants_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_SEARCH_S", 0.0)
    usage = Usage()
    before = usage.read()["memory_mb"]
    program = "import sys; held = bytearray(64 << 20); print(flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdin is not None and child.stdout is not None
        child.stdout.readline()
        assert usage.read()["memory_mb"] > before + 64
        child.stdin.close()
    assert usage.read()["memory_mb"] < before + 64
