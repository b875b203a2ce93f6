"""Order in which compose stops containers, and that one command stops them all."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from naosprint_worker.settings import WorkerSettings

ROOT = Path(__file__).parents[3]
SERVICE, WORKERS = ROOT / "docker-compose.yml", ROOT / "deploy" / "worker" / "docker-compose.yml"


def services(file: Path) -> dict[str, Any]:
    return dict(yaml.safe_load(file.read_text(encoding="utf-8"))["services"])


def is_worker(service: dict[str, Any]) -> bool:
    return "NAOSPRINT_WORKER_QUEUES" in service.get("environment", {})


def needs(file: Path, name: str) -> set[str]:
    """Return what a service depends on: all of it is stopped after the service."""
    direct = set(services(file)[name].get("depends_on", {}))
    return direct.union(*(needs(file, each) for each in direct))


@pytest.mark.parametrize("name", ["api", *(name for name, each in services(SERVICE).items() if is_worker(each))])
def test_database_broker_and_store_stop_after_those_who_write_to_them(name: str) -> None:
    assert {"postgres", "broker", "store"} <= needs(SERVICE, name)


def all_workers() -> Iterator[tuple[Path, str]]:
    return ((file, name) for file in (SERVICE, WORKERS) for name, each in services(file).items() if is_worker(each))


@pytest.mark.parametrize(("file", "name"), list(all_workers()), ids=lambda part: getattr(part, "name", part))
def test_workers_have_time_for_their_last_checkpoints(file: Path, name: str) -> None:
    """After the grace period of its trainings a worker settles their jobs, which may take ten seconds more."""
    seconds = re.fullmatch(r"(\d+)s", services(file)[name]["stop_grace_period"])
    assert seconds is not None
    assert int(seconds[1]) >= WorkerSettings.model_fields["worker_stop_grace_s"].default + 20


def test_profiles_are_chosen_by_a_setting_so_that_down_stops_them() -> None:
    """With --profile they would have to be named again; `docker compose down` would leave trainings behind."""
    profiles = {profile for each in services(SERVICE).values() for profile in each.get("profiles", ())}
    example = (ROOT / ".env.example").read_text(encoding="utf-8")
    assert all(profile in example for profile in profiles)
    for page in [*ROOT.glob("docs/**/*.md"), SERVICE, WORKERS, ROOT / "README.md"]:
        named = re.findall(r"--profile[ =](\S+)", page.read_text(encoding="utf-8"))
        assert set(named) <= {"'*'"}, page
