"""A job survives the move to a new database and a new store."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

SMALL = (
    *("--n-envs", "8", "--n-steps", "64", "--batch-size", "128", "--steps", "1024", "--no-evaluate"),
    *("--simulator-threads", "1", "--learner-threads", "1"),
)


def test_a_job_survives_the_loss_of_database_and_store(
    project: Any, naoctl: Callable[..., Any], tmp_path: Path
) -> None:
    job = naoctl("submit", *SMALL, "--json")["id"]
    naoctl("watch", job, timeout_s=300)
    before = naoctl("status", job, "--json")
    naoctl("download", job, "--output", str(tmp_path / "before"))

    project.script("backup", tmp_path / "backup")
    refused = project.script("restore", tmp_path / "backup", check=False)
    assert refused.returncode == 1 and "in use already" in refused.stderr
    assert naoctl("status", job, "--json") == before

    project.compose("down", "--volumes", "--timeout", "20")
    project.script("restore", tmp_path / "backup")
    # The token is from before, too: its hash was in the database.
    assert naoctl("status", job, "--json") == before
    naoctl("download", job, "--output", str(tmp_path / "after"))
    assert files(tmp_path / "after") == files(tmp_path / "before")
    # The service continues from there.
    more = naoctl("submit", *SMALL, "--from", job, "--json")["id"]
    naoctl("watch", more, timeout_s=300)


def test_a_damaged_archive_is_refused(project: Any, naoctl: Callable[..., Any], tmp_path: Path) -> None:
    naoctl("watch", naoctl("submit", *SMALL, "--json")["id"], timeout_s=300)
    project.script("backup", tmp_path)
    archive = tmp_path / "artifacts.tar"
    data = bytearray(archive.read_bytes())
    manifest = data.index(b'"sha256":"') + 10
    data[manifest : manifest + 4] = b"0000" if data[manifest : manifest + 4] != b"0000" else b"1111"
    with (tmp_path / "damaged.tar").open("wb") as file:
        file.write(data)
    with (tmp_path / "damaged.tar").open("rb") as file:
        answer = subprocess.run(
            [*project.command, "exec", "-T", "api", "python", "-m", "naojobs", "artifacts", "import"],
            env=project.environment,
            stdin=file,
            capture_output=True,
            text=True,
            timeout=120,
        )
    assert answer.returncode == 1
    assert "do not match their manifests" in answer.stderr


def files(folder: Path) -> dict[str, Any]:
    """Return the content of every file below a folder, JSON decoded."""
    return {
        path.relative_to(folder).as_posix(): json.loads(path.read_bytes())
        if path.suffix == ".json"
        else path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }
