"""What a worker does about waiting work, without a database."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from naojobs.models import WorkKind
from naosprint_worker import worker
from naosprint_worker.settings import WorkerSettings


@pytest.mark.parametrize(("min_free_mb", "asked"), [(0, 1), (10**9, 0)])
def test_a_training_makes_no_room_on_a_worker_without_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, min_free_mb: int, asked: int
) -> None:
    """The worker would not claim what waits."""
    settings = WorkerSettings(
        mode="local",
        database_url="postgresql:///none",
        broker_url="redis://none",
        artifact_url="file:///none",
        worker_dir=tmp_path,
        worker_concurrency=1,
        worker_min_free_mb=min_free_mb,
    )
    requests: list[str] = []
    monkeypatch.setattr(worker.leases, "claim_next", lambda *_, **__: None)
    monkeypatch.setattr(worker, "make_room", lambda _, name, *__, **___: requests.append(name))
    loop = worker.WorkLoop(settings)
    monkeypatch.setattr(loop, "_runs", [SimpleNamespace(kind=WorkKind.JOB)])
    loop._look_for_work()
    assert requests == [loop.id] * asked
