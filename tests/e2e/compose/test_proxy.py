"""Two replicas of the API behind the reverse proxy of deploy/proxy.yml."""

from __future__ import annotations

import dataclasses
import json
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

ROOT = Path(__file__).parents[3]
AUTHORITY = "/data/caddy/pki/authorities/local/root.crt"


def docker(*arguments: str) -> str:
    """Return what a command of the engine printed, its log included."""
    done = subprocess.run(["docker", *arguments], capture_output=True, text=True, check=True, timeout=60)
    return done.stdout + done.stderr


@dataclasses.dataclass(frozen=True)
class Proxied:
    """The service behind the proxy: its compose project, its address, and a client that checks its certificate."""

    project: Any
    url: str
    authority: Path
    client: httpx.Client

    def replicas(self) -> list[str]:
        """Return the ids of the API's containers."""
        return list(self.project.compose("ps", "--quiet", "api").stdout.split())


@pytest.fixture(scope="module")
def proxied(project: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Proxied]:
    """Start the proxy and a second replica as documented; return to the service as it was at the end."""
    standins = () if project.has_registry else (Path(__file__).parent / "standins-proxy.yml",)
    opened = dataclasses.replace(
        project,
        files=(project.files[0], ROOT / "deploy" / "proxy.yml", *project.files[1:], *standins),
        environment={
            **project.environment,
            **{"API_DOMAIN": "localhost", "PROXY_BIND": "127.0.0.1", "PROXY_HTTP_PORT": "0", "PROXY_HTTPS_PORT": "0"},
        },
    )
    if standins:
        opened.compose("build", "proxy")
    folder = tmp_path_factory.mktemp("proxy")
    try:
        opened.compose("up", "--detach", "--no-build", "--wait", "--scale", "api=2", "api", "proxy")
        port = opened.compose("port", "proxy", "443").stdout.strip().rpartition(":")[2]
        # For the name localhost Caddy is an authority of its own.
        authority = folder / "root.crt"
        authority.write_text(opened.compose("exec", "-T", "proxy", "cat", AUTHORITY).stdout)
        url = f"https://localhost:{port}"
        with httpx.Client(base_url=url, verify=ssl.create_default_context(cafile=str(authority)), timeout=20) as client:
            yield Proxied(opened, url, authority, client)
    finally:
        opened.compose("rm", "--stop", "--force", "proxy", check=False)
        project.compose("up", "--detach", "--no-build", "--wait", "api", "worker")
        docker("network", "rm", f"{project.name}_edge")
        docker("volume", "rm", f"{project.name}_caddy")


def test_two_replicas_answer_over_https(proxied: Proxied) -> None:
    replicas = proxied.replicas()
    assert len(replicas) == 2
    for index in range(20):
        assert proxied.client.get(f"/jobs/job_{index:026d}").status_code == 401
    for replica in replicas:
        assert "GET /jobs/{job_id} 401" in docker("logs", replica), "one replica got no request"


def test_the_certificate_is_needed_and_no_replica_has_a_port(proxied: Proxied) -> None:
    with pytest.raises(httpx.ConnectError, match="certificate"):
        httpx.get(proxied.url, timeout=20)
    for replica in proxied.replicas():
        assert not any((json.loads(docker("inspect", replica))[0]["NetworkSettings"]["Ports"] or {}).values())
    port = proxied.project.compose("port", "proxy", "80").stdout.strip().rpartition(":")[2]
    answer = httpx.get(f"http://localhost:{port}/jobs", timeout=20)
    assert answer.status_code == 308 and answer.headers["location"].startswith("https://localhost")


def test_streams_arrive_at_once_and_see_what_the_other_replica_did(proxied: Proxied) -> None:
    headers = {"Authorization": f"Bearer {proxied.project.token('submit')}"}
    spec = {"task": {"name": "sprint1"}, "total_steps": 512}
    seen: list[str] = []
    found = threading.Event()
    opened = threading.Event()

    def follow() -> None:
        with proxied.client.stream("GET", "/jobs/stream", headers=headers, timeout=60) as stream:
            opened.set()
            for line in stream.iter_lines():
                seen.append(line)
                if "through-the-proxy" in line:
                    found.set()
                    return

    threading.Thread(target=follow, daemon=True).start()
    assert opened.wait(20)
    made = []
    for index in range(2):  # one by each replica
        body = {"spec": spec, "name": f"through-the-proxy-{index}", "evaluation": None}
        answer = proxied.client.post("/jobs", json=body, headers=headers)
        assert answer.status_code == 201, answer.text
        made.append(answer.json()["id"])
    assert found.wait(20), seen
    for job in made:
        proxied.client.post(f"/jobs/{job}/cancel", headers=headers)


def test_the_api_sees_the_clients_own_address(proxied: Proxied) -> None:
    for _ in range(4):
        forged = {"Authorization": f"Bearer {'x' * 40}", "X-Forwarded-For": "203.0.113.7"}
        assert proxied.client.get("/jobs", headers=forged).status_code == 401
    # The request came through the port of the host, from the host's own address in the proxy's network.
    for replica in proxied.replicas():
        networks = json.loads(docker("inspect", replica))[0]["NetworkSettings"]["Networks"]
        gateway = networks[f"{proxied.project.name}_edge"]["Gateway"]
        logs = docker("logs", replica)
        assert f"refused an unknown token from {gateway}" in logs
        assert "203.0.113.7" not in logs


def test_naoctl_reaches_it(proxied: Proxied, tmp_path: Path) -> None:
    environment = {
        **proxied.project.environment,
        "NAOCTL_URL": proxied.url,
        "NAOCTL_TOKEN": proxied.project.token("read"),
        "NAOCTL_CONFIG": str(tmp_path / "config.toml"),
        "SSL_CERT_FILE": str(proxied.authority),
    }
    answer = subprocess.run(
        [sys.executable, "-m", "naoctl", "list", "--json"], env=environment, capture_output=True, text=True, timeout=60
    )
    assert answer.returncode == 0, answer.stderr


def test_a_replica_may_end(proxied: Proxied, wait_for: Callable[..., Any]) -> None:
    ended, _ = proxied.replicas()
    docker("stop", ended)
    # Its name is looked up every five seconds; until then the proxy tries the other replica.
    for _ in range(20):
        assert proxied.client.get("/healthz").status_code == 200
    docker("start", ended)
    wait_for(lambda: proxied.client.get("/readyz").status_code == 200, 60, "the service was not ready")
