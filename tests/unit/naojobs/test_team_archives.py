"""Archives of teams: what is checked is what a match unpacks."""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path

import pytest
from naojobs.errors import InvalidError
from naojobs.teams import TeamArchive

TEAM = json.dumps({"command": ["{python}", "player.py"]})
READING = json.dumps({"command": ["{python}", "player.py"], "reads": ["/home"]})


def packed(*files: tuple[str, str], sparse: bool = False, **headers: str) -> bytes:
    """Return an archive of named files, in their order, and of one more whose extended header has these fields."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name, text in files:
            info = tarfile.TarInfo(name)
            info.size = len(text)
            archive.addfile(info, io.BytesIO(text.encode()))
        if sparse:
            headers = {"GNU.sparse.map": "0,0", "GNU.sparse.size": str(1 << 40)}
        if headers:
            info = tarfile.TarInfo("weights")
            info.pax_headers = headers
            archive.addfile(info)
    return buffer.getvalue()


@pytest.mark.parametrize("name", ["team.json", "./team.json", ".//team.json", "././team.json"])
def test_a_path_is_in_an_archive_once_however_it_is_written(name: str) -> None:
    assert TeamArchive(packed((name, TEAM), ("parts/legs.py", ""))).command.reads == ()
    for first, second in (("team.json", name), (name, "./team.json")):
        with pytest.raises(InvalidError, match=r"'team\.json': is in the archive twice; pack it once"):
            TeamArchive(packed((first, TEAM), (second, READING)))
    with pytest.raises(InvalidError, match=r"'parts/legs\.py': is in the archive twice"):
        TeamArchive(packed((name, TEAM), ("parts/legs.py", ""), ("parts/./legs.py", "")))


@pytest.mark.parametrize("length", [1024, 1024 + 200])
@pytest.mark.parametrize("after", [b"", b"x" * 512])
def test_an_archive_that_is_cut_before_or_in_a_header_is_refused(length: int, after: bytes) -> None:
    data = packed(("team.json", TEAM), ("player.py", ""))
    with pytest.raises(InvalidError, match="cut off or damaged"):
        TeamArchive(data[:length] + after)
    assert TeamArchive(data[: 3 * 512 + 512]).command.command == ("{python}", "player.py")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (packed(("team.json", "[" * 90_000)), r"team\.json: too deeply nested"),
        (packed(("team.json", TEAM + " " * 100_000)), r"team\.json: at most 100,000 bytes"),
        (packed(("team.json", TEAM), sparse=True), "'weights': pack only files and folders"),
    ],
)
def test_an_archive_that_costs_more_than_its_size_is_refused(data: bytes, message: str) -> None:
    with pytest.raises(InvalidError, match=message):
        TeamArchive(data)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (packed(("team.json", TEAM), ("a" * 256, "")), "or is too long; rename it"),
        (packed(("team.json", TEAM), ("é" * 128, "")), "or is too long; rename it"),
        (packed(("team.json", TEAM), ("folder/" * 200 + "a", "")), "or is too long; rename it"),
        (packed(("team.json", TEAM), path="a\0b"), "is not a valid file name"),
        (packed(("team.json", TEAM), (".", "text")), "pack only files and folders"),
        (packed(("team.json", TEAM), size="-1"), "pack only files and folders"),
        (packed(("team.json", TEAM), ("a", ""), ("a/b/c", "")), "'a/b/c': is below a file"),
        (packed(("a/b", ""), ("team.json", TEAM), ("a", "")), "'a/b': is below a file"),
        (packed(("team.json", TEAM), ("team.json/b", "")), r"'team\.json/b': is below a file"),
        *(
            (packed(("team.json", TEAM), mtime=time), "'weights': has no valid modification time")
            for time in ("nan", "1e999", "-1e30")
        ),
    ],
)
def test_what_cannot_be_unpacked_is_refused(data: bytes, message: str) -> None:
    with pytest.raises(InvalidError, match=message):
        TeamArchive(data)


def test_what_is_accepted_can_be_unpacked(tmp_path: Path) -> None:
    files = (("team.json", TEAM), ("a" * 255, ""), ("/".join(["b" * 200] * 4), ""), ("tab\tand\nline", ""))
    data = TeamArchive(packed(*files, mtime="1e9")).data
    with tarfile.open(fileobj=io.BytesIO(data)) as archive:
        archive.extractall(tmp_path, filter="data")
    assert all((tmp_path / name).is_file() for name, _ in files)
