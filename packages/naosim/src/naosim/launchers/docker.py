"""Servers as containers that publish their ports on the loopback, and the removal of those whose owner has died.

Labels of every container identify its owner: host, process and the moment that process started, because process ids are
reused. Only proven orphans are removed: the owner was a process of this host and is gone.

This is for owners that may use the container engine. A worker in a container may not: it asks the launcher service
(:mod:`naosim.sidecars`), which builds its containers with :func:`create_server`, too.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import secrets
import socket
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from naospec.processes import boot_id, start_ticks

from naosim.launchers.server import Address, LauncherUnavailableError, ServerHandle, ServerProgram

logger = logging.getLogger(__name__)

LABEL = "naosim.server"
OWNER_HOST, OWNER_PID, OWNER_START = "naosim.owner.host", "naosim.owner.pid", "naosim.owner.start"
PREFIX = "naosim-"
_STOP_S = 2
_OWN_OPTIONS = ("command", "entrypoint", "user", "labels", "ports")
"""Options of a container itself; the others are of the host that runs it."""
_USER = "10001:10001"
"""User and group of every server, whatever its image says."""


@dataclass(frozen=True)
class ContainerSettings:
    """Limits, labels and network of every server's container."""

    image: str
    labels: Mapping[str, str] = field(default_factory=dict)
    """For example job and attempt."""
    memory: str = "512m"
    cpus: float = 1.0
    pids: int = 64
    network: str | None = None
    """Name of the container's network; without one its ports are published on this machine's loopback alone."""

    def __post_init__(self) -> None:
        if not self.image:
            raise ValueError("image: must be given")
        if self.cpus <= 0:
            raise ValueError(f"cpus: must be positive, not {self.cpus}")
        if self.pids < 8:
            raise ValueError(f"pids: must be at least 8, not {self.pids}")


def owner_labels() -> dict[str, str]:
    """Return labels that identify this process."""
    return {OWNER_HOST: host_name(), OWNER_PID: str(os.getpid()), OWNER_START: str(start_ticks(os.getpid()) or "")}


def host_name() -> str:
    """Return a name of this host or container that stays the same until its next start."""
    return f"{socket.gethostname()}/{boot_id()}"


def is_orphan(labels: Mapping[str, str]) -> bool:
    """Return whether a container's owner was a process of this host and is gone."""
    if labels.get(OWNER_HOST) != host_name():
        return False
    pid, start = labels.get(OWNER_PID, ""), labels.get(OWNER_START, "")
    return pid.isdecimal() and start.isdecimal() and start_ticks(int(pid)) != int(start)


def container_options(program: ServerProgram, settings: ContainerSettings) -> dict[str, Any]:
    """Return the options of a server's container for `create_container`."""
    options = {"command": program.container_command(), **confined_options(settings)}
    if settings.network is not None:
        return {**options, "network_mode": settings.network}
    ports = [program.agent_port, program.monitor_port]
    return {**options, "ports": ports, "port_bindings": {port: ("127.0.0.1", None) for port in ports}}


def confined_options(settings: ContainerSettings) -> dict[str, Any]:
    """Return user, labels and limits of a container that may do nothing but run its program."""
    return {
        "init": True,
        "user": _USER,
        "labels": {**settings.labels, LABEL: "1"},
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


class DockerLauncher:
    """Launcher of servers that are containers.

    Args:
        program: the kind of server.
        settings: image, labels, limits.
        client: a `docker.DockerClient`; default: one from the environment.

    Raises:
        OSError: the Docker SDK is not installed, or no engine answers.
    """

    def __init__(self, program: ServerProgram, settings: ContainerSettings, client: Any = None) -> None:
        self._program = program
        self._settings = replace(settings, labels={**settings.labels, **owner_labels()})
        self._api: Any = (client if client is not None else connect()).api

    def start(self) -> ServerHandle:
        """Start a container; the server in it may not listen yet.

        Raises:
            OSError: it cannot be started.
        """
        name = new_name()
        with engine_errors():
            create_server(self._api, name, self._program, self._settings)
            try:
                return _ServerContainer(self._api, name, _published(self._api, name, self._program))
            except BaseException:
                remove_server(self._api, name)
                raise


def remove_orphans(api: Any = None, min_age_s: float = 30.0) -> int:
    """Remove server containers whose owner was a process of this host and is gone; return how many. Errors are logged.

    Args:
        api: a `docker.APIClient`; default: one from the environment.
        min_age_s: younger containers are kept.

    Raises:
        OSError: the Docker SDK is not installed, or no engine answers.
    """
    api = api if api is not None else connect().api
    removed = 0
    try:
        with engine_errors():
            for one in api.containers(all=True, filters={"label": f"{LABEL}=1"}):
                if is_orphan(one["Labels"]) and abs(time.time() - one["Created"]) >= min_age_s:
                    api.remove_container(one["Id"], force=True, v=True)
                    logger.info("removed orphaned container %s", one["Id"][:12])
                    removed += 1
    except OSError as error:
        logger.warning("orphaned servers: %s", error)
    return removed


def new_name() -> str:
    """Return a name for a container or a network that cannot be guessed."""
    return PREFIX + secrets.token_hex(16)


def create_server(api: Any, name: str, program: ServerProgram, settings: ContainerSettings) -> None:
    """Create and start the container of a server; nothing of it is left if that fails.

    Raises:
        docker.errors.DockerException: the engine refuses.
    """
    create_container(api, name, settings.image, container_options(program, settings))


def create_container(api: Any, name: str, image: str, options: Mapping[str, Any]) -> None:
    """Create and start a container; nothing of it is left if that fails.

    Args:
        api: a `docker.APIClient`.
        name: its name.
        image: its image.
        options: arguments of the client's `create_container` and `create_host_config`.

    Raises:
        docker.errors.DockerException: the engine refuses.
    """
    own = {key: options[key] for key in _OWN_OPTIONS if key in options}
    host = api.create_host_config(**{key: value for key, value in options.items() if key not in own})
    api.create_container(image, name=name, detach=True, host_config=host, **own)
    try:
        api.start(name)
    except BaseException:
        remove_server(api, name)
        raise


def describe_server(api: Any, name: str) -> str:
    """Return a container's state and the end of its log."""
    try:
        with engine_errors():
            state = api.inspect_container(name)["State"]
            words = " ".join(api.logs(name, tail=5).decode(errors="replace").split())[-400:]
    except OSError as error:
        return f"container {name}: {error}"
    killed = ", out of memory" if state.get("OOMKilled") else ""
    return f"container {name}, {state['Status']}, exit code {state.get('ExitCode')}{killed}: {words}"


def server_runs(api: Any, name: str) -> bool:
    """Return whether a container runs."""
    try:
        with engine_errors():
            return bool(api.inspect_container(name)["State"]["Running"])
    except OSError:
        return False


def remove_server(api: Any, name: str, *, grace_s: int = _STOP_S) -> None:
    """Stop a container, within ``grace_s`` if that is not 0, and remove it; errors are logged."""
    try:
        with engine_errors():
            if grace_s:
                api.stop(name, timeout=grace_s)
    except OSError as error:
        logger.info("container %s: %s", name, error)
    with contextlib.suppress(OSError), engine_errors():
        api.remove_container(name, force=True, v=True)


class _ServerContainer:
    """One server's container."""

    def __init__(self, api: Any, name: str, address: Address) -> None:
        self.address = address
        self._api = api
        self._name = name

    def alive(self) -> bool:
        return server_runs(self._api, self._name)

    def owns(self, port: int) -> bool:
        # the engine has given this port to this container
        return port in (self.address.agent_port, self.address.monitor_port)

    def describe(self) -> str:
        return describe_server(self._api, self._name)

    def stop(self) -> None:
        remove_server(self._api, self._name)


def connect() -> Any:
    """Return a client of the Docker engine that the environment names.

    Raises:
        OSError: the Docker SDK is not installed, or no engine answers.
    """
    try:
        docker = importlib.import_module("docker")
    except ImportError as error:
        raise OSError("the Docker SDK is not installed: pip install docker") from error
    with engine_errors():
        client = docker.from_env()
        client.ping()
        return client


def _published(api: Any, name: str, program: ServerProgram) -> Address:
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


@contextlib.contextmanager
def engine_errors() -> Iterator[None]:
    """Turn the SDK's errors into OSError, which every launcher raises, and those of an engine that does not answer."""
    try:
        yield
    except Exception as error:
        module = type(error).__module__.partition(".")[0]
        if module not in ("docker", "requests", "urllib3"):
            raise
        # Errors of the engine have a status, those of the way to it none.
        away = getattr(error, "status_code", None) is None and (
            module != "docker" or type(error).__name__ == "DockerException"
        )
        raise (LauncherUnavailableError if away else OSError)(f"Docker: {error}") from error
