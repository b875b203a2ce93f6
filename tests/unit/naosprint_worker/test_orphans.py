"""Processes of a dead worker are ended, then its files are removed; nothing else is."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from naospec.processes import ProcessIdentity
from naosprint_worker.orphans import OWNER_FILE, OWNER_VARIABLE, OrphanSweeper, child_marks, touch_owner

FOLDER = Path("/work of this test")


def dead_owner() -> ProcessIdentity:
    """Return the identity of a process that has ended."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        identity = ProcessIdentity.of(process.pid)
        process.communicate(b"\n")
    assert identity is not None
    return identity


def elsewhere() -> ProcessIdentity:
    """Return an owner in another process-id namespace, which cannot be checked here."""
    return replace(dead_owner(), place="host pid:[1]")


def own_number() -> ProcessIdentity:
    """Return another process that had this one's number."""
    return replace(ProcessIdentity.current(), ticks=1)


def over(_attempt: Path) -> bool:
    return True


@pytest.fixture
def sleeper(request: pytest.FixtureRequest) -> Iterator[subprocess.Popen[bytes]]:
    """A process whose environment contains the owner given as parameter, and the folder of the service."""
    owner, folder = request.param
    process = subprocess.Popen(
        [sys.executable, "-c", "print(flush=True); import time; time.sleep(600)"],
        env={**os.environ, **child_marks(folder), OWNER_VARIABLE: owner if isinstance(owner, str) else str(owner())},
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    process.stdout.readline()
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


@pytest.mark.parametrize("sleeper", [(dead_owner, FOLDER)], indirect=True)
def test_child_of_a_dead_worker_is_ended(sleeper: subprocess.Popen[bytes]) -> None:
    assert sleeper.pid in OrphanSweeper(FOLDER, over, grace_s=0).sweep()
    assert sleeper.wait(20) < 0


@pytest.mark.parametrize("sleeper", [(dead_owner, FOLDER)], indirect=True)
def test_an_orphan_has_time_to_end_by_itself(sleeper: subprocess.Popen[bytes]) -> None:
    sweeper = OrphanSweeper(FOLDER, over, grace_s=3600)
    assert sweeper.sweep() == sweeper.sweep() == []
    assert sleeper.poll() is None


@pytest.mark.parametrize(
    "sleeper",
    [
        (ProcessIdentity.current, FOLDER),
        (own_number, FOLDER),
        (elsewhere, FOLDER),
        ("nonsense", FOLDER),
        ("", FOLDER),
        (dead_owner, Path("/work of another service")),
    ],
    indirect=True,
)
def test_what_is_not_provably_an_orphan_is_left_alone(sleeper: subprocess.Popen[bytes]) -> None:
    assert sleeper.pid not in OrphanSweeper(FOLDER, over, grace_s=0).sweep()
    assert sleeper.poll() is None


@pytest.mark.parametrize(
    ("owner", "stays"),
    [(str(ProcessIdentity.current()), True), (str(dead_owner()), False), ("", False), ("\xff", False)],
    ids=["alive", "gone", "emptied", "damaged"],
)
def test_the_working_folders_of_workers_that_are_gone_are_removed(tmp_path: Path, owner: str, stays: bool) -> None:
    """A power cut may have emptied or damaged the name of the owner."""
    folder = tmp_path / "host-1-2"
    folder.mkdir()
    (folder / OWNER_FILE).write_text(owner, encoding="latin-1")
    (folder / "checkpoint.npz").write_bytes(b"weights")
    OrphanSweeper(tmp_path, over, grace_s=0).sweep()
    assert folder.exists() is stays


def test_the_working_folder_of_a_worker_elsewhere_is_removed_once_nothing_in_it_is_touched(tmp_path: Path) -> None:
    """Its container was made again on the same volume. Another that lives touches its files."""
    attempt = tmp_path / "host-1-2" / "job_x-1"
    attempt.mkdir(parents=True)
    (attempt.parent / OWNER_FILE).write_text(str(elsewhere()), encoding="utf-8")
    patient, sweeper = OrphanSweeper(tmp_path, over, grace_s=0), OrphanSweeper(tmp_path, over, grace_s=0, untouched_s=0)
    for seconds, path in ((9, attempt.parent / OWNER_FILE), (7, attempt / "progress"), (5, attempt / "progress")):
        path.touch()
        os.utime(path, (seconds, seconds))  # by a clock that is set back
        for each in (patient, sweeper):
            each.sweep()
        assert attempt.exists()
    patient.sweep()
    assert attempt.exists()
    sweeper.sweep()
    assert not attempt.parent.exists()


def test_a_worker_marks_its_folder_again_that_another_has_removed(tmp_path: Path) -> None:
    """It was suspended for long: without its mark, what it leaves there when it dies would stay for ever."""
    own = tmp_path / "host-1-2" / OWNER_FILE
    touch_owner(own.parent)
    os.utime(own, (0, 0))
    touch_owner(own.parent)
    assert own.stat().st_mtime > 0
    shutil.rmtree(own.parent)
    touch_owner(own.parent)
    assert own.read_text(encoding="utf-8") == str(ProcessIdentity.current())


@pytest.mark.parametrize("owner", [dead_owner, elsewhere])
def test_the_working_folder_of_a_worker_stays_until_all_its_attempts_are_over(
    tmp_path: Path, owner: Callable[[], ProcessIdentity]
) -> None:
    attempts = [tmp_path / "host-1-2" / name for name in ("job_x-1", "job_y-1")]
    for attempt in attempts:
        attempt.mkdir(parents=True)
    (tmp_path / "host-1-2" / OWNER_FILE).write_text(str(owner()), encoding="utf-8")
    held = set(attempts)
    sweeper = OrphanSweeper(tmp_path, lambda attempt: attempt not in held, grace_s=0, untouched_s=0)
    for attempt in attempts:
        for _ in range(2):
            sweeper.sweep()
        assert all(each.exists() for each in attempts)
        held.remove(attempt)
    sweeper.sweep()
    assert not attempts[0].parent.exists()


def test_the_working_folder_of_a_dead_worker_stays_as_long_as_its_orphans(tmp_path: Path) -> None:
    """A training saves its last checkpoint there, and files that it writes after the removal would stay for ever."""
    folder, owner = tmp_path / "host-1-2", str(dead_owner())
    folder.mkdir()
    (folder / OWNER_FILE).write_text(owner, encoding="utf-8")
    environment = {**os.environ, **child_marks(tmp_path), OWNER_VARIABLE: owner}
    command = [sys.executable, "-c", "print(flush=True); input()"]
    with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as orphan:
        assert orphan.stdout is not None
        orphan.stdout.readline()
        sweeper = OrphanSweeper(tmp_path, over, grace_s=3600)
        assert sweeper.sweep() == []
        assert folder.exists()
        orphan.communicate(b"\n")
    sweeper.sweep()
    assert not folder.exists()
