"""Proxies of the environment, which are never used for this machine itself."""

from __future__ import annotations

import os
from ipaddress import ip_address

LOOPBACK = ("localhost", "127.0.0.1", "::1")


def is_loopback(host: str) -> bool:
    """Return whether a host's name or address is that of this machine's loopback interface."""
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host.lower().rstrip(".") == "localhost" or host.lower().rstrip(".").endswith(".localhost")


def exempt_loopback() -> None:
    """Add the loopback addresses to ``NO_PROXY``, which every HTTP library and child process respects."""
    given = [word.strip() for name in ("NO_PROXY", "no_proxy") for word in os.environ.get(name, "").split(",")]
    value = ",".join(dict.fromkeys([*filter(None, given), *LOOPBACK]))
    os.environ["NO_PROXY"] = os.environ["no_proxy"] = value
