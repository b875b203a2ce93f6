"""What the files for compose promise: the order in which containers stop, who reaches whom, who connects as whom."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import yaml
from naojobs.roles import Role
from naosprint_worker.settings import WorkerSettings

ROOT = Path(__file__).parents[3]
SERVICE, WORKERS = ROOT / "docker-compose.yml", ROOT / "deploy" / "worker" / "docker-compose.yml"
HOSTS, ACCESS = ROOT / "deploy" / "hosts.yml", ROOT / "deploy" / "postgres" / "pg_hba.conf"


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


def test_on_shared_hosts_postgres_refuses_the_superuser_and_connections_in_the_clear() -> None:
    lines = [line.split() for line in ACCESS.read_text(encoding="utf-8").splitlines() if line and line[0] != "#"]
    sockets, remote = ([line for line in lines if (line[0] == "local") is local] for local in (True, False))
    assert sockets == [["local", "all", "all", "trust"]]
    (line,) = remote
    roles = sorted(role for role in Role if role is not Role.BACKUP)
    assert [line[0], line[1], sorted(line[2].split(",")), *line[3:]] == [
        "hostssl",
        "naosprint",
        roles,
        "all",
        "scram-sha-256",
    ]


def test_on_shared_hosts_the_superuser_s_socket_is_shared_with_one_service() -> None:
    opened = services(HOSTS)
    server, settings = opened["postgres"], opened["roles"]["environment"]
    sharing = {name for name, each in opened.items() if any("superuser:" in one for one in each.get("volumes", ()))}
    assert sharing == {"postgres", "roles"}
    assert "./deploy/postgres:/etc/naosprint:ro" in server["volumes"]
    start = server["entrypoint"][-2]
    assert f"hba_file=/etc/naosprint/{ACCESS.name}" in start and "ssl=on" in start
    url = urlsplit(settings["NAOSPRINT_DATABASE_URL"])
    assert url.hostname is None and url.query == "host=/run/superuser"
    assert "unix_socket_directories=/var/run/postgresql,/run/superuser" in start
    # nothing else connects as the superuser, and nothing that connects asks for a connection in the clear
    for name, each in services(SERVICE).items():
        environment = each.get("environment", {}) | opened.get(name, {}).get("environment", {})
        text = " ".join(map(str, environment.values()))
        assert ("postgresql://naosprint:" in text) == (name == "roles"), name
        assert "sslmode=disable" not in text, name


@pytest.mark.parametrize("name", [name for name in services(SERVICE) if name.endswith("-exporter")])
def test_exporters_have_no_way_out(name: str) -> None:
    networks = yaml.safe_load(SERVICE.read_text(encoding="utf-8"))["networks"]
    joined = services(SERVICE)[name]["networks"]
    assert all((networks[one] or {}).get("internal") for one in joined)
    assert set(joined) & set(services(SERVICE)["prometheus"]["networks"]), "Prometheus reaches it"
