"""Process that sends one alert, or checks its address: a request on standard input, the error on standard output.

Every connection is refused to whom `outbound.may_reach` does not allow, whichever library makes it, after its host has
been looked up.
"""

from __future__ import annotations

import json
import logging
import signal
import sys
from collections.abc import Sequence
from ipaddress import ip_network
from typing import Any

from apprise import Apprise, AppriseAsset, NotifyFormat
from apprise.plugins import url_to_dict

from naosprint_api.alerts import GUIDE, check_parameters, secrets_of
from naosprint_api.outbound import Network, may_reach

_CONNECTING = ("socket.connect", "socket.sendto", "socket.sendmsg")
"""Audit events of CPython before it connects or sends; their second argument is the address."""


class Guard:
    """Audit hook that lets this process reach public addresses and the allowed networks only."""

    def __init__(self, allowed: Sequence[Network]) -> None:
        self.refused = False
        self._allowed = allowed

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Raise ConnectionRefusedError before a connection to any other address."""
        if event not in _CONNECTING or arguments[1] is None:
            return
        address = arguments[1]
        try:
            reachable = isinstance(address, tuple) and may_reach(address[0], self._allowed)
        except ValueError:
            reachable = False  # a name, whose address is not known here
        if not reachable:
            self.refused = True
            raise ConnectionRefusedError("the address is not public")


class _Errors(logging.Handler):
    """What apprise reports of a failure."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.last = ""

    def emit(self, record: logging.LogRecord) -> None:
        self.last = record.getMessage()


def handle(request: dict[str, Any]) -> str | None:
    """Send the alert, or only read its address if there is no text; return the error."""
    errors = _Errors()
    logging.getLogger("apprise").addHandler(errors)
    guard = Guard([ip_network(text) for text in request.get("networks", ())])
    sys.addaudithook(guard)
    unreadable = f"expected an address that apprise can read ({GUIDE})"
    read: dict[str, Any] | None = url_to_dict(request["url"])  # type: ignore[no-untyped-call]
    if read is None:
        return unreadable
    try:  # the reading that is used, also of an address that was registered before
        check_parameters(read["schema"], read["qsd"])
    except ValueError as refused:
        return str(refused)
    service = Apprise.instantiate(read, asset=AppriseAsset(async_mode=False), suppress_exceptions=True)
    if service is None:
        return unreadable
    if "body" not in request:
        return None
    if service.notify(title=request["title"], body=request["body"], body_format=NotifyFormat.TEXT):
        return None
    if guard.refused:
        return "the host has no public address; the operator can allow private networks"
    error = errors.last or "the alert could not be sent"
    for secret in secrets_of(request["url"]):
        error = error.replace(secret, "…")
    return error[:500]


if __name__ == "__main__":
    request = json.load(sys.stdin)
    signal.setitimer(signal.ITIMER_REAL, request["deadline_s"])  # ends this process, also within a library
    json.dump({"error": handle(request)}, sys.stdout)
