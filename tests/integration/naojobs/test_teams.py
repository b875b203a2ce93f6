"""Uploads of teams at the same time."""

from __future__ import annotations

import io
import json
import tarfile
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from naojobs.database import Sessions
from naojobs.errors import QuotaError
from naojobs.quotas import Quota
from naojobs.store import ArtifactStore, ManifestEntry
from naojobs.teams import list_teams, upload_team


def test_uploads_at_the_same_time_stay_within_the_quota(
    sessions: Sessions, store: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of them have found room before the first is stored."""
    text = json.dumps({"command": ["{python}", "player.py"]}).encode()
    buffer, info = io.BytesIO(), tarfile.TarInfo("team.json")
    info.size = len(text)
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        archive.addfile(info, io.BytesIO(text))
    data = buffer.getvalue()
    all_here, put = threading.Barrier(4), store.put_bytes

    def put_bytes(key: str, content: bytes) -> ManifestEntry:
        all_here.wait(30)
        return put(key, content)

    monkeypatch.setattr(store, "put_bytes", put_bytes)

    def upload(number: int) -> str:
        limits = {Quota.BYTES: 2 * len(data) + 100}
        try:
            return upload_team(sessions, store, owner="ann", name=f"t{number}", data=data, limits=limits).name
        except QuotaError as error:
            return str(error)

    with ThreadPoolExecutor(4) as pool:
        ended = list(pool.map(upload, range(4)))
    assert sum("delete jobs, matches or teams" in each for each in ended) == 2, ended
    assert len(list_teams(sessions, "ann", limit=10, after=None)) == 2
