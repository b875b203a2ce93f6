"""What the files for compose promise: the order in which containers stop, who reaches whom, who connects as whom."""

from __future__ import annotations

import os
import re
import subprocess
import sys
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


def test_postgres_refuses_the_superuser_except_on_sockets() -> None:
    lines = [line.split() for line in ACCESS.read_text(encoding="utf-8").splitlines() if line and line[0] != "#"]
    sockets, remote = ([line for line in lines if (line[0] == "local") is local] for local in (True, False))
    assert sockets == [["local", "all", "all", "trust"]]
    (line,) = remote
    roles = sorted(role for role in Role if role is not Role.BACKUP)
    assert [line[0], line[1], sorted(line[2].split(",")), *line[3:]] == [
        "host",
        "naosprint",
        roles,
        "all",
        "scram-sha-256",
    ]


def test_the_superuser_s_socket_is_shared_with_one_service() -> None:
    here, opened = services(SERVICE), services(HOSTS)
    sharing = [
        name
        for each in (here, opened)
        for name, one in each.items()
        if any("superuser:" in volume for volume in one.get("volumes", ()))
    ]
    assert sharing == ["postgres", "roles"]
    url = urlsplit(here["roles"]["environment"]["NAOSPRINT_DATABASE_URL"])
    assert url.hostname is None and url.query == "host=/run/superuser"
    # nothing else connects as the superuser, and nothing that connects asks for a connection in the clear
    for name, each in here.items():
        environment = each.get("environment", {}) | opened.get(name, {}).get("environment", {})
        text = " ".join(map(str, environment.values()))
        assert ("postgresql://naosprint:" in text) == (name == "roles"), name
        assert "sslmode=disable" not in text, name


@pytest.mark.parametrize("certificate", [False, True])
def test_postgres_is_started_with_its_list_of_who_may_connect(certificate: bool, tmp_path: Path) -> None:
    """The script itself, below another root and with programs that print what they are given."""
    script = (ROOT / "deploy" / "postgres" / "start").read_text(encoding="utf-8")
    for folder in ("etc/naosprint", "run", "certificates", "tmp", "bin"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "etc/naosprint/pg_hba.conf").write_text(ACCESS.read_text(encoding="utf-8"), encoding="utf-8")
    for name in ("install", "docker-entrypoint.sh"):
        (tmp_path / "bin" / name).write_text(f'#!/bin/sh\necho {name} "$@"\n', encoding="utf-8")
        (tmp_path / "bin" / name).chmod(0o755)
    if certificate:
        (tmp_path / "certificates" / "server.crt").touch()
    local = re.sub(r"(?<=[ =>\"])/(?=etc|run|tmp|certificates)", f"{tmp_path}/", script)
    environment = {"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["sh", "-c", local, "start", "postgres", "-c", "x=1"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=20,
        check=True,
    )
    started = done.stdout.splitlines()[-1]
    assert started.startswith("docker-entrypoint.sh postgres -c x=1 ")
    assert "unix_socket_directories=/var/run/postgresql,/run/superuser" in started
    (used,) = re.findall(r"hba_file=(\S+)", started)
    kinds = {line.split()[0] for line in Path(used).read_text(encoding="utf-8").splitlines() if line[:1].isalpha()}
    assert kinds == ({"local", "hostssl"} if certificate else {"local", "host"})
    assert ("ssl=on" in started) is certificate


def networks(name: str) -> set[str]:
    """Return the networks of a service, with and without the file for several hosts."""
    return {one for file in (SERVICE, HOSTS) for one in services(file).get(name, {}).get("networks", ())}


def test_ports_of_the_store_that_need_no_key_are_reached_by_its_proxy_alone() -> None:
    (own,) = networks("seaweedfs")
    assert {name for name in services(SERVICE) | services(HOSTS) if own in networks(name)} == {"seaweedfs", "store"}
    assert not services(SERVICE)["seaweedfs"].get("ports") and "seaweedfs" not in services(HOSTS)
    passed_on: set[str] = set()
    for file in (ROOT / "deploy" / "proxy").glob("store*.Caddyfile"):
        passed_on.update(re.findall(r"reverse_proxy (\S+)$", file.read_text(encoding="utf-8"), re.MULTILINE))
    assert passed_on == {"seaweedfs:8333", "seaweedfs:9327"}  # S3 and metrics


@pytest.mark.parametrize("file", [SERVICE, WORKERS, HOSTS], ids=lambda file: file.name)
def test_internal_networks_do_not_reach_the_host(file: Path) -> None:
    found = yaml.safe_load(file.read_text(encoding="utf-8"))["networks"]
    for name, network in found.items():
        if network and network.get("internal"):
            assert network["driver_opts"] == {"com.docker.network.bridge.inhibit_ipv4": "true"}, name


@pytest.mark.parametrize("name", [name for name in services(SERVICE) if name.endswith("-exporter")])
def test_exporters_have_no_way_out(name: str) -> None:
    networks = yaml.safe_load(SERVICE.read_text(encoding="utf-8"))["networks"]
    joined = services(SERVICE)[name]["networks"]
    assert all((networks[one] or {}).get("internal") for one in joined)
    assert set(joined) & set(services(SERVICE)["prometheus"]["networks"]), "Prometheus reaches it"


STUB = """#!/bin/sh
case "$*" in
  *"token verify") grep -qx valid ;;
  *"token create"*) printf '{"id": "token_1", "token": "new"}' ;;
  *) exec "$REAL" "$@" ;;
esac
"""
"""A program `python` whose database knows one token, `valid`."""


@pytest.mark.parametrize(("before", "after"), [(None, "new"), ("", "new"), ("valid", "valid"), ("other", "new")])
def test_prometheus_gets_a_token_again_where_a_restored_database_lacks_its_own(
    before: str | None, after: str, tmp_path: Path
) -> None:
    shell, options, script = services(SERVICE)["prometheus-token"]["command"]
    (tmp_path / "python").write_text(STUB, encoding="utf-8")
    (tmp_path / "python").chmod(0o755)
    folder = tmp_path / "volume"
    folder.mkdir()
    if before is not None:
        (folder / "token").write_text(before, encoding="utf-8")
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "REAL": sys.executable}
    command = [shell, options, script.replace("/var/lib/naosprint", str(folder))]
    subprocess.run(command, env=environment, check=True, timeout=20)
    assert {path.name: path.read_text(encoding="utf-8") for path in folder.iterdir()} == {"token": after}
