"""`docker compose --profile sidecars`: a job on servers gets containers of its own; nothing of them is left."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

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

#: Sends one request to the engine's filter and prints the status of the answer.
ASK = """
import sys, urllib.error, urllib.request
method, path, body = sys.argv[1:]
request = urllib.request.Request("http://docker-proxy:2375" + path, body.encode() or None, method=method)
request.add_header("Content-Type", "application/json")
try:
    print(urllib.request.urlopen(request, timeout=20).status)
except urllib.error.HTTPError as error:
    print(error.code, error.read().decode(errors="replace")[:200])
"""


def docker(*arguments: str) -> str:
    done = subprocess.run(["docker", *arguments], capture_output=True, text=True, check=True, timeout=60)
    return done.stdout


def owned(kind: str, **labels: str) -> list[dict[str, Any]]:
    """Return what the engine knows of the servers' containers or networks that carry these labels."""
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
    if project.has_registry:
        project.compose("pull", "--quiet", "docker-proxy", timeout_s=600)
    else:
        project.compose("build", "docker-proxy", timeout_s=900)
    project.compose("build", "simserver", "rcssservermj", timeout_s=1500)
    services = ("sidecar-worker", "sidecar-reaper", "docker-proxy")
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

    # The worker that was killed comes back, although the network that it was on is gone.
    sidecars.compose("up", "--detach", "--no-build", "--wait", "--wait-timeout", "120", "sidecar-worker")
    wait_for(lambda: len(owned("container", job=job, attempt="2")) == SERVERS, 120, "the job did not go on")
    naoctl("cancel", job, "--wait")
    wait_for(lambda: not owned("container", job=job), 60, "servers of a cancelled job were left behind")


def create(image: str = "naosprint/simserver:0.1.0", **changes: Any) -> str:
    """Return the body of a request for a container as the launcher makes it, with changes to its HostConfig."""
    host = {"NetworkMode": "naosim-0123456789ab", "CapDrop": ["ALL"], "Memory": 1 << 28, **changes}
    return json.dumps({"Image": image, "HostConfig": host})


CREATE = "/v1.45/containers/create?name=naosim-0123456789ab"
REFUSED = {
    "a host's folder": ("POST", CREATE, create(Binds=["/:/host"])),
    "the same in small letters": ("POST", CREATE, create(binds=["/:/host"])),
    "the same, escaped": ("POST", CREATE, create(Binds=["/:/host"]).replace("Binds", "\\u0042inds")),
    "the same with a letter that folds": ("POST", CREATE, create(Binds=["/:/host"]).replace("Binds", "Bind\u017f")),
    "a mount": ("POST", CREATE, create(Mounts=[{"Type": "bind", "Source": "/", "Target": "/host"}])),
    "all rights": ("POST", CREATE, create(Privileged=True)),
    "a capability": ("POST", CREATE, create(CapAdd=["SYS_ADMIN"])),
    "the host's processes": ("POST", CREATE, create(PidMode="host")),
    "the host's network": ("POST", CREATE, create(NetworkMode="host")),
    "another network": ("POST", CREATE, create(NetworkMode="naosprint_data")),
    "two networks": ("POST", CREATE, create().replace('"CapDrop"', '"networkmode": "host", "CapDrop"')),
    "two host configurations": ("POST", CREATE, create()[:-1] + ', "hostConfig": {"Privileged": true}}'),
    "another image": ("POST", CREATE, create().replace("naosprint/simserver:0.1.0", "naosprint/api:0.1.0")),
    "a second image": ("POST", CREATE, create()[:-1] + ', "image": "naosprint/api:0.1.0"}'),
    "capabilities": ("POST", CREATE, create(CapDrop=[])),
    "no seccomp": ("POST", CREATE, create(SecurityOpt=["seccomp=unconfined"])),
    "a published port": ("POST", CREATE, create(PortBindings={"3100/tcp": [{"HostPort": "3100"}]})),
    "what lies behind the judged part": ("POST", CREATE, create(Sysctls={}, Comment="x" * 40_000)),
    "another name": ("POST", CREATE.replace("naosim-0123456789ab", "naosprint-api-1"), create()),
    "an open network": ("POST", "/networks/create", '{"Name": "naosim-0123456789ab", "Driver": "bridge"}'),
    "the host's network card": (
        "POST",
        "/networks/create",
        '{"Name": "naosim-0123456789ab", "Driver": "macvlan", "Internal": true}',
    ),
    "a command in a container": ("POST", "/containers/naosim-0123456789ab/exec", '{"Cmd": ["id"]}'),
    "an archive into a container": ("PUT", "/containers/naosim-0123456789ab/archive?path=/", "x"),
    "an image from elsewhere": ("POST", "/images/create?fromImage=alpine", ""),
    "a volume": ("POST", "/volumes/create", "{}"),
    "secrets of the engine": ("GET", "/info", ""),
    "a way around": ("GET", "/containers/naosim-0123456789ab/../../info", ""),
}


@pytest.mark.parametrize("what", REFUSED)
def test_the_filter_refuses(sidecars: Any, what: str) -> None:
    answer = sidecars.compose("exec", "-T", "sidecar-worker", "python", "-c", ASK, *REFUSED[what]).stdout
    assert answer.split()[0] in ("403", "413"), answer
    assert "docker-proxy" in answer


def test_other_containers_are_out_of_reach(sidecars: Any) -> None:
    postgres = sidecars.container("postgres")
    for name in (postgres["Id"], postgres["Name"].lstrip("/")):
        for method, path in (("GET", "json"), ("GET", "logs?stdout=1"), ("POST", "kill"), ("DELETE", "")):
            target = f"/containers/{name}/{path}".rstrip("/")
            answer = sidecars.compose("exec", "-T", "sidecar-worker", "python", "-c", ASK, method, target, "").stdout
            assert answer.startswith("403"), (method, target, answer)
    assert sidecars.container("postgres")["State"]["Running"]


@pytest.mark.parametrize("image", ["naosprint/simserver:0.1.0", "naosprint/rcssservermj:0.1.0"])
def test_the_filter_lets_the_launcher_through(sidecars: Any, image: str) -> None:
    """Else it would refuse all of the above for a reason of its own."""
    ask = ("exec", "-T", "sidecar-worker", "python", "-c", ASK)
    network = '{"Name": "naosim-0123456789ab", "Driver": "bridge", "Internal": true}'
    try:
        assert sidecars.compose(*ask, "POST", "/networks/create", network).stdout.strip() == "201"
        assert sidecars.compose(*ask, "POST", CREATE, create(image)).stdout.strip() == "201"
        assert sidecars.compose(*ask, "GET", "/containers/naosim-0123456789ab/json", "").stdout.strip() == "200"
    finally:
        assert sidecars.compose(*ask, "DELETE", "/containers/naosim-0123456789ab?force=1", "").stdout.strip() == "204"
        assert sidecars.compose(*ask, "DELETE", "/networks/naosim-0123456789ab", "").stdout.strip() == "204"
