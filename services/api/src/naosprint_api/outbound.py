"""Requests to addresses that users choose: only to public addresses, or to networks that the operator allows."""

from __future__ import annotations

import asyncio
import math
import socket
import ssl
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from typing import Any, TypeAlias
from weakref import WeakValueDictionary

import anyio
import httpcore

Network: TypeAlias = IPv4Network | IPv6Network

_INTERNET_6 = IPv6Network("2000::/3")
"""Addresses of hosts on the Internet; every other IPv6 address may stand for another one, such as a private one."""
_SPECIAL: tuple[Network, ...] = tuple(
    ip_network(text)
    for text in (
        "0.0.0.0/8",
        "10.0.0.0/8",
        "100.64.0.0/10",
        "127.0.0.0/8",
        "169.254.0.0/16",
        "172.16.0.0/12",
        "192.0.0.0/24",
        "192.0.2.0/24",
        "192.31.196.0/24",
        "192.52.193.0/24",
        "192.88.99.0/24",
        "192.168.0.0/16",
        "192.175.48.0/24",
        "198.18.0.0/15",
        "198.51.100.0/24",
        "203.0.113.0/24",
        "224.0.0.0/3",
        "2001::/23",
        "2001:db8::/32",
        "2002::/16",
        "2620:4f:8000::/48",
        "3fff::/20",
    )
)
"""Networks with another purpose, by IANA's registries of special-purpose addresses: Python's own list differs between
its patch releases.
"""


class RefusedAddressError(Exception):
    """Address that requests may not be sent to."""


def may_reach(address: str, allowed: Sequence[Network] = ()) -> bool:
    """Return whether requests may be sent to an IP address: a public one, or one in an `allowed` network."""
    ip: IPv4Address | IPv6Address = ip_address(address)
    if isinstance(ip, IPv6Address):
        ip = ip.ipv4_mapped or ip
    if any(ip in network for network in allowed):
        return True
    if isinstance(ip, IPv6Address) and ip not in _INTERNET_6:
        return False
    return not any(ip in network for network in _SPECIAL)


def is_refused_literal(host: str, allowed: Sequence[Network]) -> bool:
    """Return whether the host of a URL is an IP address, or a name of this machine, that is refused in any case.

    No name is one with an empty part, such as `..`.
    """
    name = host.strip("[]").lower()
    name = name[:-1] if name.endswith(".") else name
    if "" in name.split(".") and ":" not in name:
        return True
    if name == "localhost" or name.endswith(".localhost"):
        name = "127.0.0.1"
    try:
        return not may_reach(name, allowed)
    except ValueError:
        return False  # a name, which is looked up for each request


class _Backend(httpcore.AnyIOBackend):
    """Network backend that connects to the first of some addresses that answers, whatever the host's name is."""

    def __init__(self, addresses: Sequence[str]) -> None:
        super().__init__()
        self._addresses = addresses

    async def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.AsyncNetworkStream:
        """Connect. Raises httpcore.ConnectError."""
        for address in self._addresses[:-1]:
            try:
                return await super().connect_tcp(address, port, timeout, local_address, socket_options)
            except (httpcore.ConnectError, httpcore.ConnectTimeout):
                continue
        return await super().connect_tcp(self._addresses[-1], port, timeout, local_address, socket_options)


class Sender:
    """Sender of POST requests that follows no redirect and reads no body of an answer.

    A look-up of a name cannot be cancelled. So it has a thread of its own, and each owner a number of places for them:
    slow name servers of one owner hold up no request of another.
    """

    def __init__(self, allowed: Sequence[Network], *, deadline_s: float, lookups: int = 16) -> None:
        """Allow private networks; `lookups` is the number of names that are looked up at a time for one owner."""
        self._allowed = allowed
        self._deadline_s = deadline_s
        self._lookups = lookups
        self._places: WeakValueDictionary[str, asyncio.Semaphore] = WeakValueDictionary()
        self._threads = anyio.CapacityLimiter(math.inf)
        self._tls = ssl.create_default_context()

    async def post(self, owner: str, url: str, headers: Mapping[str, str], body: bytes) -> int:
        """Send a request and return the status of its answer. The deadline begins when `owner` has a place.

        Raises:
            RefusedAddressError: the host has no address that requests may be sent to.
            TimeoutError: the answer did not begin within the deadline.
            Exception: the look-up, the connection or the protocol failed.
        """
        host = httpcore.URL(url).host.decode("ascii")
        place = self._places.setdefault(owner, asyncio.Semaphore(self._lookups))
        await place.acquire()
        look_up = asyncio.create_task(self._addresses_of(host))
        look_up.add_done_callback(lambda done: _leave(place, done))
        with anyio.fail_after(self._deadline_s):
            backend = _Backend(await asyncio.shield(look_up))
            # A connection of its own: each request looks its host up again.
            async with (
                httpcore.AsyncConnectionPool(ssl_context=self._tls, network_backend=backend) as pool,
                pool.stream("POST", url, headers=list(headers.items()), content=body) as response,
            ):
                return response.status

    async def _addresses_of(self, host: str) -> list[str]:
        """Return the addresses of a host that requests may be sent to. Raises RefusedAddressError, ConnectError."""
        call = partial(socket.getaddrinfo, host, None, type=socket.SOCK_STREAM)
        try:
            found = await anyio.to_thread.run_sync(call, limiter=self._threads, abandon_on_cancel=True)
        except (OSError, UnicodeError) as error:
            raise httpcore.ConnectError(f"the name of the host cannot be looked up: {error}") from error
        addresses = dict.fromkeys(str(item[4][0]) for item in found)
        reachable = [address for address in addresses if may_reach(address, self._allowed)]
        if not reachable:
            raise RefusedAddressError("the host has no public address; the operator can allow private networks")
        return reachable


def _leave(place: asyncio.Semaphore, look_up: asyncio.Task[list[str]]) -> None:
    """Free the place of a look-up that has ended; its request may be over."""
    place.release()
    if not look_up.cancelled():
        look_up.exception()
