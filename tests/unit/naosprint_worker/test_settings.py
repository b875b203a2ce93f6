"""Settings come from the environment and refuse what cannot work."""

from __future__ import annotations

from typing import Any

import pytest
from naosprint_worker.settings import WorkerSettings
from pydantic import ValidationError

REQUIRED = {
    "NAOSPRINT_MODE": "local",
    "NAOSPRINT_DATABASE_URL": "postgresql://localhost/naosprint",
    "NAOSPRINT_BROKER_URL": "redis://localhost:6379/0",
    "NAOSPRINT_ARTIFACT_URL": "file:///tmp/artifacts",
}


def settings(monkeypatch: pytest.MonkeyPatch, **values: str) -> WorkerSettings:
    """Build the settings from an environment of ``values`` and what is required."""
    for name, value in {**REQUIRED, **values}.items():
        monkeypatch.setenv(name, value)
    arguments: dict[str, Any] = {}
    return WorkerSettings(**arguments)


def test_queues_are_a_comma_separated_list(monkeypatch: pytest.MonkeyPatch) -> None:
    got = settings(monkeypatch, NAOSPRINT_WORKER_QUEUES="embedded, rcssserver3d,embedded")
    assert got.worker_queues == ("embedded", "rcssserver3d")


@pytest.mark.parametrize(("queues", "message"), [("embeded", "unknown queue 'embeded'"), (" , ", "no queue given")])
def test_wrong_queues_are_named(monkeypatch: pytest.MonkeyPatch, queues: str, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        settings(monkeypatch, NAOSPRINT_WORKER_QUEUES=queues)


def test_orphans_must_end_before_the_lease_does(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValidationError, match="worker_orphan_grace_s"):
        settings(monkeypatch, NAOSPRINT_WORKER_ORPHAN_GRACE_S="30")
