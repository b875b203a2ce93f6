"""Free TCP ports of the loopback interface."""

from __future__ import annotations

import socket

from naospec.ports import free_ports

HOST = "127.0.0.1"

Address = tuple[str, int]
"""IP address and port."""


def is_free(port: int) -> bool:
    """Return whether a server could listen on the port; connections of a server that has just stopped do not matter."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
            probe.listen(1)
        except OSError:
            return False
        return True


def choose(preferred: list[int]) -> int:
    """Return the first of the preferred ports that is free, else any free one."""
    for port in preferred:
        if is_free(port):
            return port
    return next(free_ports(HOST))
