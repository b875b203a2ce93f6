"""Run the API: `python -m naosprint_api`, settings from the environment (`NAOSPRINT_...`)."""

from __future__ import annotations

import contextlib
import gc
import logging
import signal
import sys
from socket import socket
from types import FrameType

import uvicorn
from naojobs.settings import SETTINGS_ERRORS, settings_words
from naosim.bounded_http import Bounds, bounded
from naospec.proxies import exempt_loopback

from naosprint_api.app import create_asgi
from naosprint_api.service import Service
from naosprint_api.settings import ApiSettings

_GRACE_S = 10
"""Seconds that running requests may take when the service stops."""
_GARBAGE = 20_000
"""Allocations between two collections of garbage. Python's own 700 make a page of jobs cost a third more."""


class ApiServer(uvicorn.Server):
    """Server that closes all streams when it stops: they would never end otherwise."""

    def __init__(self, config: uvicorn.Config, service: Service) -> None:
        super().__init__(config)
        self._service = service

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """End on a signal."""
        self._service.broadcaster.closing = True
        super().handle_exit(sig, frame)

    async def shutdown(self, sockets: list[socket] | None = None) -> None:
        """End the streams, then everything else."""
        self._service.broadcaster.close()
        await super().shutdown(sockets)


def make_server(settings: ApiSettings) -> ApiServer:
    """Return a server that is ready to run."""
    asgi, service = create_asgi(settings)
    bounds = Bounds(per_address=settings.api_max_connections_per_address, trusted=settings.api_trusted_proxies)
    config = uvicorn.Config(
        asgi,
        host=settings.api_host,
        port=settings.api_port,
        access_log=False,
        log_config=None,
        http=bounded(bounds),
        server_header=False,
        proxy_headers=bool(settings.api_trusted_proxies),
        forwarded_allow_ips=settings.api_trusted_proxies,
        timeout_graceful_shutdown=_GRACE_S,
        timeout_keep_alive=30,
        limit_concurrency=4096,
        backlog=1024,
    )
    return ApiServer(config, service)


def answer_evenly() -> None:
    """Keep the interpreter's own work from delaying single requests.

    Objects loaded so far are permanent: searching them for garbage takes 100 ms each time, during which no request is
    answered.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(_GARBAGE, 20, 20)


def main() -> int:
    """Run until a signal ends it; return the exit code."""
    exempt_loopback()
    logging.basicConfig(
        stream=sys.stderr, level=logging.INFO, format="%(asctime)s %(levelname)-7s %(name)s: %(message)s"
    )
    try:
        settings = ApiSettings()  # type: ignore[call-arg]  # the environment fills it
    except SETTINGS_ERRORS as error:
        sys.stderr.write(settings_words(error))
        return 2
    server = make_server(settings)
    answer_evenly()
    with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C; the server has ended in order
        server.run()
    return 0 if server.started else 1


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    raise SystemExit(main())
