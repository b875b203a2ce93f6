"""Servers as containers beside a worker, and the removal of those whose owner has died.

Labels of every container identify its owner: host, process and the moment that process started, because process ids are
reused, and the container that the owner runs in, if any. Only proven orphans are removed: the owner was a process of
this host and is gone, or the owner's whole container no longer runs.

Requests to the engine use names, and all names begin with PREFIX, so that a filter in front of the engine can refuse
everything else (deploy/docker-proxy).
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from naosim.launchers.server import Address, LauncherUnavailableError, ServerHandle, ServerProgram

logger = logging.getLogger(__name__)

LABEL = "naosim.server"
OWNER_HOST, OWNER_PID, OWNER_START = "naosim.owner.host", "naosim.owner.pid", "naosim.owner.start"
OWNER_CONTAINER = "naosim.owner.container"
PREFIX = "naosim-"
OWN_NETWORK = "own"
"""Network name that stands for the launcher's own network, which it creates and removes with its last server."""
_STOP_S = 2


#: Statuses of a proxy whose engine does not answer.
_AWAY = (502, 503, 504)


@dataclass(frozen=True)
class ContainerSettings:
    """Limits, labels and network of every server's container."""

    image: str
    labels: Mapping[str, str] = field(default_factory=dict)
    """Labels besides the owner's, for example job and attempt."""
    memory: str = "512m"
    cpus: float = 1.0
    pids: int = 64
    network: str | None = None
    """Network that the caller is connected to, or :data:`OWN_NETWORK` for a caller in a container.
    None publishes the ports on this machine's loopback only."""

    def __post_init__(self) -> None:
        if not self.image:
            raise ValueError("image: must be given")
        if self.cpus <= 0:
            raise ValueError(f"cpus: must be positive, not {self.cpus}")
        if self.pids < 8:
            raise ValueError(f"pids: must be at least 8, not {self.pids}")


def owner_labels() -> dict[str, str]:
    """Return labels that identify this process."""
    labels = {OWNER_HOST: host_name(), OWNER_PID: str(os.getpid()), OWNER_START: process_start(os.getpid()) or ""}
    container = own_container()
    return labels if container is None else {**labels, OWNER_CONTAINER: container}


def own_container(mounts: Path = Path("/proc/self/mountinfo")) -> str | None:
    """Return the id of the Docker container that this process runs in, None outside of one."""
    with contextlib.suppress(OSError):
        # the engine mounts the container's own /etc/hostname out of a folder that is named after the container
        if found := re.search(r"/containers/([0-9a-f]{64})/hostname /etc/hostname ", mounts.read_text()):
            return found[1]
    return None


def host_name() -> str:
    """Return a name of this host or container that stays the same until its next start."""
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


def container_options(program: ServerProgram, settings: ContainerSettings) -> dict[str, Any]:
    """Return the options of a server's container for the Docker SDK's `containers.run`."""
    options: dict[str, Any] = {
        "image": settings.image,
        "command": program.container_command(),
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
        ports = (program.agent_port, program.monitor_port)
        options["ports"] = {f"{port}/tcp": ("127.0.0.1", None) for port in ports}
    return options


class DockerLauncher:
    """Launcher of servers that are containers.

    Args:
        program: the kind of server.
        settings: image, labels, limits.
        client: a `docker.DockerClient`; default: one from the environment.

    Raises:
        OSError: the Docker SDK is not installed, no engine answers, or :data:`OWN_NETWORK` is requested outside a
            container.
    """

    def __init__(self, program: ServerProgram, settings: ContainerSettings, client: Any = None) -> None:
        self._program = program
        self._settings = settings
        self._api: Any = (client if client is not None else connect()).api
        self._network = None
        if settings.network == OWN_NETWORK:
            container = own_container()
            if container is None:
                raise OSError(
                    f"network: {OWN_NETWORK!r} is for owners that run in a container; leave it out to have the ports "
                    "published on the loopback"
                )
            self._network = _OwnNetwork(self._api, settings, container)

    def start(self) -> ServerHandle:
        """Start a container; the server in it may not listen yet.

        Raises:
            OSError: it cannot be started.
        """
        network = self._settings.network if self._network is None else self._network.enter()
        name = PREFIX + secrets.token_hex(6)
        try:
            with _engine_errors():
                _create(self._api, name, self._program, replace(self._settings, network=network))
                try:
                    self._api.start(name)
                    address = _address(self._api, name, self._program, network)
                    return _ServerContainer(self._api, name, address, self._network)
                except BaseException:
                    with contextlib.suppress(OSError), _engine_errors():
                        self._api.remove_container(name, force=True, v=True)
                    raise
        except BaseException:
            if self._network is not None:
                self._network.leave()
            raise

    def reap(self, min_age_s: float = 30.0) -> int:
        """Remove containers, and their networks, whose owner has died; return how many. Errors are logged."""
        return Reaper(self._api).sweep(min_age_s)


class Reaper:
    """Removal of containers and networks whose owner has died.

    Args:
        api: a `docker.APIClient`; default: one from the environment.

    Raises:
        OSError: the Docker SDK is not installed, or no engine answers.
    """

    def __init__(self, api: Any = None) -> None:
        self._api: Any = api if api is not None else connect().api

    def sweep(self, min_age_s: float = 30.0) -> int:
        """Remove containers, and their networks, whose owner has died; return how many. Errors are logged."""
        ours = {"label": f"{LABEL}=1"}
        try:
            with _engine_errors():
                containers = self._api.containers(all=True, filters=ours)
                networks = self._api.networks(filters=ours)
                running = {one["Id"] for one in self._api.containers()} if containers or networks else set()
        except OSError as error:
            logger.warning("orphaned servers: %s", error)
            return 0
        removed = 0
        for one in containers:
            name = one["Names"][0].lstrip("/") if one.get("Names") else ""
            if _is_left(one["Labels"], running) and time.time() - one["Created"] >= min_age_s:
                removed += self._remove("container", name, partial(self._api.remove_container, force=True, v=True))
        for one in networks:
            if _is_left(one["Labels"], running) and _age_s(one) >= min_age_s:
                owner = one["Labels"].get(OWNER_CONTAINER)
                removed += self._remove("network", one["Name"], partial(_remove_network, self._api, owner=owner))
        return removed

    def _remove(self, what: str, name: str, remove: Callable[[str], None]) -> bool:
        try:
            with _engine_errors():
                remove(name)
        except OSError as error:
            logger.warning("orphaned %s %s: %s", what, name, error)
            return False
        logger.info("removed orphaned %s %s", what, name)
        return True


class _OwnNetwork:
    """Internal network of one launcher; it exists as long as a server uses it."""

    def __init__(self, api: Any, settings: ContainerSettings, container: str) -> None:
        self._api = api
        self._settings = settings
        self._container = container
        self._lock = threading.Lock()
        self._name = ""
        self._servers = 0

    def enter(self) -> str:
        """Add a server, creating the network for the first; return the network's name."""
        with self._lock:
            if self._servers == 0:
                name = PREFIX + secrets.token_hex(6)
                labels = {**self._settings.labels, LABEL: "1", **owner_labels()}
                with _engine_errors():
                    self._api.create_network(name, driver="bridge", internal=True, labels=labels)
                    try:
                        self._api.connect_container_to_network(self._container, name)
                    except BaseException:
                        self._api.remove_network(name)
                        raise
                self._name = name
            self._servers += 1
            return self._name

    def leave(self) -> None:
        """Remove a server, and the network with the last."""
        with self._lock:
            self._servers -= 1
            if self._servers == 0:
                try:
                    with _engine_errors():
                        _remove_network(self._api, self._name, self._container)
                except OSError as error:
                    logger.warning("network %s: %s", self._name, error)


def _remove_network(api: Any, name: str, owner: str | None) -> None:
    """Disconnect all containers from a network and remove it; ``owner`` is the container that created it."""
    found = api.inspect_network(name)
    # a container that has stopped is not listed, but would not start again without the network
    for container in {*(found.get("Containers") or {}), *((owner,) if owner else ())}:
        with contextlib.suppress(OSError), _engine_errors():
            api.disconnect_container_from_network(container, name, force=True)
    api.remove_network(name)


def _is_left(labels: Mapping[str, str], running: Collection[str]) -> bool:
    """Return whether the owner that labels name is gone; ``running`` are the ids of all running containers."""
    if is_orphan(labels):
        return True
    container = labels.get(OWNER_CONTAINER)
    # an owner on this host is checked directly, see `is_orphan`
    return bool(container) and labels.get(OWNER_HOST) != host_name() and container not in running


def _create(api: Any, name: str, program: ServerProgram, settings: ContainerSettings) -> None:
    options = container_options(program, settings)
    image, command, labels = options.pop("image"), options.pop("command"), options.pop("labels")
    network, ports = options.pop("network", None), options.pop("ports", None)
    options.pop("detach")
    api.create_container(
        image,
        command,
        name=name,
        labels=labels,
        ports=None if ports is None else [port.partition("/")[0] for port in ports],
        host_config=api.create_host_config(network_mode=network, port_bindings=ports, **options),
    )


class _ServerContainer:
    """One server's container."""

    def __init__(self, api: Any, name: str, address: Address, network: _OwnNetwork | None) -> None:
        self.address = address
        self._api = api
        self._name = name
        self._network = network

    def alive(self) -> bool:
        try:
            with _engine_errors():
                return bool(self._api.inspect_container(self._name)["State"]["Running"])
        except OSError:
            return False

    def owns(self, port: int) -> bool:
        # the engine has given this port to this container
        return port in (self.address.agent_port, self.address.monitor_port)

    def describe(self) -> str:
        try:
            with _engine_errors():
                state = self._api.inspect_container(self._name)["State"]
                words = " ".join(self._api.logs(self._name, tail=5).decode(errors="replace").split())[-400:]
        except OSError as error:
            return f"container {self._name}: {error}"
        killed = ", out of memory" if state.get("OOMKilled") else ""
        return f"container {self._name}, {state['Status']}, exit code {state.get('ExitCode')}{killed}: {words}"

    def stop(self) -> None:
        try:
            with _engine_errors():
                self._api.stop(self._name, timeout=_STOP_S)
        except OSError as error:
            logger.info("container %s: %s", self._name, error)
        with contextlib.suppress(OSError), _engine_errors():
            self._api.remove_container(self._name, force=True, v=True)
        if self._network is not None:
            self._network.leave()
            self._network = None


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


def _address(api: Any, name: str, program: ServerProgram, network: str | None) -> Address:
    if network is not None:
        return Address(name, program.agent_port, program.monitor_port)
    status = ""
    for _ in range(50):
        found = api.inspect_container(name)
        published, status = found["NetworkSettings"]["Ports"] or {}, found["State"]["Status"]
        ports: list[Any] = [published.get(f"{port}/tcp") for port in (program.agent_port, program.monitor_port)]
        if all(ports):
            agent, monitor = (int(bindings[0]["HostPort"]) for bindings in ports)
            return Address("127.0.0.1", agent, monitor)
        if status in ("exited", "dead"):
            break
        time.sleep(0.1)
    raise OSError(f"container {name} has no published ports ({status})")


def _age_s(network: Mapping[str, Any]) -> float:
    """Return a network's age in seconds; 0 if the engine does not report it."""
    created = str(network.get("Created", ""))
    with contextlib.suppress(ValueError):
        # nanoseconds are more than Python's fractions
        return time.time() - datetime.fromisoformat(re.sub(r"\.(\d{6})\d*", r".\1", created)).timestamp()
    return 0.0


@contextlib.contextmanager
def _engine_errors() -> Iterator[None]:
    """Convert the SDK's errors to OSError, or LauncherUnavailableError if the engine does not answer."""
    try:
        yield
    except Exception as error:
        module = type(error).__module__.partition(".")[0]
        if module not in ("docker", "requests", "urllib3"):
            raise
        # Errors of the engine have a status, connection errors have none; a proxy answers for an unavailable engine.
        status = getattr(error, "status_code", None)
        unreached = module != "docker" or type(error).__name__ == "DockerException"
        away = unreached if status is None else status in _AWAY
        raise (LauncherUnavailableError if away else OSError)(f"Docker: {error}") from error
