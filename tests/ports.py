"""Ports of the loopback for servers of tests, reserved until the process ends."""

from __future__ import annotations

from naosim.launchers import PortLease

_LEASES: list[PortLease] = []


def reserved_port() -> int:
    """Return a free port that no test of any process on this machine is given besides."""
    _LEASES.append(PortLease(1))
    return _LEASES[-1].ports[0]
