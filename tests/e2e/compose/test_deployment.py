"""The service of `docker compose up` trains, keeps results and refuses unauthorized access."""

from __future__ import annotations

import hashlib
import ipaddress
import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from .conftest import REACH, ROOT, listening, run

Naoctl = Callable[..., Any]

SMALL = (
    *("--n-envs", "8", "--n-steps", "64", "--batch-size", "128"),
    *("--simulator-threads", "1", "--learner-threads", "1"),
)
"""Rollouts of 512 steps on one processor."""
EVAL = (
    "--eval-episodes",
    "4",
    "--eval-n-envs",
    "4",
    "--eval-trajectories",
    "2",
    "--eval-bootstrap-resamples",
    "100",
)
LONG = ("--no-evaluate", "--checkpoint-interval-steps", "10240")

DIGEST = (
    "import hashlib, sys; from naojobs.settings import ServiceSettings; from naojobs.store import ArtifactStore; "
    "print(hashlib.sha256(ArtifactStore.from_settings(ServiceSettings()).get_bytes(sys.argv[1])).hexdigest())"
)
"""Script that prints the SHA-256 of an artifact, given its key."""

KNOCK = """
import os, sys, urllib.error, urllib.request
try:
    urllib.request.urlopen(os.environ["NAOSPRINT_S3_ENDPOINT"] + "/naosprint?list-type=2", timeout=10)
except urllib.error.HTTPError as error:
    sys.exit(None if error.code in (400, 401, 403) else f"the store answers {error.code}")
sys.exit("the store is open to all")
"""
"""Exits with 0 if the store refuses to list its bucket without keys."""


def reached(project: Any, service: str, addresses: list[str]) -> set[str]:
    """Return which of the addresses a service's container can connect to."""
    answer = project.compose("exec", "-T", service, "python", "-c", REACH, *addresses)
    return set(answer.stdout.split())


def test_everything_is_healthy_and_roles_and_migrations_have_ended(project: Any) -> None:
    states = {one["Config"]["Labels"]["com.docker.compose.service"]: one["State"] for one in project.containers()}
    assert [states.pop(name)["ExitCode"] for name in ("roles", "migrate")] == [0, 0]
    assert set(states) == {"postgres", "broker", "seaweedfs", "store", "api", "worker"}
    assert {name: state["Health"]["Status"] for name, state in states.items()} == dict.fromkeys(states, "healthy")
    ready = httpx.get(f"{project.url}/readyz", timeout=20).json()
    assert ready == {"ready": True, "database": "ok", "schema_revision": "ok", "store": "ok", "broker": "ok"}


def test_a_job_trains_and_its_files_lie_in_the_store(project: Any, naoctl: Naoctl, tmp_path: Path) -> None:
    job = naoctl("submit", *SMALL, *EVAL, "--steps", "2048", "--checkpoint-interval-steps", "512", "--json")
    naoctl("watch", job["id"], timeout_s=400)  # its exit status is the job's result
    done = naoctl("status", job["id"], "--json")
    assert done["state"] == "succeeded"
    assert done["progress_step"] == done["total_steps"] == 2048

    naoctl("download", job["id"], "--output", str(tmp_path))
    folder = tmp_path / "checkpoint-000000002048"
    manifest = json.loads((folder / "checkpoint.json").read_text(encoding="utf-8"))
    assert manifest["spec"]["total_steps"] == 2048
    assert any((tmp_path / "evaluation").iterdir())

    # Downloads match the store, which does not change when containers end.
    keys = project.artifacts(f"jobs/{job['id']}/checkpoints")
    prefix = next(key for key in keys if "/000000002048-" in key).rsplit("/", 1)[0]
    assert {f"{prefix}/{path.name}" for path in folder.iterdir()} <= set(keys)
    stored = project.compose("exec", "-T", "worker", "python", "-c", DIGEST, f"{prefix}/checkpoint.json").stdout
    assert stored.strip() == hashlib.sha256((folder / "checkpoint.json").read_bytes()).hexdigest()


def test_a_job_outlives_the_kill_of_worker_and_broker(project: Any, naoctl: Naoctl, wait_for: Naoctl) -> None:
    job = naoctl("submit", *SMALL, *LONG, "--steps", "200000", "--json")
    wait_for(lambda: naoctl("checkpoints", job["id"], "--json"), 180, "no checkpoint came")
    project.compose("kill", "worker", "broker")
    killed = naoctl("status", job["id"], "--json")
    assert killed["state"] == "running", "the training was over before it could be killed"
    project.compose("up", "--detach", "--no-build", "--wait", "broker", "worker")
    naoctl("watch", job["id"], timeout_s=600)
    done = naoctl("status", job["id"], "--json")
    assert (done["state"], done["attempt"]) == ("succeeded", 2)
    # It resumed from a checkpoint and did not start over: the killed attempt's are still the only ones of their steps.
    points = naoctl("checkpoints", job["id"], "--json")
    steps = [point["step"] for point in points]
    assert len(steps) == len(set(steps)) and max(steps) == done["total_steps"]
    assert {point["attempt"] for point in points} == {1, 2}


def test_a_worker_that_is_told_to_end_gives_its_job_back(project: Any, naoctl: Naoctl, wait_for: Naoctl) -> None:
    job = naoctl("submit", *SMALL, *LONG, "--steps", "10000000", "--json")
    wait_for(lambda: naoctl("checkpoints", job["id"], "--json"), 180, "no checkpoint came")
    project.compose("stop", "worker")
    stopped = project.container("worker")["State"]
    assert (stopped["ExitCode"], stopped["OOMKilled"]) == (0, False)
    waiting = naoctl("status", job["id"], "--json")
    assert waiting["state"] == "queued"
    assert waiting["failures"] == 0
    # Nothing is lost: the newest checkpoint is of the step at which it was stopped.
    assert naoctl("checkpoints", job["id"], "--json")[0]["step"] == waiting["progress_step"]
    naoctl("cancel", job["id"])
    project.compose("up", "--detach", "--no-build", "--wait", "worker")


def test_our_containers_can_change_nothing_of_themselves(project: Any) -> None:
    for service in ("api", "worker"):
        host = project.container(service)["HostConfig"]
        assert host["ReadonlyRootfs"] and host["CapDrop"] == ["ALL"] and host["Memory"] > 0 and host["NanoCpus"] > 0
        assert project.compose("exec", "-T", service, "id", "-u").stdout.strip() == "10001"
        for target in ("/venv/x", "/var/tmp/x"):  # the file system is read-only
            refused = project.compose("exec", "-T", service, "touch", target, check=False)
            assert refused.returncode != 0 and "Read-only file system" in refused.stderr


def test_the_api_holds_no_learner_and_the_worker_no_cuda(project: Any) -> None:
    find = "import importlib.util as u, sys; sys.exit(u.find_spec(sys.argv[1]) is not None)"
    for package in ("torch", "stable_baselines3", "mujoco", "naosprint_worker"):
        project.compose("exec", "-T", "api", "python", "-c", find, package)
    project.compose("exec", "-T", "worker", "python", "-c", find, "naosprint_api")
    project.compose(
        "exec", "-T", "worker", "python", "-c", "import torch, sys; sys.exit(torch.version.cuda is not None)"
    )
    installed = project.compose("exec", "-T", "worker", "sh", "-c", "ls /venv/lib/python3*/site-packages").stdout
    assert "nvidia" not in installed


def test_nobody_gets_in_without_a_key(project: Any) -> None:
    assert httpx.get(f"{project.url}/jobs", timeout=20).status_code == 401
    assert httpx.get(f"{project.url}/metrics", timeout=20).status_code == 401
    project.compose("exec", "-T", "api", "python", "-c", KNOCK)
    broker = project.compose("exec", "-T", "broker", "sh", "-c", "unset VALKEYCLI_AUTH REDISCLI_AUTH; valkey-cli ping")
    assert "NOAUTH" in broker.stdout + broker.stderr
    # Only the API is published, and on this machine alone.
    published = {
        one["Config"]["Labels"]["com.docker.compose.service"]: [binding["HostIp"] for binding in bindings]
        for one in project.containers()
        for bindings in (one["NetworkSettings"]["Ports"] or {}).values()
        if bindings
    }
    assert published == {"api": ["127.0.0.1"]}


def test_the_database_cannot_be_reached_from_outside_its_network(project: Any) -> None:
    reach = "import socket; socket.create_connection(('1.1.1.1', 443), 3)"
    answer = project.compose("exec", "-T", "worker", "python", "-c", reach, check=False)
    assert answer.returncode != 0 and "OSError" in answer.stderr


def test_ports_of_the_store_that_need_no_key_are_reached_by_its_proxy_alone(project: Any) -> None:
    (network,) = project.container("seaweedfs")["NetworkSettings"]["Networks"].values()
    hosts = ("store", "seaweedfs", network["IPAddress"])
    addresses = [f"{host}:{port}" for host in hosts for port in (8888, 9333, 9340)]
    for service in ("api", "worker"):
        assert reached(project, service, addresses) == set()
    # There is something to reach.
    port = "wget -q -O /dev/null http://127.0.0.1:8888/" if project.has_registry else ": >/dev/tcp/127.0.0.1/8888"
    project.compose("exec", "-T", "seaweedfs", "sh" if project.has_registry else "bash", "-c", port)


def test_internal_networks_do_not_reach_the_host(project: Any) -> None:
    found = json.loads(run(["docker", "network", "inspect", "bridge", *project.owned("network")]).stdout)
    with listening() as port:
        gateways = {
            one["Name"].removeprefix(f"{project.name}_"): f"{config.get('Gateway') or first(config['Subnet'])}:{port}"
            for one in found
            for config in one["IPAM"]["Config"]
        }
        assert {"data", "storage", "front", "bridge"} <= set(gateways)
        assert reached(project, "worker", list(gateways.values())) == set()
        # The API's published port needs a network with a gateway, which shows that the host can be reached.
        assert gateways["front"] in reached(project, "api", list(gateways.values()))


def test_the_superuser_connects_on_its_socket_only(project: Any) -> None:
    lines = project.settings.read_text(encoding="utf-8").splitlines()
    password = dict(line.split("=", 1) for line in lines if line[:1].isupper())["POSTGRES_PASSWORD"]
    code = "import psycopg, sys; psycopg.connect(sys.argv[1]).close()"
    url = f"postgresql://naosprint:{password}@postgres:5432/naosprint"
    refused = project.compose("exec", "-T", "api", "python", "-c", code, url, check=False)
    assert refused.returncode != 0 and "no pg_hba.conf entry" in refused.stderr


def first(subnet: str) -> str:
    """Return the address that the engine gives to a bridge."""
    return str(next(ipaddress.ip_network(subnet).hosts()))


@pytest.mark.parametrize(
    "secret", ["POSTGRES_PASSWORD", "POSTGRES_WORKER_PASSWORD", "BROKER_API_PASSWORD", "S3_SECRET_ACCESS_KEY"]
)
def test_compose_names_the_secret_that_is_missing(engine: str, secret: str, tmp_path: Path) -> None:
    path = tmp_path / "some.env"
    subprocess.run([ROOT / "deploy" / "new-env", path], check=True, timeout=20)
    path.write_text(re.sub(rf"^{secret}=.*$", f"{secret}=", path.read_text(), flags=re.MULTILINE))
    answer = subprocess.run(
        [engine, "compose", "--project-directory", ROOT, "--env-file", path, "config", "--quiet"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert answer.returncode != 0
    assert secret in answer.stderr and "deploy/new-env" in answer.stderr
