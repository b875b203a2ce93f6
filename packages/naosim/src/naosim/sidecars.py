"""Launcher service: starts servers' containers for workers, which have no access to the container engine.

A process that may create containers is root on the host. A worker therefore names a kind of server, a job, an attempt
and a number; only this service has the engine's socket, and it builds every request to the engine itself.

    POST   /servers          {"server": "rcssserver3d", "job": "job_...", "attempt": 1, "count": 2}
    GET    /servers/{name}   {"running": true, "description": "..."}
    DELETE /servers/{name}
    GET    /health

The answer to POST is a line of JSON, and does not end: the servers last as long as the connection does, so they are
gone when the process that asked for them is. Servers of one attempt share a network without connection to the outside
or to the host, which the caller's container joins. The caller is the container that has the connection's address on one
of this service's networks; it reaches its own servers only.
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
import secrets
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from ipaddress import ip_network
from pathlib import Path
from typing import Any, Literal

import anyio
import uvicorn
from anyio import to_thread
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from naosim.bounded_http import Bounds, bounded
from naosim.launchers import ContainerSettings, LauncherUnavailableError, ServerProgram, most_servers
from naosim.launchers.docker import (
    LABEL,
    connect,
    create_server,
    describe_server,
    engine_errors,
    new_name,
    remove_server,
    server_runs,
)
from naosim.mujoco.program import RCSSSERVERMJ
from naosim.simspark.program import RCSSSERVER3D

logger = logging.getLogger(__name__)

PORT = 2380
MOST_CONNECTIONS = 128
"""Connections of one address."""
SWEEP_S = 10.0
DEPLOYMENT, OWNER = "naosim.deployment", "naosim.owner.container"
"""Labels: the compose project of the launcher that made it, and the container that it was made for."""

_SUBNETS = list(ip_network("198.19.0.0/16").subnets(new_prefix=24))
"""Subnets of the attempts' networks, of a block that is reserved for tests of networks; the engine's pools have 30."""
_OLDEST_ENGINE = "1.44"
"""Version of the API of Docker Engine 25."""

_PROGRAMS: Mapping[str, ServerProgram] = {program.name: program for program in (RCSSSERVER3D, RCSSSERVERMJ)}
_BODY = 1024
_WORKERS = 16


class Order(BaseModel):
    """Servers that a worker requests."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    server: Literal["rcssserver3d", "rcssservermj"]
    job: str = Field(pattern=r"^[a-z]{2,8}_[0-9a-hjkmnp-tv-z]{26}$", description="Id of a job or an evaluation.")
    attempt: int = Field(ge=1, le=1_000_000)
    count: int = Field(ge=1, le=64)


class RefusedError(Exception):
    """Refusal of an order, with its HTTP status."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


@dataclass
class _Network:
    """Network of one attempt's servers."""

    owner: str
    name: str = field(default_factory=new_name)
    servers: set[str] = field(default_factory=set)
    ready: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)


class Sidecars:
    """All servers of one deployment.

    Args:
        api: a `docker.APIClient`.
        images: image of each kind of server.
        container: id of the container that this service runs in.
        most: number of servers that may run at once; default: two for each that this machine runs, since a robot may
            have a standby server.

    Raises:
        OSError: the engine does not answer, or is too old.
    """

    def __init__(self, api: Any, images: Mapping[str, str], container: str, most: int | None = None) -> None:
        self._api = api
        self._images = dict(images)
        self._most = 2 * most_servers() if most is None else most
        with engine_errors():
            version = api.version(api_version=False)
            own = api.inspect_container(container)
        if _version(version["ApiVersion"]) < _version(_OLDEST_ENGINE):
            raise OSError(f"Docker Engine {version.get('Version', '')} is too old; the launcher needs 25 or newer")
        self._container = own["Id"]
        self._networks: Sequence[str] = list(own["NetworkSettings"]["Networks"])
        self._deployment = own["Config"]["Labels"].get("com.docker.compose.project", own["Id"])
        self._lock = threading.Lock()
        self._attempts: dict[tuple[str, str, int], _Network] = {}
        """Network of each attempt, and of each server."""
        self._servers: dict[str, _Network] = {}

    def caller(self, address: str) -> str:
        """Return the id of the container that has an address on one of this service's networks.

        Raises:
            RefusedError: none has.
            OSError: the engine does not answer.
        """
        for network in self._networks:
            with engine_errors():
                members = self._api.inspect_network(network)["Containers"] or {}
            for identifier, member in members.items():
                addresses = {str(member.get(key) or "").partition("/")[0] for key in ("IPv4Address", "IPv6Address")}
                if address in addresses and identifier != self._container:
                    return str(identifier)
        raise RefusedError(403, f"{address} is not a container of this deployment")

    def start(self, owner: str, order: Order) -> list[dict[str, Any]]:
        """Start the servers of an order; return name and ports of each.

        Args:
            owner: id of the container that they are for.
            order: the requested servers.

        Raises:
            RefusedError: there are too many.
            OSError: they cannot be started; none is left then.
        """
        program = _PROGRAMS[order.server]
        names = [new_name() for _ in range(order.count)]
        with self._lock:
            if len(self._servers) + order.count > self._most:
                raise RefusedError(429, f"{len(self._servers)} of at most {self._most} servers run already")
            network = self._attempts.setdefault((owner, order.job, order.attempt), _Network(owner))
            network.servers.update(names)
            self._servers.update(dict.fromkeys(names, network))
        labels = {"job": order.job, "attempt": str(order.attempt), DEPLOYMENT: self._deployment, OWNER: owner}
        settings = ContainerSettings(self._images[order.server], labels, network=network.name)
        try:
            with engine_errors():
                self._open(network, labels)
                for name in names:
                    create_server(self._api, name, program, settings)
        except BaseException:
            self.stop(names)
            raise
        logger.info("%s attempt %d: started %d %s", order.job, order.attempt, order.count, order.server)
        return [
            {"name": name, "agent_port": program.agent_port, "monitor_port": program.monitor_port} for name in names
        ]

    def describe(self, owner: str, name: str) -> dict[str, Any]:
        """Return the state of an owner's server.

        Raises:
            RefusedError: it has no such server.
        """
        self._require(owner, name)
        return {"running": server_runs(self._api, name), "description": describe_server(self._api, name)}

    def remove(self, owner: str, name: str) -> None:
        """Stop and remove an owner's server.

        Raises:
            RefusedError: it has no such server.
        """
        self._require(owner, name)
        self.stop([name])

    def stop(self, names: Collection[str]) -> None:
        """Stop and remove servers, and networks with their last one; errors are logged, see :meth:`sweep`."""
        with self._lock:
            mine = [name for name in names if name in self._servers]
            networks = {id(network): network for name in mine if (network := self._servers.pop(name))}
        if mine:
            with ThreadPoolExecutor(_WORKERS) as pool:
                list(pool.map(lambda name: remove_server(self._api, name), mine))
        for network in networks.values():
            with self._lock:
                network.servers.difference_update(mine)
                if network.servers or not self._drop(network):
                    continue
            with network.lock:
                self._remove_network(network.name, network.owner)

    def close(self) -> None:
        """Stop and remove all servers."""
        self.stop(list(self._servers))

    def sweep(self) -> None:
        """Remove servers that no connection holds, of an earlier run for example, or whose owner's container has ended.

        Errors are logged.
        """
        ours = {"label": [f"{LABEL}=1", f"{DEPLOYMENT}={self._deployment}"]}
        try:
            with engine_errors():
                running = {one["Id"] for one in self._api.containers()}
                containers = self._api.containers(all=True, filters=ours)
                networks = self._api.networks(filters=ours)
        except OSError as error:
            logger.warning("sweep: %s", error)
            return
        with self._lock:
            held = set(self._servers)
            open_networks = {network.name for network in self._attempts.values()}
            lost = [name for name, network in self._servers.items() if network.owner not in running]
        self.stop(lost)
        for one in containers:
            name = one["Names"][0].lstrip("/") if one.get("Names") else one["Id"]
            if name not in held:
                logger.info("removing container %s, which has no owner", name)
                remove_server(self._api, name)
        for one in networks:
            if one["Name"] not in open_networks:
                logger.info("removing network %s, which has no owner", one["Name"])
                self._remove_network(one["Name"], one["Labels"].get(OWNER, ""))

    def healthy(self) -> None:
        """Return if the engine answers.

        Raises:
            OSError: it does not.
        """
        with engine_errors():
            self._api.ping()

    def _require(self, owner: str, name: str) -> None:
        with self._lock:
            network = self._servers.get(name)
        if network is None or network.owner != owner:
            raise RefusedError(404, "there is no such server")

    def _open(self, network: _Network, labels: Mapping[str, str]) -> None:
        """Create an attempt's network and connect its owner, once."""
        with network.lock:
            if not network.ready:
                self._create_network(network.name, {**labels, LABEL: "1"})
                self._api.connect_container_to_network(network.owner, network.name)
                network.ready = True

    def _create_network(self, name: str, labels: Mapping[str, str]) -> None:
        """Create a network that reaches neither the outside nor, since its bridge has no address, the host."""
        first = secrets.randbelow(len(_SUBNETS))
        for subnet in _SUBNETS[first:] + _SUBNETS[:first]:
            try:
                self._api.create_network(
                    name,
                    driver="bridge",
                    internal=True,
                    labels=dict(labels),
                    options={"com.docker.network.bridge.inhibit_ipv4": "true"},
                    ipam={"Driver": "default", "Config": [{"Subnet": str(subnet)}]},
                )
            except Exception as error:
                if "overlap" not in str(error):  # the subnet of another network
                    raise
            else:
                return
        raise OSError(f"each of the {len(_SUBNETS)} subnets for servers is in use")

    def _drop(self, network: _Network) -> bool:
        """Forget a network; return whether it was known. Call with the lock held."""
        keys = [key for key, one in self._attempts.items() if one is network]
        for key in keys:
            del self._attempts[key]
        return bool(keys)

    def _remove_network(self, name: str, owner: str) -> None:
        """Disconnect all containers from a network and remove it; errors are logged."""
        try:
            with engine_errors():
                members = self._api.inspect_network(name)["Containers"] or {}
            # a container that has stopped is not listed, but would not start again without the network
            for container in {*members, owner} - {""}:
                with contextlib.suppress(OSError), engine_errors():
                    self._api.disconnect_container_from_network(container, name, force=True)
            with engine_errors():
                self._api.remove_network(name)
        except OSError as error:
            logger.info("network %s: %s", name, error)


class _Held(Response):
    """Answer that lasts until the connection ends."""

    media_type = "application/x-ndjson"

    def __init__(self, content: Any, release: Callable[[], None]) -> None:
        super().__init__()
        del self.headers["content-length"]
        self._line = json.dumps(content).encode() + b"\n"
        self._release = release

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
            await send({"type": "http.response.body", "body": self._line, "more_body": True})
            while (await receive())["type"] != "http.disconnect":
                pass
        finally:
            with anyio.CancelScope(shield=True):
                await to_thread.run_sync(self._release)


def create_app(sidecars: Sidecars) -> Starlette:
    """Return the service's ASGI application."""

    async def call(request: Request, what: Callable[..., Any], *arguments: Any) -> Any:
        owner = await to_thread.run_sync(sidecars.caller, request.client.host if request.client else "")
        return await to_thread.run_sync(what, owner, *arguments)

    async def start(request: Request) -> Response:
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > _BODY:
                raise RefusedError(413, f"an order has at most {_BODY} bytes")
        servers = await call(request, sidecars.start, Order.model_validate_json(body))
        return _Held({"servers": servers}, lambda: sidecars.stop([server["name"] for server in servers]))

    async def describe(request: Request) -> Response:
        return JSONResponse(await call(request, sidecars.describe, request.path_params["name"]))

    async def remove(request: Request) -> Response:
        await call(request, sidecars.remove, request.path_params["name"])
        return Response(status_code=204)

    async def health(_: Request) -> Response:
        await to_thread.run_sync(sidecars.healthy)
        return Response(status_code=204)

    async def refused(_: Request, error: Exception) -> Response:
        status, text = 500, str(error)
        if isinstance(error, RefusedError):
            status = error.status
        elif isinstance(error, ValidationError):
            first = error.errors(include_input=False, include_url=False)[0]
            status, text = 422, f"{'.'.join(map(str, first['loc'])) or 'body'}: {first['msg']}"
        elif isinstance(error, ClientDisconnect):
            status = 400
        elif isinstance(error, LauncherUnavailableError):
            status = 503
        return JSONResponse({"detail": text[:400]}, status)

    handled = (RefusedError, ValidationError, ClientDisconnect, OSError)
    return Starlette(
        routes=[
            Route("/servers", start, methods=["POST"]),
            Route("/servers/{name}", describe, methods=["GET"]),
            Route("/servers/{name}", remove, methods=["DELETE"]),
            Route("/health", health, methods=["GET"]),
        ],
        exception_handlers=dict.fromkeys(handled, refused),
    )


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split("."))


def own_container(mounts: Path = Path("/proc/self/mountinfo")) -> str | None:
    """Return the id of the Docker container that this process runs in, None outside of one."""
    with contextlib.suppress(OSError):
        # the engine mounts the container's own /etc/hostname out of a folder that is named after the container
        if found := re.search(
            r"/containers/([0-9a-f]{64})/hostname /etc/hostname ", mounts.read_text(encoding="utf-8")
        ):
            return found[1]
    return None


def configured(app: Starlette, host: str = "127.0.0.1", port: int = 0) -> uvicorn.Config:
    """Return the settings of the service's server; one caller cannot take all of its connections."""
    return uvicorn.Config(
        app,
        host=host,
        port=port,
        log_level="warning",
        access_log=False,
        proxy_headers=False,
        http=bounded(Bounds(head_s=5, body_s=5, head_bytes=16 << 10, per_address=MOST_CONNECTIONS)),
        limit_concurrency=1024,
        timeout_graceful_shutdown=1,
    )


def serve(images: Mapping[str, str], host: str, port: int) -> None:
    """Run the service until SIGTERM or SIGINT; all its servers are removed then.

    Args:
        images: image of each kind of server.
        host: address to listen on.
        port: port to listen on.

    Raises:
        OSError: no engine answers, or this process does not run in a container.
    """
    container = own_container()
    if container is None:
        raise OSError("the launcher service runs in a container of the engine that it uses")
    sidecars = Sidecars(connect().api, images, container)
    ended = threading.Event()

    def sweep() -> None:
        while True:
            try:
                sidecars.sweep()
            except Exception:
                logger.exception("sweep failed")
            if ended.wait(SWEEP_S):
                return

    threading.Thread(target=sweep, name="sweep", daemon=True).start()
    try:
        uvicorn.Server(configured(create_app(sidecars), host, port)).run()
    finally:
        ended.set()
        sidecars.close()
