"""Middleware of every request: an id, security headers, a limit of the body, metrics."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Mapping

from naojobs.database import is_outage
from naojobs.ids import new_id
from naojobs.store import StoreError
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from naosprint_api.problems import FieldError, ProblemError, problem_response
from naosprint_api.telemetry import Telemetry

CONTENT_SECURITY_POLICY = (
    "default-src 'self'; media-src 'self' blob:; base-uri 'none'; form-action 'self'; frame-ancestors 'none'; "
    "object-src 'none'"
)
"""Pages load resources only from this service, and cannot be framed."""

_SECURITY_HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}

_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,80}")

_log = logging.getLogger(__name__)
_access = logging.getLogger("naosprint_api.access")


class Envelope:
    """Middleware that adds request ids and security headers, and counts requests."""

    def __init__(self, app: ASGIApp, telemetry: Telemetry) -> None:
        self._app = app
        self._telemetry = telemetry

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        given = Headers(scope=scope).get("x-request-id", "")
        request_id = given if _REQUEST_ID.fullmatch(given) else new_id("req")
        scope.setdefault("state", {})["request_id"] = request_id
        started = time.monotonic()
        status = 500
        sent = False

        async def send_with_headers(message: Message) -> None:
            nonlocal status, sent
            sent = True
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = request_id
                for name, value in _SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
                if not scope["path"].startswith("/ui/"):
                    headers.setdefault("Cache-Control", "no-store")
                elif "cache-control" not in headers:
                    headers["Cache-Control"] = "no-cache"
            await send(message)

        try:
            await self._app(scope, receive, send_with_headers)
        except Exception as error:
            # The framework wraps what happens within an answer. The server cuts one that is not complete.
            cause = error.__cause__ if sent and isinstance(error.__cause__, Exception) else error
            expected = isinstance(cause, StoreError) or is_outage(cause)
            what = f"failed: {cause}" if expected else "failed"
            trace = None if expected else error
            _log.error(
                "%s %s %s", scope["method"], scope["path"], what, exc_info=trace, extra={"request_id": request_id}
            )
            if not sent:
                answer = problem_response(500, "internal error; see the service's log")
                await answer(scope, receive, send_with_headers)
        finally:
            elapsed = time.monotonic() - started
            route = route_of(scope)
            self._telemetry.observe(scope["method"], route, status, elapsed)
            _access.info(
                "%s %s %d %.1f ms",
                scope["method"],
                route,
                status,
                1000 * elapsed,
                extra={"request_id": request_id, "path": scope["path"]},
            )


def route_of(scope: Scope) -> str:
    """Return the template of the route that a handled request took, so that metrics have few labels."""
    route = scope.get("route")
    path = getattr(route, "path", None)
    if isinstance(path, str):
        return path or "/"
    return "/ui" if scope["path"].startswith("/ui/") else "(unknown)"


_NONE_LARGER: Mapping[tuple[str, str, str], int] = {}


class BodyLimit:
    """Middleware that refuses a request body that is too large, announced or not, without storing it.

    A body that is slightly too large is read to its end and discarded: many clients read the answer only when they have
    sent everything. For a larger one the connection is closed after the answer.
    """

    def __init__(self, app: ASGIApp, max_bytes: int, larger: Mapping[tuple[str, str, str], int] = _NONE_LARGER) -> None:
        self._app = app
        self._max_bytes = max_bytes
        self._larger = larger
        """Limits by method, beginning of the path, and content type: anything else there could be parsed on arrival."""
        self._patience_bytes = 16 * max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers, most = Headers(scope=scope), self._max_bytes
        for (method, start, kind), limit in self._larger.items():
            if (scope["method"], headers.get("content-type")) == (method, kind) and scope["path"].startswith(start):
                most = limit
        announced = headers.get("content-length", "0")
        if not announced.isdecimal() or int(announced) > most:
            received = 0
            if announced.isdecimal() and int(announced) <= self._patience_bytes:
                received = await self._drain(receive, received)
            error = self._error(received, most)
            await problem_response(413, error.detail, error.errors, error.headers)(scope, receive, send)
            return
        received = 0

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            if message["type"] == "http.request":
                received += len(message.get("body", b""))
                if received > most:
                    if message.get("more_body", False):
                        received = await self._drain(receive, received)
                    raise self._error(received, most)
            return message

        await self._app(scope, counted, send)

    async def _drain(self, receive: Receive, received: int) -> int:
        """Read on until the body ends or a limit is reached; return the body's bytes, 0 if it did not end."""
        while received <= self._patience_bytes:
            message = await receive()
            received += len(message.get("body", b""))
            if message["type"] != "http.request" or not message.get("more_body", False):
                return received
        return 0

    def _error(self, received: int, most: int) -> ProblemError:
        detail = f"the body is larger than {most} bytes; send less"
        _log.warning("refused a body: more than %d bytes", most)
        headers = {} if received else {"Connection": "close"}
        return ProblemError(413, detail, [FieldError(field="body", message=detail)], headers)
