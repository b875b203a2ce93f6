"""HTTP connections with deadlines and bounds, for the servers of the API and of the launcher.

uvicorn waits without limit for the head and for the body of a request, stores a head of any size, and counts no
connections of an address: a client that sends nothing keeps everybody else out.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from ipaddress import ip_address, ip_network

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of the connections of one server."""

    head_s: float = 10.0
    """Seconds in which the head of a request has to arrive, from its first byte or the start of the connection."""
    body_s: float = 60.0
    """Seconds in which each part of a body has to arrive; while the service does not read it, no time passes."""
    part_bytes: int = 1 << 20
    """Bytes of a part, so that a large body may come over a slow line."""
    head_bytes: int = 64 << 10
    """Bytes of a head, and of trailers behind a body."""
    per_address: int = 1024
    """Connections of one address."""
    trusted: str = ""
    """Addresses and networks that have no such limit because they stand for others, separated by commas; * for all."""
    stall_s: float = 1.0
    """Seconds in which a client has to read something once the server stops."""
    open: Counter[str] = field(default_factory=Counter)
    """Open connections by address."""

    def trusts(self, address: str) -> bool:
        """Return whether an address stands for others."""
        for part in (part.strip() for part in self.trusted.split(",")):
            try:
                if part == "*" or (part and ip_address(address) in ip_network(part, strict=False)):
                    return True
            except ValueError:  # a socket's name
                if part == address:
                    return True
        return False


def bounded(bounds: Bounds) -> type[HttpToolsProtocol]:
    """Return the protocol of a server with these bounds, for uvicorn's setting `http`."""

    class Bounded(BoundedProtocol):
        pass

    Bounded.bounds = bounds
    return Bounded


class BoundedProtocol(HttpToolsProtocol):
    """HTTP/1.1 connection with deadlines and bounds."""

    bounds = Bounds()

    _address = ""
    _refused = False
    _idle = True
    """Whether no request is being read: before the end of the next head."""
    _head_bytes = _part_bytes = _pending_bytes = 0
    """Bytes of names and values of the head, of a part of the body, and those that are part of nothing yet."""
    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Count the connection, or refuse it."""
        peer = transport.get_extra_info("peername")
        self._address = peer[0] if isinstance(peer, tuple) else ""
        self.bounds.open[self._address] += 1
        full = self.bounds.open[self._address] > self.bounds.per_address
        if full and self._address and not self.bounds.trusts(self._address):
            self._refused = True
            self.transport = transport
            self._refuse("503 Service Unavailable", "too many connections from this address")
            return
        super().connection_made(transport)
        self._expect(self.bounds.head_s, self._head_is_late)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self.bounds.open[self._address] -= 1
        if not self.bounds.open[self._address]:
            del self.bounds.open[self._address]
        self._expect(0, None)
        if not self._refused:
            super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Read what the client has sent."""
        if self._refused:
            return
        if self._idle and self._deadline is None:
            self._expect(self.bounds.head_s, self._head_is_late)
        self._pending_bytes += len(data)
        super().data_received(data)
        if self._pending_bytes > self.bounds.head_bytes and not self.transport.is_closing():
            self._refuse("431 Request Header Fields Too Large", f"a head has at most {self.bounds.head_bytes} bytes")

    def on_message_begin(self) -> None:
        """Begin a request."""
        self._head_bytes = 0
        self._expect(self.bounds.head_s, self._head_is_late)
        super().on_message_begin()

    def on_header(self, name: bytes, value: bytes) -> None:
        """Take a header, or a trailer. Raises ValueError, which refuses the request, for too many of them."""
        self._pending_bytes = 0
        self._head_bytes += len(name) + len(value)
        if self._head_bytes + len(self.url) > self.bounds.head_bytes:
            raise ValueError("the head is too large")
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Wait for the body."""
        self._idle = False
        self._part_bytes = 0
        self._expect(self.bounds.body_s, self._body_is_late)
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Take a part of the body."""
        self._pending_bytes = 0
        self._part_bytes += len(body)
        if self._part_bytes >= self.bounds.part_bytes:
            self._part_bytes = 0
            self._expect(self.bounds.body_s, self._body_is_late)
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Wait for nothing: the next request is the client's choice."""
        self._pending_bytes = 0
        self._idle = True
        self._expect(0, None)
        super().on_message_complete()

    def shutdown(self) -> None:
        """Stop: the running request may end, if its client reads what it gets."""
        super().shutdown()
        self._watch(self.transport.get_write_buffer_size())

    def _watch(self, before: int) -> None:
        """Cut the connection off unless some of what waits to be sent goes out in time."""

        def look() -> None:
            waiting = self.transport.get_write_buffer_size()
            if waiting and waiting >= before > 0:
                self.transport.abort()
            elif self in self.connections:
                self._watch(waiting)

        self.loop.call_later(self.bounds.stall_s, look)

    def _expect(self, seconds: float, late: Callable[[], None] | None) -> None:
        """Replace the deadline."""
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None if late is None else self.loop.call_later(seconds, late)

    def _head_is_late(self) -> None:
        if self.cycle is not None and not self.cycle.response_complete:
            self._expect(self.bounds.head_s, self._head_is_late)  # the answer to the request before it comes first
        else:
            self._refuse("408 Request Timeout", f"a head has to arrive within {self.bounds.head_s:g} s")

    def _body_is_late(self) -> None:
        if self.flow.read_paused:
            self._expect(self.bounds.body_s, self._body_is_late)
        elif self.cycle.response_started:
            self.transport.close()
        else:
            self._refuse(
                "408 Request Timeout",
                f"{self.bounds.part_bytes:,} bytes have to arrive within {self.bounds.body_s:g} s",
            )

    def _refuse(self, status: str, text: str) -> None:
        if self.transport.is_closing():
            return
        headers = f"Content-Type: text/plain\r\nContent-Length: {len(text)}\r\nConnection: close"
        self.transport.write(f"HTTP/1.1 {status}\r\n{headers}\r\n\r\n{text}".encode())
        self.transport.close()
