"""Files that appear whole or not at all, and errors of disks that name them."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from naospec.files import drop, named_errors, partial_of, replacing, together, write_whole


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_an_error_of_a_disk_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"No space left on device: '/dev/full'"), named_errors(Path("/dev/full")):
        Path("/dev/full").write_text("x", encoding="utf-8")
    with pytest.raises(ConnectionRefusedError) as other, named_errors(tmp_path):
        raise ConnectionRefusedError(errno.ECONNREFUSED, "refused")
    assert other.value.filename is None


def test_a_file_is_replaced_whole_or_stays(tmp_path: Path) -> None:
    path = tmp_path / "x"
    write_whole(path, "one")
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~mask
    with pytest.raises(KeyError), replacing(path) as file:
        file.write(b"two")
        raise KeyError
    assert path.read_text(encoding="utf-8") == "one"
    write_whole(path, b"\xff", mode=0o600)
    assert path.read_bytes() == b"\xff"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert list(tmp_path.iterdir()) == [path]


def test_files_are_written_together_or_not_at_all(tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    write_whole(first, "before")
    with pytest.raises(KeyError), together():
        write_whole(first, "one")
        write_whole(second, "two")
        raise KeyError
    assert first.read_text(encoding="utf-8") == "before"
    assert list(tmp_path.iterdir()) == [first]
    with together():
        with together():
            write_whole(first, "one")
        assert first.read_text(encoding="utf-8") == "before"
        write_whole(second, "two")
    assert [path.read_text(encoding="utf-8") for path in (first, second)] == ["one", "two"]
    assert sorted(tmp_path.iterdir()) == [first, second]


def test_an_error_at_the_last_moment_leaves_all_files_as_they_were(tmp_path: Path) -> None:
    """One of the names has become that of a folder meanwhile."""
    first, folder = tmp_path / "a", tmp_path / "b"
    write_whole(first, "before")
    with pytest.raises(IsADirectoryError, match=r"Is a directory: .*/b"), together():
        for path in (first, tmp_path / "new", folder):
            write_whole(path, "after")
        folder.mkdir()
    assert first.read_text(encoding="utf-8") == "before"
    assert sorted(tmp_path.iterdir()) == [first, folder]


def test_a_file_that_is_not_written_again_goes_with_those_from_before(tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    for path in (first, second):
        write_whole(path, "before")
    with pytest.raises(KeyError), together():
        write_whole(first, "after")
        drop(second)
        raise KeyError
    assert [path.read_text(encoding="utf-8") for path in (first, second)] == ["before", "before"]
    with together():
        write_whole(first, "after")
        drop(second)
        assert second.exists()
    assert list(tmp_path.iterdir()) == [first]
    with together():
        drop(first)
    drop(first)
    assert list(tmp_path.iterdir()) == []


WRITES = """
import os, signal, sys
from pathlib import Path
from naospec.files import drop, together, write_whole
folder, content, action, left = Path(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4])
def look(event, arguments):
    global left
    if event == "os.rename":
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL) if action == "kill" else (print(flush=True), sys.stdin.readline())
        left -= 1
sys.addaudithook(look)
with together():
    for name in ("a", "b", "c"):
        write_whole(folder / name, content)
    drop(folder / "d")
"""
"""Writes three files in the place of four, and is killed or waits before one of its renames."""


def contents(folder: Path) -> set[str]:
    """Return the different contents of the files that have names of their own."""
    return {path.read_text(encoding="utf-8") for path in folder.iterdir() if not path.name.startswith(".")}


def test_no_kill_leaves_files_of_two_calls_side_by_side(tmp_path: Path) -> None:
    killed = 0
    while True:
        with together():
            for name in ("a", "b", "c", "d"):
                write_whole(tmp_path / name, "before")
        ended = subprocess.run([sys.executable, "-c", WRITES, str(tmp_path), "after", "kill", str(killed)], check=False)
        assert len(contents(tmp_path)) <= 1, f"killed before rename {killed + 1}"
        if ended.returncode == 0:
            break
        killed += 1
    assert killed >= 3
    assert contents(tmp_path) == {"after"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]


def test_two_that_write_the_same_files_at_once_leave_those_of_one(tmp_path: Path) -> None:
    """The first is between two of its renames when the second writes."""
    command = [sys.executable, "-c", WRITES, str(tmp_path)]
    second = [*command, "second", "kill", "99"]
    with subprocess.Popen([*command, "first", "wait", "1"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        assert first.stdin is not None and first.stdout is not None
        first.stdout.readline()
        with subprocess.Popen(second) as other:
            with contextlib.suppress(subprocess.TimeoutExpired):
                other.wait(1.0)  # it waits for the first, or would not and end
            first.communicate(b"\n", timeout=60)
        assert (first.returncode, other.returncode) == (0, 0)
    assert contents(tmp_path) == {"second"}


def test_what_a_process_that_ended_left_is_deleted(tmp_path: Path) -> None:
    """A file and a folder; those of a process that runs, of another host, and of a user stay."""
    code = (
        "import sys; from pathlib import Path; from naospec.files import partial_of\n"
        "partial_of(Path(sys.argv[1])).touch(); folder = partial_of(Path(sys.argv[2])); folder.mkdir()\n"
        "(folder / 'x').touch()"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "a"), str(tmp_path / "step-1")], check=True)
    left = sorted(path.name for path in tmp_path.iterdir())
    assert [name.split(".")[1] for name in left] == ["a", "step-1"]
    number, ticks, place, token = left[0].split(".")[2].split("-")
    elsewhere = tmp_path / f".a.{number}-{ticks}-{int(place, 16) ^ 1:08x}-{token}.partial"
    running = partial_of(tmp_path / "b")
    mine = tmp_path / ".a.partial"
    for path in (elsewhere, running, mine):
        path.touch()
    write_whole(tmp_path / "c", "x")
    assert sorted(tmp_path.iterdir()) == sorted([elsewhere, running, mine, tmp_path / "c"])
