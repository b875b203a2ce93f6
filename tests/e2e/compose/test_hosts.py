"""A worker that joins from another host: another compose project, which shares no network with the service."""

from __future__ import annotations

import dataclasses
import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[3]
SMALL = (
    *("--n-envs", "8", "--n-steps", "64", "--batch-size", "128", "--no-evaluate"),
    *("--simulator-threads", "1", "--learner-threads", "1"),
)


@pytest.fixture(scope="module")
def remote(project: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Open the service's three ports to other hosts and start a worker with only these settings."""
    inspected = subprocess.run(["docker", "network", "inspect", "bridge"], capture_output=True, check=True, timeout=60)
    address = json.loads(inspected.stdout)[0]["IPAM"]["Config"][0]["Gateway"]
    subprocess.run([ROOT / "deploy" / "new-certificates", address], check=True, timeout=60)
    secrets = dict(line.split("=", 1) for line in project.settings.read_text().splitlines() if line[:1].isupper())
    opened = dataclasses.replace(
        project,
        files=(project.files[0], ROOT / "deploy" / "hosts.yml", *project.files[1:]),
        environment={
            **project.environment,
            **{"HOSTS_BIND": address, "POSTGRES_PORT": "0", "BROKER_PORT": "0", "STORE_PORT": "0"},
        },
    )
    opened.compose("up", "--detach", "--no-build", "--wait", "postgres", "broker", "store", "api", "worker")
    postgres, broker, store = (
        opened.compose("port", service, port).stdout.strip()
        for service, port in (("postgres", "5432"), ("broker", "6380"), ("store", "8334"))
    )
    settings = tmp_path_factory.mktemp("hosts") / "worker.env"
    settings.write_text(
        f"DATABASE_URL=postgresql://naosprint_worker:{secrets['POSTGRES_WORKER_PASSWORD']}@{postgres}/naosprint"
        "?sslmode=verify-full&sslrootcert=/certificates/ca.crt\n"
        f"BROKER_URL=rediss://worker:{secrets['BROKER_WORKER_PASSWORD']}@{broker}/0?ssl_ca_certs=/certificates/ca.crt\n"
        f"S3_ENDPOINT=https://{store}\n"
        f"S3_ACCESS_KEY_ID={secrets['S3_ACCESS_KEY_ID']}\n"
        f"S3_SECRET_ACCESS_KEY={secrets['S3_SECRET_ACCESS_KEY']}\n"
        "WORKER_CPUS=1\n"
    )
    files = (ROOT / "deploy" / "worker" / "docker-compose.yml",)
    other = dataclasses.replace(project, name=f"{project.name}-other", files=files, settings=settings)
    try:
        other.compose("up", "--detach", "--no-build", "--wait")
        yield other
    finally:
        other.compose("down", "--volumes", "--timeout", "60", check=False)
        project.compose("up", "--detach", "--no-build", "--wait", "postgres", "broker", "store", "api", "worker")
        hosts = ["docker", "network", "rm", f"{project.name}_hosts"]
        subprocess.run(hosts, check=True, capture_output=True, timeout=60)
    assert not other.owned("container")


def test_a_job_moves_to_the_worker_of_another_host(
    project: Any, remote: Any, naoctl: Callable[..., Any], wait_for: Callable[..., Any]
) -> None:
    here, there = (one.container("worker")["Config"]["Hostname"] for one in (project, remote))

    def only_these_two() -> bool:
        # A worker that was replaced during an outage of the database is removed when its heartbeats are missed.
        return {worker["host"] for worker in naoctl("workers", "--json") if worker["alive"]} == {here, there}

    wait_for(only_these_two, 60, "the two workers were not the only ones")

    long = (*SMALL, "--steps", "120000", "--checkpoint-interval-steps", "10240")
    jobs = [naoctl("submit", *long, "--seed", str(seed), "--json")["id"] for seed in (1, 2)]

    def holders() -> dict[str, str] | None:
        found = {job: naoctl("status", job, "--json")["worker"] for job in jobs}
        return {job: worker.split(":")[0] for job, worker in found.items()} if all(found.values()) else None

    holding = wait_for(holders, 60, "the two workers did not take a job each")
    assert sorted(holding.values()) == sorted((here, there))

    # The local worker ends; its training resumes on the other one.
    project.compose("stop", "worker")
    for job in jobs:
        naoctl("watch", job, timeout_s=600)
    states = {job: naoctl("status", job, "--json") for job in jobs}
    assert {state["state"] for state in states.values()} == {"succeeded"}
    moved = next(job for job in jobs if holding[job] == here)
    assert states[moved]["attempt"] == 2 and states[moved]["failures"] == 0
