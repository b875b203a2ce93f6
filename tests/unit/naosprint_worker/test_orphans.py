"""Processes of a dead worker are ended; nothing else is."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest
from naosprint_worker.orphans import OWNER_VARIABLE, OrphanSweeper, Owner


@pytest.fixture
def dead_owner() -> Owner:
    """The identity of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", "pass"])
    process.wait()
    return Owner(Owner.current().namespace, process.pid, Owner.current().started)


@pytest.fixture
def sleeper(request: pytest.FixtureRequest) -> Iterator[subprocess.Popen[bytes]]:
    """A process whose environment contains the owner given as parameter by fixture name, or another text."""
    mark = request.param if isinstance(request.param, str) else str(request.param())
    if mark == "dead_owner":
        mark = str(request.getfixturevalue("dead_owner"))
    process = subprocess.Popen(
        [sys.executable, "-c", "print(flush=True); import time; time.sleep(600)"],
        env={**os.environ, OWNER_VARIABLE: mark},
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    process.stdout.readline()
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def elsewhere() -> Owner:
    """Return an owner in another process-id namespace, which cannot be checked here."""
    return Owner("pid:[1]", 2**22, 1.0)


@pytest.mark.parametrize("sleeper", ["dead_owner"], indirect=True)
def test_child_of_a_dead_worker_is_ended(sleeper: subprocess.Popen[bytes]) -> None:
    assert sleeper.pid in OrphanSweeper(grace_s=0).sweep()
    assert sleeper.wait(20) < 0


@pytest.mark.parametrize("sleeper", ["dead_owner"], indirect=True)
def test_an_orphan_has_time_to_end_by_itself(sleeper: subprocess.Popen[bytes]) -> None:
    sweeper = OrphanSweeper(grace_s=3600)
    assert sweeper.sweep() == sweeper.sweep() == []
    assert sleeper.poll() is None


@pytest.mark.parametrize("sleeper", [Owner.current, elsewhere, "nonsense", ""], indirect=True)
def test_what_is_not_provably_an_orphan_is_left_alone(sleeper: subprocess.Popen[bytes]) -> None:
    assert sleeper.pid not in OrphanSweeper(grace_s=0).sweep()
    assert sleeper.poll() is None


def test_identity_survives_the_environment() -> None:
    owner = Owner.current()
    assert Owner.parse(str(owner)) == owner
    assert owner.alive()


def test_a_reused_process_id_is_not_the_same_worker() -> None:
    owner = Owner.current()
    assert not Owner(owner.namespace, owner.pid, owner.started - 60).alive()
