"""Settings are read from the environment, and invalid ones are refused."""

from __future__ import annotations

from typing import Any

import pytest
from naojobs.retention import Retention
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
    got = settings(monkeypatch, NAOSPRINT_WORKER_QUEUES="embedded, server,embedded")
    assert got.worker_queues == ("embedded", "server")


@pytest.mark.parametrize(("queues", "message"), [("embeded", "unknown queue 'embeded'"), (" , ", "no queue given")])
def test_wrong_queues_are_named(monkeypatch: pytest.MonkeyPatch, queues: str, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        settings(monkeypatch, NAOSPRINT_WORKER_QUEUES=queues)


def test_orphans_must_end_before_the_lease_does(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValidationError, match="worker_orphan_grace_s"):
        settings(monkeypatch, NAOSPRINT_WORKER_ORPHAN_GRACE_S="30")


def test_which_checkpoints_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    assert settings(monkeypatch).retention == Retention(20)
    assert settings(monkeypatch, NAOSPRINT_WORKER_KEEP_LAST="0").retention is None
    got = settings(monkeypatch, NAOSPRINT_WORKER_KEEP_LAST="3", NAOSPRINT_WORKER_KEEP_EVERY="10")
    assert got.retention == Retention(3, every=10)


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"NAOSPRINT_WORKER_KEEP_LAST": "1"}, "worker_keep_last"),
        ({"NAOSPRINT_WORKER_KEEP_LAST": "0", "NAOSPRINT_WORKER_KEEP_EVERY": "5"}, "worker_keep_every"),
    ],
)
def test_keeping_too_few_checkpoints_is_refused(
    monkeypatch: pytest.MonkeyPatch, values: dict[str, str], field: str
) -> None:
    with pytest.raises(ValidationError, match=field):
        settings(monkeypatch, **values)


def test_a_film_that_cannot_be_made_is_refused_when_the_worker_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("naosprint_worker.settings.find_spec", lambda name: None)
    with pytest.raises(ValidationError, match=r"worker_report: film needs imageio-ffmpeg.*naosprint\[film\]"):
        settings(monkeypatch, NAOSPRINT_WORKER_REPORT="film")
    assert settings(monkeypatch, NAOSPRINT_WORKER_REPORT="pictures").worker_report == "pictures"
