"""Start servers as containers beside a worker, and remove those whose owner has died.

Every container carries labels that say whose it is: the owner's host, process and the moment that process started, for
a process number alone is used again. Only what is provably an orphan of this host is removed.
"""

from __future__ import annotations

import calendar
import contextlib
import importlib
import logging
import os
import socket
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from naosim import protocol
from naosim.launcher import Address, ServerHandle

logger = logging.getLogger(__name__)

LABEL = "naosim.server"
OWNER_HOST, OWNER_PID, OWNER_START = "naosim.owner.host", "naosim.owner.pid", "naosim.owner.start"
_STOP_S = 2


@dataclass(frozen=True)
class ContainerSettings:
    """Hold what every server's container gets."""

    image: str
    labels: Mapping[str, str] = field(default_factory=dict)
    """Besides the owner's, for example job and attempt."""
    memory: str = "512m"
    cpus: float = 1.0
    pids: int = 64
    network: str | None = None
    """A network that the caller is on, too; without one the ports are published on this machine's loopback alone."""

    def __post_init__(self) -> None:
        if not self.image:
            raise ValueError("image: must be given")
        if self.cpus <= 0:
            raise ValueError(f"cpus: must be positive, not {self.cpus}")
        if self.pids < 8:
            raise ValueError(f"pids: must be at least 8, not {self.pids}")


def owner_labels() -> dict[str, str]:
    """Return labels that name this process beyond doubt."""
    return {OWNER_HOST: host_name(), OWNER_PID: str(os.getpid()), OWNER_START: process_start(os.getpid()) or ""}


def host_name() -> str:
    """Return a name of this host or container that lasts until it is started again."""
    with contextlib.suppress(OSError):
        return f"{socket.gethostname()}/{Path('/proc/sys/kernel/random/boot_id').read_text().strip()}"
    return socket.gethostname()


def process_start(pid: int) -> str | None:
    """Return when a process started, in clock ticks since boot, or None if there is none."""
    try:
        # the name in brackets may hold anything, so count from its end
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[19]
    except (OSError, IndexError):
        return None


def is_orphan(labels: Mapping[str, str]) -> bool:
    """Return whether a container's owner was a process of this host and is gone."""
    if labels.get(OWNER_HOST) != host_name():
        return False
    pid, start = labels.get(OWNER_PID, ""), labels.get(OWNER_START, "")
    return pid.isdecimal() and bool(start) and process_start(int(pid)) != start


def container_options(settings: ContainerSettings) -> dict[str, Any]:
    """Return how a server's container is run, as the Docker SDK's `containers.run` takes it."""
    options: dict[str, Any] = {
        "image": settings.image,
        "command": ["--agent-port", str(protocol.AGENT_PORT), "--server-port", str(protocol.MONITOR_PORT)],
        "detach": True,
        "init": True,
        "labels": {**settings.labels, LABEL: "1", **owner_labels()},
        "mem_limit": settings.memory,
        "memswap_limit": settings.memory,
        "nano_cpus": int(settings.cpus * 1e9),
        "pids_limit": settings.pids,
        "cap_drop": ["ALL"],
        "security_opt": ["no-new-privileges"],
        "read_only": True,
        "tmpfs": {"/tmp": "size=16m,mode=1777"},  # noqa: S108 - inside the container
        "log_config": {"Type": "json-file", "Config": {"max-size": "1m", "max-file": "1"}},
    }
    if settings.network is not None:
        options["network"] = settings.network
    else:
        ports = (protocol.AGENT_PORT, protocol.MONITOR_PORT)
        options["ports"] = {f"{port}/tcp": ("127.0.0.1", None) for port in ports}
    return options


class DockerLauncher:
    """Start servers as containers.

    Args:
        settings: image, labels, limits.
        client: a `docker.DockerClient`; default: one from the environment.

    Raises:
        OSError: the Docker SDK is not installed, or no engine answers.
    """

    def __init__(self, settings: ContainerSettings, client: Any = None) -> None:
        self._settings = settings
        self._client = client if client is not None else connect()

    def start(self) -> ServerHandle:
        """Start a container; the server in it may not listen yet.

        Raises:
            OSError: it cannot be started.
        """
        with _engine_errors():
            container = self._client.containers.run(**container_options(self._settings))
        try:
            with _engine_errors():
                return _ServerContainer(container, _address(container, self._settings.network))
        except BaseException:
            with contextlib.suppress(OSError), _engine_errors():
                container.remove(force=True)
            raise

    def reap(self, min_age_s: float = 30.0) -> int:
        """Remove containers whose owner has died; return how many. What goes wrong is logged."""
        removed = 0
        try:
            with _engine_errors():
                containers = self._client.containers.list(all=True, filters={"label": f"{LABEL}=1"})
        except OSError as error:
            logger.warning("orphaned servers: %s", error)
            return 0
        for container in containers:
            if not is_orphan(container.labels) or _age_s(container) < min_age_s:
                continue
            try:
                with _engine_errors():
                    container.remove(force=True, v=True)
                removed += 1
                logger.info("removed orphaned server %s", container.name)
            except OSError as error:
                logger.warning("orphaned server %s: %s", container.name, error)
        return removed


class _ServerContainer:
    """Hold on to one container."""

    def __init__(self, container: Any, address: Address) -> None:
        self.address = address
        self._container = container

    def alive(self) -> bool:
        try:
            with _engine_errors():
                self._container.reload()
        except OSError:
            return False
        return bool(self._container.status == "running")

    def owns(self, port: int) -> bool:
        # the engine has given this port to this container
        return port in (self.address.agent_port, self.address.monitor_port)

    def describe(self) -> str:
        try:
            with _engine_errors():
                self._container.reload()
                words = " ".join(self._container.logs(tail=5).decode(errors="replace").split())[-400:]
        except OSError as error:
            return f"container {self._container.name}: {error}"
        state = self._container.attrs.get("State", {})
        killed = ", out of memory" if state.get("OOMKilled") else ""
        ended = f"{self._container.status}, exit code {state.get('ExitCode')}{killed}"
        return f"container {self._container.name}, {ended}: {words}"

    def stop(self) -> None:
        try:
            with _engine_errors():
                self._container.stop(timeout=_STOP_S)
        except OSError as error:
            logger.info("container %s: %s", self._container.name, error)
        with contextlib.suppress(OSError), _engine_errors():
            self._container.remove(force=True, v=True)


def connect() -> Any:
    """Return a client of the Docker engine that the environment names.

    Raises:
        OSError: the Docker SDK is not installed, or no engine answers.
    """
    try:
        docker = importlib.import_module("docker")
    except ImportError as error:
        raise OSError("the Docker SDK is not installed: pip install docker") from error
    with _engine_errors():
        client = docker.from_env()
        client.ping()
        return client


def _address(container: Any, network: str | None) -> Address:
    if network is not None:
        return Address(container.name, protocol.AGENT_PORT, protocol.MONITOR_PORT)
    for _ in range(50):
        container.reload()
        ports = [container.ports.get(f"{port}/tcp") for port in (protocol.AGENT_PORT, protocol.MONITOR_PORT)]
        if all(ports):
            agent, monitor = (int(found[0]["HostPort"]) for found in ports)
            return Address("127.0.0.1", agent, monitor)
        if container.status in ("exited", "dead"):
            break
        time.sleep(0.1)
    raise OSError(f"container {container.name} has no published ports ({container.status})")


def _age_s(container: Any) -> float:
    created = str(container.attrs.get("Created", ""))[:19]
    try:
        return time.time() - calendar.timegm(time.strptime(created, "%Y-%m-%dT%H:%M:%S"))
    except ValueError:
        return 0.0


@contextlib.contextmanager
def _engine_errors() -> Iterator[None]:
    """Turn the SDK's errors into OSError, which every launcher raises."""
    try:
        yield
    except OSError:
        raise
    except Exception as error:
        if type(error).__module__.partition(".")[0] not in ("docker", "requests", "urllib3"):
            raise
        raise OSError(f"Docker: {error}") from error
