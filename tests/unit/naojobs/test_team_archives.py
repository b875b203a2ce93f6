"""Archives of teams: what is checked is what a match unpacks."""

from __future__ import annotations

import io
import json
import tarfile

import pytest
from naojobs.errors import InvalidError
from naojobs.teams import TeamArchive

TEAM = json.dumps({"command": ["{python}", "player.py"]})
READING = json.dumps({"command": ["{python}", "player.py"], "reads": ["/home"]})


def packed(*files: tuple[str, str], sparse: bool = False) -> bytes:
    """Return an archive of named files, in their order."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name, text in files:
            info = tarfile.TarInfo(name)
            info.size = len(text)
            archive.addfile(info, io.BytesIO(text.encode()))
        if sparse:
            info = tarfile.TarInfo("weights")
            info.pax_headers = {"GNU.sparse.map": "0,0", "GNU.sparse.size": str(1 << 40)}
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
