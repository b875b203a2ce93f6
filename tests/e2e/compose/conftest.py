"""The deployment as started from the repository, on an available container engine."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import secrets
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[3]
STANDINS = Path(__file__).parent / "standins.yml"
REACH = """
import socket, sys
for address in sys.argv[1:]:
    host, _, port = address.rpartition(":")
    try:
        with socket.create_connection((host, int(port)), 2) as connection:
            connection.settimeout(2)
            connection.sendall(b"GET / HTTP/1.0\\r\\n\\r\\n")
            answer = b"".join(iter(lambda: connection.recv(4096), b""))
    except OSError:
        continue
    if b"naosprint" in answer or b"SeaweedFS" in answer:
        print(address)
"""
"""Prints which of the given addresses answer as SeaweedFS, its stand-in, or :func:`listening` does: behind the proxy of
some networks every address answers something.
"""


@contextlib.contextmanager
def listening() -> Iterator[int]:
    """Answer at a port of every address of this machine; yield the port."""

    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.wfile.write(b"naosprint")

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("0.0.0.0", 0), Answer) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}).start()
        try:
            yield server.server_port
        finally:
            server.shutdown()


@functools.cache
def missing_engine() -> str | None:
    """Return what is missing to run containers, or nothing."""
    if shutil.which("docker") is None:
        return "needs a container engine: there is no `docker`"
    for command, what in ((["docker", "info"], "no engine answers"), (["docker", "compose", "version"], "no compose")):
        answer = subprocess.run(command, capture_output=True, text=True, timeout=60)
        if answer.returncode != 0:
            return f"needs a container engine: {what}: {answer.stderr.strip().splitlines()[-1:]}"
    return None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        if here not in item.path.parents:
            continue
        item.add_marker(pytest.mark.e2e)
        # The first of them builds the images.
        item.add_marker(pytest.mark.timeout(2400))
        if {"project", "engine"} & set(getattr(item, "fixturenames", ())) and (reason := missing_engine()):
            item.add_marker(pytest.mark.skip(reason=reason))


@dataclass(frozen=True)
class Project:
    """A compose project with its own name, containers, volumes and networks."""

    name: str
    files: tuple[Path, ...]
    settings: Path
    has_registry: bool
    """Whether the official images can be pulled."""
    environment: dict[str, str] = field(repr=False)
    """The environment of `docker compose`: none of the caller's variables may replace a setting."""

    @property
    def command(self) -> list[str]:
        """`docker compose` of this project, to be continued."""
        files = [part for file in self.files for part in ("--file", str(file))]
        return ["docker", "compose", "--project-name", self.name, "--env-file", str(self.settings), *files]

    def compose(self, *arguments: str, check: bool = True, timeout_s: float = 300) -> subprocess.CompletedProcess[str]:
        """Run `docker compose` with `arguments`; show what it wrote if it fails."""
        return run([*self.command, *arguments], env=self.environment, check=check, timeout_s=timeout_s)

    def script(self, name: str, *arguments: Path, check: bool = True) -> subprocess.CompletedProcess[str]:
        """Run a script of deploy/ on this project."""
        environment = {
            **self.environment,
            "COMPOSE_PROJECT_NAME": self.name,
            "COMPOSE_FILE": os.pathsep.join(str(file) for file in self.files),
            "COMPOSE_ENV_FILES": str(self.settings),
        }
        command = [str(ROOT / "deploy" / name), *(str(argument) for argument in arguments)]
        return run(command, env=environment, check=check, timeout_s=600)

    def containers(self) -> list[dict[str, Any]]:
        """Return the output of `docker inspect` for the project's containers, stopped ones included."""
        ids = self.owned("container")
        return json.loads(run(["docker", "inspect", *ids]).stdout) if ids else []

    def container(self, service: str) -> dict[str, Any]:
        """Return the output of `docker inspect` for the one container of a service."""
        found = [one for one in self.containers() if one["Config"]["Labels"]["com.docker.compose.service"] == service]
        assert len(found) == 1, f"{len(found)} containers of {service}"
        return found[0]

    def owned(self, kind: str) -> list[str]:
        """Return the ids of all containers, volumes or networks of the project."""
        every = ["--all"] if kind == "container" else []
        label = f"label=com.docker.compose.project={self.name}"
        return run(["docker", kind, "ls", *every, "--quiet", "--filter", label]).stdout.split()

    @property
    def url(self) -> str:
        """The API's address on this machine."""
        return f"http://{self.compose('port', 'api', '8000').stdout.strip()}"

    def token(self, *scopes: str) -> str:
        """Make a token as documented."""
        flags = [part for scope in scopes for part in ("--scope", scope)]
        answer = self.compose(
            "exec", "-T", "api", "python", "-m", "naojobs", "token", "create", "--owner", "tests", *flags
        )
        return str(json.loads(answer.stdout)["token"])

    def artifacts(self, prefix: str) -> list[str]:
        """Return the keys in the store below `prefix`, as a worker sees them."""
        code = (
            "import json, sys; from naojobs.settings import ServiceSettings; from naojobs.store import ArtifactStore; "
            "print(json.dumps(ArtifactStore.from_settings(ServiceSettings()).list(sys.argv[1])))"
        )
        return list(json.loads(self.compose("exec", "-T", "worker", "python", "-c", code, prefix).stdout))


def run(
    command: Sequence[str], *, env: Mapping[str, str] | None = None, check: bool = True, timeout_s: float = 300
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end; fail with what it wrote."""
    done = subprocess.run(command, env=env, cwd=ROOT, capture_output=True, text=True, timeout=timeout_s)
    if check and done.returncode != 0:
        pytest.fail(f"{' '.join(command)} ended with {done.returncode}:\n{done.stdout[-4000:]}\n{done.stderr[-8000:]}")
    return done


@pytest.fixture(scope="session")
def engine() -> str:
    """The engine's command line; a test that asks for it is skipped where no engine answers."""
    return "docker"


def write_settings(path: Path) -> Path:
    """Write settings with fresh secrets, made as documented; the API uses any free port."""
    run([str(ROOT / "deploy" / "new-env"), str(path)])
    with path.open("a", encoding="utf-8") as file:
        file.write("API_PORT=0\nWORKER_CPUS=1\n")
    return path


@contextlib.contextmanager
def open_project(settings_file: Path, empty: Path) -> Iterator[Project]:
    """Build the deployment from this working copy, yield it when it is healthy, and remove it at the end.

    Args:
        settings_file: what :func:`write_settings` wrote.
        empty: a folder without wheels, for machines that can reach all of them.
    """
    kept = ("PATH", "HOME", "DOCKER_HOST", "DOCKER_CONFIG", "XDG_RUNTIME_DIR")
    environment = {name: os.environ[name] for name in kept if name in os.environ}
    # Where PyTorch's wheel is, on a machine that cannot reach its index; pip names such a folder PIP_FIND_LINKS.
    environment["WHEELS_DIR"] = os.environ.get("WHEELS_DIR") or os.environ.get("PIP_FIND_LINKS") or str(empty)
    compose_file = ROOT / "docker-compose.yml"
    name = f"naosprint-e2e-{secrets.token_hex(4)}"
    project = Project(name, (compose_file,), settings_file, True, environment)
    official = ("postgres", "broker", "seaweedfs", "store")
    if project.compose("pull", "--quiet", *official, check=False, timeout_s=600).returncode != 0:
        project = Project(name, (compose_file, STANDINS), settings_file, False, environment)
    try:
        # One after the other: two compilers and two downloads at a time are too much for a small machine.
        for service in (*(() if project.has_registry else official), "api", "worker"):
            project.compose("build", service, timeout_s=1500)
        project.compose("up", "--detach", "--wait", "--wait-timeout", "300", "api", "worker", timeout_s=400)
        yield project
        logs = project.compose("logs", "--no-color", "--tail", "200", check=False)
        sys.stdout.write(logs.stdout)  # shown with a failure only
    finally:
        project.compose("--profile", "*", "down", "--volumes", "--timeout", "20", check=False)
    for kind in ("container", "volume", "network"):
        assert project.owned(kind) == [], f"a {kind} is left of the project"


@pytest.fixture(scope="session")
def settings_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Settings with fresh secrets."""
    return write_settings(tmp_path_factory.mktemp("compose") / "settings.env")


@pytest.fixture(scope="session")
def project(settings_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Project]:
    """The deployment, built from this working copy and healthy; it is removed at the end."""
    with open_project(settings_file, tmp_path_factory.mktemp("wheels")) as project:
        yield project


@pytest.fixture(scope="session")
def naoctl(project: Project, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Any]:
    """Run naoctl against the deployment; return what it printed, decoded where `--json` is asked for."""
    token = project.token("submit")
    config = str(tmp_path_factory.mktemp("naoctl") / "config.toml")

    def call(*arguments: str, timeout_s: float = 120) -> Any:
        # The port changes when the container is restarted.
        environment = {**os.environ, "NAOCTL_URL": project.url, "NAOCTL_TOKEN": token, "NAOCTL_CONFIG": config}
        answer = run([sys.executable, "-m", "naoctl", *arguments], env=environment, timeout_s=timeout_s).stdout
        return json.loads(answer) if "--json" in arguments else answer

    return call
