"""HTTP connections with deadlines and bounds, by sockets that misbehave."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator

import pytest
import uvicorn
from naosim.bounded_http import Bounds, bounded
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

GET = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
POST = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n"
CHUNKED = b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"


async def endless() -> AsyncIterator[bytes]:
    while True:
        yield b"x" * 100_000
        await asyncio.sleep(0)


async def answer(scope: Scope, receive: Receive, send: Send) -> None:
    """Read the body, then answer with its length; /endless never ends."""
    if scope["type"] != "http":
        return
    size, more = 0, True
    while more:
        message = await receive()
        if message["type"] == "http.disconnect":
            return
        size += len(message.get("body", b""))
        more = message.get("more_body", False)
    text = str(size).encode()
    if scope["path"] == "/endless":
        await StreamingResponse(endless())(scope, receive, send)
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": text})


class Running:
    """A server on a port of the loopback."""

    def __init__(self, bounds: Bounds) -> None:
        listener = socket.create_server(("127.0.0.1", 0))
        self.port = listener.getsockname()[1]
        config = uvicorn.Config(answer, http=bounded(bounds), lifespan="off", log_level="critical", proxy_headers=False)
        config.timeout_graceful_shutdown = 20
        self.server = uvicorn.Server(config)
        self.thread = threading.Thread(target=self.server.run, args=([listener],))
        self.thread.start()

    def connect(self, receive_buffer: int | None = None) -> socket.socket:
        connection = socket.socket()
        if receive_buffer is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        connection.settimeout(10)
        connection.connect(("127.0.0.1", self.port))
        return connection

    def stop(self) -> float:
        began = time.monotonic()
        self.server.should_exit = True
        self.thread.join(20)
        return time.monotonic() - began


@pytest.fixture
def run() -> Iterator[Callable[..., Running]]:
    running: list[Running] = []

    def start(**bounds: float | int | str) -> Running:
        running.append(Running(Bounds(**bounds)))  # type: ignore[arg-type]
        return running[-1]

    yield start
    for server in running:
        server.stop()


def read_all(connection: socket.socket) -> bytes:
    """Return everything until the server closes the connection."""
    content = b""
    try:
        while piece := connection.recv(65_536):
            content += piece
    except ConnectionResetError:
        pass
    return content


@pytest.mark.parametrize(
    "sent",
    [b"", b"\r\n", b"GE", b"GET / HTTP/1.1\r\nHost: ", GET + b"GET /", POST % 5 + b"xxxxx" + b"P"],
    ids=["nothing", "line", "method", "header", "second", "after-body"],
)
def test_a_head_has_to_arrive_in_time(run: Callable[..., Running], sent: bytes) -> None:
    server = run(head_s=0.2)
    with server.connect() as connection:
        connection.sendall(sent)
        assert b" 408 " in read_all(connection)


@pytest.mark.parametrize("sent", [POST % 5, POST % 5 + b"xxxx", CHUNKED + b"3\r\nx"], ids=["none", "part", "chunk"])
def test_a_body_has_to_arrive_in_time(run: Callable[..., Running], sent: bytes) -> None:
    server = run(body_s=0.2)
    with server.connect() as connection:
        connection.sendall(sent)
        assert b" 408 " in read_all(connection)


def test_a_large_body_may_come_slowly_and_no_part_of_it_late(run: Callable[..., Running]) -> None:
    server = run(body_s=0.6, part_bytes=1000)
    with server.connect() as connection:
        connection.sendall(POST % 4000)
        for _ in range(4):  # together they take longer than one part may
            connection.settimeout(0.25)
            with pytest.raises(TimeoutError):
                connection.recv(1)
            connection.sendall(b"x" * 1000)
        connection.settimeout(10)
        assert b"4000" in connection.recv(65_536)
        connection.sendall(POST % 4000 + b"x" * 1999)
        assert b" 408 " in read_all(connection)


def test_a_drip_does_not_extend_a_deadline(run: Callable[..., Running]) -> None:
    server = run(head_s=0.3)
    with server.connect() as connection:
        began = time.monotonic()
        connection.sendall(b"GET / HTTP/1.1\r\n")
        connection.settimeout(0.02)
        while time.monotonic() - began < 5:
            try:
                if not connection.recv(1):
                    break
                continue
            except TimeoutError:
                pass
            except ConnectionError:
                break
            try:
                connection.sendall(b"a: b\r\n")
            except ConnectionError:
                break
        assert time.monotonic() - began < 4


@pytest.mark.parametrize(
    "pieces",
    [
        [b"GET / HTTP/1.1\r\n", *([b"a: " + b"b" * 1000 + b"\r\n"] * 2_000)],
        [b"GET / HTTP/1.1\r\na: ", *([b"b" * 1000] * 2_000)],
        [b"GET /", *([b"b" * 1000] * 2_000)],
        [CHUNKED + b"0\r\na: ", *([b"b" * 1000] * 2_000)],
        [CHUNKED + b"0\r\n", *([b"a: " + b"b" * 1000 + b"\r\n"] * 2_000)],
    ],
    ids=["many", "long", "address", "long-trailer", "many-trailers"],
)
def test_a_head_has_a_limit(run: Callable[..., Running], pieces: list[bytes]) -> None:
    server = run()
    with server.connect() as connection:
        try:
            for piece in pieces:
                connection.sendall(piece)
        except ConnectionError:
            return  # refused and closed
        assert read_all(connection)[:12] in (b"HTTP/1.1 400", b"HTTP/1.1 431", b"")


def test_a_large_body_is_no_large_head(run: Callable[..., Running]) -> None:
    server = run()
    with server.connect() as connection:
        connection.sendall(POST % 3_000_000 + b"x" * 3_000_000)
        assert b"3000000" in connection.recv(65_536)
        connection.sendall(CHUNKED + b"186a0\r\n" + b"x" * 100_000 + b"\r\n0\r\n\r\n")
        assert b"100000" in connection.recv(65_536)


def test_one_address_has_a_share_of_the_connections(run: Callable[..., Running]) -> None:
    server = run(per_address=3)
    held = [server.connect() for _ in range(3)]
    try:
        for connection in held:
            connection.sendall(GET)
            assert b" 200 " in connection.recv(65_536)
        with server.connect() as one_more:
            assert b" 503 " in read_all(one_more)
        held.pop().close()
        deadline = time.monotonic() + 5
        while True:
            with server.connect() as again:
                again.sendall(GET)
                if b" 200 " in again.recv(65_536):
                    break
            assert time.monotonic() < deadline
    finally:
        for connection in held:
            connection.close()


@pytest.mark.parametrize(
    ("trusted", "held"), [("127.0.0.1", 10), ("10.0.0.0/8, 127.0.0.0/8", 10), ("*", 10), ("10.0.0.0/8", 3)]
)
def test_a_proxy_stands_for_others(run: Callable[..., Running], trusted: str, held: int) -> None:
    server = run(per_address=3, trusted=trusted)
    connections = [server.connect() for _ in range(10)]
    good = 0
    for connection in connections:
        try:
            connection.sendall(GET)
            good += b" 200 " in connection.recv(65_536)
        except ConnectionError:
            pass
    for connection in connections:
        connection.close()
    assert good == held


def test_a_client_that_does_not_read_does_not_delay_the_end(run: Callable[..., Running]) -> None:
    server = run(stall_s=0.2)
    connections = [server.connect(receive_buffer=4096) for _ in range(10)]
    for connection in connections:
        connection.sendall(GET.replace(b"/ ", b"/endless "))
        assert connection.recv(10)
    assert server.stop() < 5
    for connection in connections:
        connection.close()
