"""Free TCP ports that no program is given by chance."""

from __future__ import annotations

import secrets
import socket
from collections.abc import Iterator
from pathlib import Path

_RANGE = Path("/proc/sys/net/ipv4/ip_local_port_range")
_FIRST, _FEWEST = 20_000, 1000
_USUAL_FIRST_GIVEN = 32_768


def free_ports(host: str = "127.0.0.1") -> Iterator[int]:
    """Yield ports on which a server can listen now, from a random one on.

    They are below those that the system gives to connections and to servers without a port of their own. One of these
    could be taken between its choice and the server's start.

    Args:
        host: address of the interface.
    """
    count = _first_given() - _FIRST
    if count < _FEWEST:  # the system gives nearly all of them
        while True:
            with socket.socket() as probe:
                probe.bind((host, 0))
                port = int(probe.getsockname()[1])
            yield port
    start = secrets.randbelow(count)
    for number in range(count):
        port = _FIRST + (start + number) % count
        with socket.socket() as probe:
            try:
                probe.bind((host, port))
            except OSError:
                continue
        yield port


def _first_given() -> int:
    """Return the first of the ports that the system gives away."""
    try:
        return int(_RANGE.read_text(encoding="ascii").split()[0])
    except (OSError, ValueError, IndexError):
        return _USUAL_FIRST_GIVEN
