"""Profile `sidecars`: a job on servers gets its own containers, which are removed at the end."""

from __future__ import annotations

import contextlib
import json
import subprocess
import time
from collections.abc import Callable, Iterator
from ipaddress import ip_network
from typing import Any

import pytest
from docker import APIClient, errors
from naosim.sidecars import Sidecars

from .conftest import REACH, listening

Naoctl = Callable[..., Any]

ROBOTS = 2
SERVERS = 2 * ROBOTS  # each with a standby
SMALL = (
    *("--simulator", "server", "--n-envs", str(ROBOTS), "--n-steps", "64", "--batch-size", "64"),
    *("--learner-threads", "1", "--fall-penalty-m", "0"),
)
EVAL = (
    "--eval-episodes",
    "2",
    "--eval-n-envs",
    "2",
    "--eval-trajectories",
    "1",
    "--eval-bootstrap-resamples",
    "100",
)

ASK = """
import sys, urllib.error, urllib.request
method, path, body = sys.argv[1:]
request = urllib.request.Request("http://launcher:2380" + path, body.encode() or None, method=method)
try:
    print(urllib.request.urlopen(request, timeout=20).status)
except urllib.error.HTTPError as error:
    print(error.code, error.read().decode(errors="replace")[:200])
"""
"""Sends one request to the launcher and prints the status of the answer."""


def docker(*arguments: str) -> str:
    done = subprocess.run(["docker", *arguments], capture_output=True, text=True, check=True, timeout=60)
    return done.stdout


def owned(kind: str, **labels: str) -> list[dict[str, Any]]:
    """Return the servers' containers or networks with these labels."""
    every = ["--all"] if kind == "container" else []
    filters = [part for key, value in labels.items() for part in ("--filter", f"label={key}={value}")]
    ids = docker(kind, "ls", *every, "--quiet", "--no-trunc", "--filter", "label=naosim.server=1", *filters).split()
    if not ids:
        return []
    # one may go while it is looked at
    done = subprocess.run(["docker", kind, "inspect", *ids], capture_output=True, text=True, timeout=60)
    return list(json.loads(done.stdout or "[]"))


@pytest.fixture(scope="module")
def sidecars(project: Any) -> Iterator[Any]:
    """The project with the profile's services; they are gone afterwards."""
    project.compose("build", "simserver", "rcssservermj", timeout_s=1500)
    services = ("sidecar-worker", "launcher")
    project.compose("up", "--detach", "--no-build", "--wait", "--wait-timeout", "180", *services)
    yield project
    project.compose("--profile", "sidecars", "rm", "--stop", "--force", *services, "simserver", "rcssservermj")
    assert owned("container") == owned("network") == []


@pytest.mark.parametrize(("robot", "image"), [("nao-0", "naosprint/simserver"), ("t1", "naosprint/rcssservermj")])
def test_a_job_trains_on_containers_of_its_own(
    sidecars: Any, naoctl: Naoctl, wait_for: Naoctl, robot: str, image: str
) -> None:
    long = ("--steps", "4096", "--checkpoint-interval-steps", "4096")
    job = naoctl("submit", "--robot", robot, *SMALL, *EVAL, *long, "--json")["id"]

    def running() -> list[dict[str, Any]] | None:
        found = owned("container", job=job)
        return found if len(found) == SERVERS else None

    servers = wait_for(running, 120, f"{SERVERS} servers did not start")
    for server in servers:
        host = server["HostConfig"]
        assert host["CapDrop"] == ["ALL"] and host["ReadonlyRootfs"] and host["Memory"] > 0 and host["PidsLimit"] > 0
        assert not any(server["NetworkSettings"]["Ports"].values()), "a server's port is published"
        assert server["Config"]["Labels"]["attempt"] == "1"
        assert server["Config"]["Image"].startswith(image)
    (name,) = {network for server in servers for network in server["NetworkSettings"]["Networks"]}
    (network,) = (one for one in owned("network", job=job) if one["Name"] == name)
    assert network["Internal"]
    worker = sidecars.container("sidecar-worker")["Id"]
    assert set(network["Containers"]) == {worker, *(server["Id"] for server in servers)}

    naoctl("watch", job, timeout_s=600)
    done = naoctl("status", job, "--json")
    assert (done["state"], done["progress_step"], done["attempt"]) == ("succeeded", 4096, 1)
    assert owned("container") == owned("network") == []


def test_nothing_is_left_of_a_killed_worker_and_its_job_goes_on(
    sidecars: Any, naoctl: Naoctl, wait_for: Naoctl
) -> None:
    long = ("--steps", "10000000", "--no-evaluate", "--checkpoint-interval-steps", "512")
    job = naoctl("submit", *SMALL, *long, "--json")["id"]
    wait_for(lambda: naoctl("checkpoints", job, "--json"), 180, "no checkpoint came")
    assert len(owned("container", job=job)) == SERVERS
    docker("kill", sidecars.container("sidecar-worker")["Id"])
    killed = time.monotonic()
    wait_for(lambda: not owned("container", job=job), 60, "servers were left behind")
    wait_for(lambda: not owned("network", job=job), 60 - (time.monotonic() - killed), "a network was left behind")

    # The worker that was killed restarts, although its network was removed.
    sidecars.compose("up", "--detach", "--no-build", "--wait", "--wait-timeout", "120", "sidecar-worker")
    wait_for(lambda: len(owned("container", job=job, attempt="2")) == SERVERS, 120, "the job did not resume")
    naoctl("cancel", job, "--wait")
    wait_for(lambda: not owned("container", job=job), 60, "servers of a cancelled job were left behind")


def test_the_worker_has_no_way_to_the_engine(sidecars: Any) -> None:
    """tests/unit/naosim/test_sidecars.py tries what the launcher can be asked; this is how it is deployed."""

    def ask(method: str, path: str, body: str = "") -> str:
        return str(sidecars.compose("exec", "-T", "sidecar-worker", "python", "-c", ASK, method, path, body).stdout)

    worker, launcher = sidecars.container("sidecar-worker"), sidecars.container("launcher")
    assert [
        one["Config"]["Labels"]["com.docker.compose.service"]
        for one in sidecars.containers()
        if any(mount["Destination"].endswith("docker.sock") for mount in one["Mounts"])
    ] == ["launcher"]
    assert not any("DOCKER" in line for line in worker["Config"]["Env"])
    assert launcher["HostConfig"]["CapDrop"] == ["ALL"] and launcher["HostConfig"]["ReadonlyRootfs"]
    assert not any(launcher["NetworkSettings"]["Ports"].values())
    assert ask("POST", "/v1.45/containers/create?name=naosim-0123456789ab", "{}").startswith("404")
    assert ask("GET", "/containers/json").startswith("404")
    assert ask("DELETE", f"/servers/{sidecars.container('postgres')['Id']}").startswith("404")
    order = {"server": "rcssserver3d", "job": f"job_{'0' * 26}", "attempt": 1, "count": 1}
    assert ask("POST", "/servers", json.dumps({**order, "HostConfig": {"Privileged": True}})).startswith("422")
    # otherwise it could refuse all of the above for another reason
    assert ask("POST", "/servers", json.dumps(order)).startswith("200")
    assert sidecars.container("postgres")["State"]["Running"]


def test_many_networks_fit_and_none_reaches_the_host(sidecars: Any) -> None:
    """The engine's own pools have room for about 30."""
    api = APIClient()
    service = Sidecars(api, {}, sidecars.container("launcher")["Id"])
    names = [f"naosim-e2e-{index}" for index in range(40)]
    worker = sidecars.container("sidecar-worker")["Id"]
    made = []
    try:
        for name in names:
            service._create_network(name, {"test": "networks"})
            made.append(name)
        api.connect_container_to_network(worker, names[-1])
        with listening() as port:
            networks = [json.loads(docker("network", "inspect", name))[0] for name in (names[-1], "bridge")]
            subnet = ip_network(networks[0]["IPAM"]["Config"][0]["Subnet"])
            # Every address of the network that is no container's: one of them would be the host's.
            addresses = [str(one) for one in list(subnet.hosts())[:8]] + [networks[1]["IPAM"]["Config"][0]["Gateway"]]
            asked = [f"{address}:{port}" for address in addresses]
            assert sidecars.compose("exec", "-T", "sidecar-worker", "python", "-c", REACH, *asked).stdout == ""
            # A network of the engine's own making does reach it.
            assert sidecars.compose("exec", "-T", "api", "python", "-c", REACH, asked[-1]).stdout.split() == asked[-1:]
    finally:
        with contextlib.suppress(errors.APIError):
            api.disconnect_container_from_network(worker, names[-1])
        for name in made:
            api.remove_network(name)
        api.close()
