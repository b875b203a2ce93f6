"""A process of the API under connections that misbehave, all of one address."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import httpx
import psutil
import pytest

from tests.ports import reserved_port

HEAD = b"POST /jobs HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"
MIB = 1 << 20


class Process:
    """One process of the API."""

    def __init__(self, environment: dict[str, str]) -> None:
        self.port = reserved_port()
        settings = environment | {"NAOSPRINT_API_PORT": str(self.port)}
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "naosprint_api"], env={**os.environ, **settings}, stderr=subprocess.DEVNULL
        )

    def connect(self, address: str = "127.0.0.1") -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), 20, (address, 0))

    def answers(self, address: str = "127.0.0.1") -> int:
        """Return the status of a request from an address."""
        transport = httpx.HTTPTransport(local_address=address)
        with httpx.Client(transport=transport, timeout=20) as client:
            return client.get(f"http://127.0.0.1:{self.port}/readyz").status_code

    def memory(self) -> int:
        return int(psutil.Process(self.process.pid).memory_info().rss)


@pytest.fixture(scope="module")
def process(service_environment: dict[str, str]) -> Iterator[Process]:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    running = Process(service_environment)
    until = time.monotonic() + 60
    while True:
        with contextlib.suppress(httpx.TransportError):
            assert running.answers() == 200
            break
        assert running.process.poll() is None and time.monotonic() < until
        time.sleep(0.05)
    yield running
    running.process.terminate()
    assert running.process.wait(30) in (0, -signal.SIGTERM)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize(
    "sent",
    [b"", HEAD, HEAD + b"Content-Length: 100\r\n\r\n{"],
    ids=["nothing", "half a head", "half a body"],
)
def test_4200_half_sent_requests_leave_room_for_others(process: Process, sent: bytes) -> None:
    before = process.memory()
    with contextlib.ExitStack() as held:
        for _ in range(4200):
            connection = held.enter_context(process.connect())
            with contextlib.suppress(ConnectionError):  # refused
                connection.sendall(sent)
        assert process.answers("127.0.0.2") == 200
        assert process.memory() - before < 100 * MIB
    until = time.monotonic() + 20
    while process.answers() != 200:  # until the process has seen that they are closed
        assert time.monotonic() < until


@pytest.mark.parametrize(
    "pieces",
    [
        lambda: (HEAD, *([b"a: " + b"b" * 8_000 + b"\r\n"] * 48_000)),
        lambda: (HEAD + b"a: ", *([b"b" * 8_000] * 48_000)),
        lambda: (b"GET /", *([b"b" * 8_000] * 48_000)),
        lambda: (HEAD + b"Transfer-Encoding: chunked\r\n\r\n1;", *([b"b" * 8_000] * 48_000)),
    ],
    ids=["many", "long", "address", "chunk"],
)
def test_a_head_of_384_mib_takes_no_memory(process: Process, pieces: Callable[[], tuple[bytes, ...]]) -> None:
    before = process.memory()
    with process.connect() as connection, contextlib.suppress(ConnectionError):
        for piece in pieces():
            connection.sendall(piece)
        assert connection.recv(4096)[:12] in (b"", b"HTTP/1.1 400", b"HTTP/1.1 431", b"HTTP/1.1 401")
    assert process.memory() - before < 20 * MIB
    assert process.answers() == 200
