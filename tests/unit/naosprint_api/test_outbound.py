"""Requests to addresses that users choose."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ipaddress import ip_network
from typing import Any

import pytest
from naosprint_api.outbound import RefusedAddressError, Sender, is_refused_literal, may_reach
from naosprint_api.settings import ApiSettings
from pydantic import ValidationError

LOOPBACK = (ip_network("127.0.0.0/8"),)


@pytest.mark.parametrize("address", ["9.9.9.9", "2620:fe::fe", "::ffff:9.9.9.9"])
def test_public_addresses_may_be_reached(address: str) -> None:
    assert may_reach(address)


@pytest.mark.parametrize(
    "address",
    [
        "127.0.0.1",
        "10.1.2.3",
        "172.16.0.1",
        "192.168.1.1",
        "169.254.169.254",
        "100.64.0.1",
        "0.0.0.0",
        "224.0.0.1",
        "255.255.255.255",
        "::1",
        "::",
        "fe80::1",
        "fd00::1",
        "ff02::1",
        "::ffff:127.0.0.1",
        "64:ff9b::7f00:1",
        "2002:7f00:1::",
        "2001:0:7f00:1::",
        "192.0.0.192",
        "192.0.0.9",
        "192.88.99.1",
        "198.18.0.1",
        "203.0.113.9",
        "240.0.0.1",
        "3fff::1",
        "2001:db8::1",
        "2001:20::1",
        "5f00::1",
        "100::1",
    ],
)
def test_all_others_may_not(address: str) -> None:
    assert not may_reach(address)


def test_an_operator_may_allow_networks() -> None:
    allowed = (ip_network("10.20.0.0/16"), ip_network("fd00::/8"))
    assert may_reach("10.20.3.4", allowed) and may_reach("::ffff:10.20.3.4", allowed) and may_reach("fd00::1", allowed)
    assert not may_reach("10.21.0.1", allowed)


@pytest.mark.parametrize(
    ("host", "refused"),
    [
        ("127.0.0.1", True),
        ("[::1]", True),
        ("localhost", True),
        ("a.LOCALHOST.", True),
        ("example.org", False),
        ("....", True),
        ("a..b", True),
        (".", True),
        ("", True),
        (".a", True),
        ("a.", False),
    ],
)
def test_hosts_that_are_refused_in_any_case(host: str, refused: bool) -> None:
    assert is_refused_literal(host, ()) is refused
    assert not is_refused_literal("127.0.0.1", LOOPBACK)


def test_the_setting_names_networks() -> None:
    def settings(networks: str) -> ApiSettings:
        return ApiSettings(
            mode="local",
            database_url="postgresql:///none",
            broker_url="redis://none",
            artifact_url="file:///none",
            api_webhook_networks=networks,
        )

    assert settings("127.0.0.1/32, fd00::/8").api_webhook_networks == (
        ip_network("127.0.0.1/32"),
        ip_network("fd00::/8"),
    )
    with pytest.raises(ValidationError, match="host bits set; expected for example"):
        settings("10.0.0.1/8")


@contextmanager
def listening(answer: Callable[[socket.socket], None]) -> Iterator[int]:
    """Accept connections on the loopback and treat each with `answer`; yield the port."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            while True:
                try:
                    connection, _ = listener.accept()
                except OSError:
                    return
                with connection:
                    answer(connection)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield listener.getsockname()[1]
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join()


def post(url: str, *, deadline_s: float = 5.0) -> int:
    return asyncio.run(Sender(LOOPBACK, deadline_s=deadline_s).post("alice", url, {"x": "y"}, b"{}"))


def test_a_name_is_looked_up_once_and_only_allowed_addresses_are_connected_to(monkeypatch: pytest.MonkeyPatch) -> None:
    """A second lookup could have another result: the address that was checked is the one that is used."""
    lookups: list[str] = []
    addresses = ["10.0.0.1", "127.0.0.1"]

    def look_up(host: Any, port: Any, *_: Any, **__: Any) -> list[Any]:
        lookups.append(host)
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port)) for address in addresses]

    received: list[bytes] = []

    def accept(connection: socket.socket) -> None:
        received.append(connection.recv(4096))
        connection.sendall(b"HTTP/1.1 204 No Content\r\n\r\n")

    with listening(accept) as port:
        monkeypatch.setattr(socket, "getaddrinfo", look_up)
        assert post(f"http://receiver.example:{port}/path") == 204
        assert len(lookups) == 1
        assert f"Host: receiver.example:{port}".encode() in received[0]
        addresses.remove("127.0.0.1")
        with pytest.raises(RefusedAddressError):
            post(f"http://receiver.example:{port}/path")
    assert len(received) == 1


def test_slow_name_servers_hold_up_only_their_owner(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does a request of the same owner fail while it waits for a place."""
    over = threading.Event()
    look_up = socket.getaddrinfo

    def slow(host: Any, *rest: Any, **named: Any) -> Any:
        if host == "slow.example":
            over.wait(60)
        return look_up("127.0.0.1", *rest, **named)

    def accept(connection: socket.socket) -> None:
        connection.recv(4096)
        connection.sendall(b"HTTP/1.1 204 No Content\r\n\r\n")

    async def send(port: int) -> None:
        sender = Sender(LOOPBACK, deadline_s=2.0, lookups=40)

        def begin(owner: str, host: str) -> asyncio.Task[int]:
            return asyncio.create_task(sender.post(owner, f"http://{host}:{port}/", {}, b"{}"))

        held = [begin("mallory", "slow.example") for _ in range(40)]
        assert await begin("alice", "receiver.example") == 204
        waiting = begin("mallory", "receiver.example")
        assert [type(error) for error in await asyncio.gather(*held, return_exceptions=True)] == [TimeoutError] * 40
        await asyncio.sleep(0.2)
        assert not waiting.done()
        over.set()
        assert await waiting == 204

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    with listening(accept) as port:
        try:
            asyncio.run(send(port))
        finally:
            over.set()


def test_redirects_are_not_followed() -> None:
    received: list[bytes] = []

    def redirect(connection: socket.socket) -> None:
        received.append(connection.recv(4096))
        connection.sendall(b"HTTP/1.1 307 Elsewhere\r\nLocation: /secret\r\nContent-Length: 0\r\n\r\n")

    with listening(redirect) as port:
        assert post(f"http://127.0.0.1:{port}/") == 307
    assert len(received) == 1


@pytest.mark.parametrize("slowly", [False, True])
def test_a_receiver_that_does_not_finish_meets_a_deadline(slowly: bool) -> None:
    """A single byte now and then does not extend it."""
    over = threading.Event()

    def hang(connection: socket.socket) -> None:
        connection.recv(4096)
        connection.sendall(b"HTTP/1.1 200 OK\r\nx: ")
        while not over.wait(0.05):
            if slowly:
                try:
                    connection.sendall(b"y")
                except OSError:
                    return

    with listening(hang) as port:
        try:
            with pytest.raises(TimeoutError):
                post(f"http://127.0.0.1:{port}/", deadline_s=0.4)
        finally:
            over.set()


def test_the_body_of_an_answer_is_not_read() -> None:
    def endless(connection: socket.socket) -> None:
        connection.recv(4096)
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 1000000000\r\n\r\n")

    with listening(endless) as port:
        assert post(f"http://127.0.0.1:{port}/") == 200
