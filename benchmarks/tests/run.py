"""Processor time of tests with all their processes: servers, Postgres, workers, what outlives its parent.

    sudo .venv/bin/python benchmarks/tests/run.py tests/integration/worker    # arguments are pytest's
    sudo .venv/bin/python benchmarks/tests/run.py --record -m "not e2e"       # which files `make test` begins with

A control group of its own counts, so this needs root and Linux. Wall time says little on a busy machine.
Prints all of it, and the slowest thirty tests. With --record, the wall time of the files that take long goes to
tests/seconds.json; files that are not run keep their entries.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Generator, Mapping
from pathlib import Path

import pytest
from naosprint.programs import run_program

ROOTS = Path("/sys/fs/cgroup/cpuacct"), Path("/sys/fs/cgroup")
SHOWN = 30
RECORD, RECORDED_S = Path(__file__).parents[2] / "tests" / "seconds.json", 3.0
"""File with the seconds of the files of tests that take as long or longer."""


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
        self.lasted_s: defaultdict[str, float] = defaultdict(float)
        """Wall time by file."""

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Measure a test from its setup to its teardown."""
        before, began = self._group.used_s(), time.monotonic()
        try:
            return (yield)
        finally:
            self.used_s[item.nodeid] = self._group.used_s() - before
            self.lasted_s[item.nodeid.partition("::")[0]] += time.monotonic() - began


def record(lasted_s: Mapping[str, float]) -> None:
    """Write the seconds of files that take long, the longest first."""
    known: dict[str, float] = json.loads(RECORD.read_text(encoding="utf-8")) | {
        file: round(seconds, 1) for file, seconds in lasted_s.items()
    }
    kept = {file: seconds for file, seconds in known.items() if seconds >= RECORDED_S}
    longest = dict(sorted(kept.items(), key=lambda each: -each[1]))
    RECORD.write_text(json.dumps(longest, indent=1) + "\n", encoding="utf-8")


def main() -> int:
    """Run the tests and print the table."""
    try:
        group = Group()
    except (OSError, StopIteration) as error:
        raise SystemExit(f"no control group: {error}; run it as root on Linux") from error
    plugin, words = Plugin(group), [word for word in sys.argv[1:] if word != "--record"]
    code = pytest.main(["-q", "-p", "no:cacheprovider", *words], plugins=[plugin])
    if len(words) < len(sys.argv) - 1:
        record(plugin.lasted_s)
    slowest = sorted(plugin.used_s.items(), key=lambda each: -each[1])
    print(f"{len(slowest)} tests, {sum(plugin.used_s.values()):.0f} s; with collection {group.used_s():.0f} s")
    for name, used_s in slowest[:SHOWN]:
        print(f"{used_s:7.1f} s  {name}")
    group.close()
    return int(code)


if __name__ == "__main__":
    run_program(main)
