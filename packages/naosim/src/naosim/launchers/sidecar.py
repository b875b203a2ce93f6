"""Servers as containers that the launcher service starts (:mod:`naosim.sidecars`).

A server lasts as long as the connection on which it was requested: the kernel closes that when its owner dies.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from http.client import HTTPConnection, HTTPException, HTTPResponse
from typing import Any
from urllib.parse import urlsplit

from naosim.launchers.server import Address, LauncherUnavailableError, ServerHandle, ServerProgram

_TIMEOUT_S = 60.0
_BUSY = frozenset((429, 502, 503, 504))
"""Statuses of a launcher that has no room, or whose engine does not answer."""


class SidecarLauncher:
    """Launcher of servers by way of a launcher service.

    Args:
        program: the kind of server; the service has its image.
        url: address of the service, ``http://HOST:PORT``.
        job: id of the job or evaluation that the servers are for.
        attempt: its attempt.

    Raises:
        ValueError: the address is malformed.
    """

    def __init__(self, program: ServerProgram, url: str, job: str, attempt: int) -> None:
        parts = urlsplit(url)
        if parts.scheme != "http" or not parts.hostname or not parts.port:
            raise ValueError(f"launcher: expected http://HOST:PORT, got {url!r}")
        self._host, self._port = parts.hostname, parts.port
        self._order = {"server": program.name, "job": job, "attempt": attempt, "count": 1}

    def start(self) -> ServerHandle:
        """Start a server; it may not listen yet.

        Raises:
            OSError: it cannot be started.
        """
        connection = HTTPConnection(self._host, self._port, timeout=_TIMEOUT_S)
        try:
            response = _ask(connection, "POST", "/servers", json.dumps(self._order))
            with _service_errors():
                (server,) = json.loads(response.readline())["servers"]
        except BaseException:
            connection.close()
            raise
        return _Sidecar(self._host, self._port, connection, response, server)


class _Sidecar:
    """One server's container."""

    def __init__(
        self, host: str, port: int, connection: HTTPConnection, response: HTTPResponse, server: dict[str, Any]
    ) -> None:
        self.address = Address(server["name"], server["agent_port"], server["monitor_port"])
        self._service = (host, port)
        self._connection: HTTPConnection | None = connection
        self._response = response

    def alive(self) -> bool:
        try:
            return bool(self._state()["running"])
        except OSError:
            return False

    def owns(self, port: int) -> bool:
        # a network of its own has no other listener
        return port in (self.address.agent_port, self.address.monitor_port)

    def describe(self) -> str:
        try:
            return str(self._state()["description"])
        except OSError as error:
            return f"container {self.address.host}: {error}"

    def stop(self) -> None:
        if self._connection is None:
            return
        with contextlib.suppress(OSError):  # closing the connection stops the server, too
            self._request("DELETE")
        self._response.close()
        self._connection.close()
        self._connection = None

    def _state(self) -> dict[str, Any]:
        with _service_errors():
            return dict(json.loads(self._request("GET")))

    def _request(self, method: str) -> bytes:
        with contextlib.closing(HTTPConnection(*self._service, timeout=_TIMEOUT_S)) as connection:
            response = _ask(connection, method, f"/servers/{self.address.host}")
            with _service_errors():
                return response.read()


def _ask(connection: HTTPConnection, method: str, path: str, body: str | None = None) -> HTTPResponse:
    """Send a request; return the answer, whose body is still to be read."""
    with _service_errors():
        connection.request(method, path, body)
        response = connection.getresponse()
        if response.status < 300:
            return response
        text = response.read(4096).decode(errors="replace")
    raise (LauncherUnavailableError if response.status in _BUSY else OSError)(f"launcher: {response.status}: {text}")


@contextlib.contextmanager
def _service_errors() -> Iterator[None]:
    """Turn the failure of a service to answer into LauncherUnavailableError."""
    try:
        yield
    except (TimeoutError, ConnectionError, HTTPException, ValueError, KeyError) as error:
        raise LauncherUnavailableError(f"launcher: no answer: {error!r}") from error
