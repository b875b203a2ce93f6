"""Ports of the loopback for servers of tests, reserved until the process ends."""

from __future__ import annotations

import atexit

from naosim.launchers import PortLease


def reserved_port() -> int:
    """Return a free port that no test of any process on this machine is given besides."""
    lease = PortLease(1)
    atexit.register(lease.release)
    return lease.ports[0]
