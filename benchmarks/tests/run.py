"""Processor time of tests with all their processes: servers, Postgres, workers, what outlives its parent.

    sudo .venv/bin/python benchmarks/tests/run.py tests/integration/worker    # arguments are pytest's

A control group of its own counts, so this needs root and Linux. Wall time says little on a busy machine.
Prints all of it, and the slowest thirty tests.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Generator
from pathlib import Path

import pytest

ROOTS = Path("/sys/fs/cgroup/cpuacct"), Path("/sys/fs/cgroup")
SHOWN = 30


class Group:
    """A control group of this process and its children."""

    def __init__(self) -> None:
        root = next(path for path in ROOTS if (path / "cgroup.procs").exists())
        self.path = root / f"tests-{os.getpid()}"
        self.path.mkdir()
        (self.path / "cgroup.procs").write_text(str(os.getpid()))

    def close(self) -> None:
        """Leave the group, and remove it if nothing else is left in it."""
        (self.path.parent / "cgroup.procs").write_text(str(os.getpid()))
        with contextlib.suppress(OSError):
            self.path.rmdir()

    def used_s(self) -> float:
        """Return the processor time so far, seconds."""
        version_1 = self.path / "cpuacct.usage"
        if version_1.exists():
            return int(version_1.read_text()) / 1e9
        line = next(line for line in (self.path / "cpu.stat").read_text().splitlines() if line.startswith("usage_usec"))
        return int(line.split()[1]) / 1e6


class Plugin:
    """Notes what each test takes, its fixtures among it."""

    def __init__(self, group: Group) -> None:
        self._group = group
        self.used_s: dict[str, float] = {}

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Measure a test from its setup to its teardown."""
        before = self._group.used_s()
        try:
            return (yield)
        finally:
            self.used_s[item.nodeid] = self._group.used_s() - before


def main() -> int:
    """Run the tests and print the table."""
    try:
        group = Group()
    except (OSError, StopIteration) as error:
        raise SystemExit(f"no control group: {error}; run it as root on Linux") from error
    plugin = Plugin(group)
    code = pytest.main(["-q", "-p", "no:cacheprovider", *sys.argv[1:]], plugins=[plugin])
    slowest = sorted(plugin.used_s.items(), key=lambda each: -each[1])
    print(f"{len(slowest)} tests, {sum(plugin.used_s.values()):.0f} s; with collection {group.used_s():.0f} s")
    for name, used_s in slowest[:SHOWN]:
        print(f"{used_s:7.1f} s  {name}")
    group.close()
    return int(code)


if __name__ == "__main__":
    raise SystemExit(main())
