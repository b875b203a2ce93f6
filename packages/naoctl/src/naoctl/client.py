"""Client of the HTTP API: requests, errors, and streams that reconnect."""

from __future__ import annotations

import json
import ssl
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import httpx
from httpx_sse import SSEError, connect_sse
from naospec.proxies import is_loopback

from naoctl import __version__
from naoctl.config import Target
from naoctl.errors import CliError, ExitCode, InvalidInput, Unreachable, plain

Json = dict[str, Any]

TIMEOUT_S = httpx.Timeout(30.0, connect=5.0)
"""Timeouts of a request."""
STREAM_SILENCE_S = 60.0
"""Seconds without data after which a stream counts as lost; the service sends comments more often."""
RECONNECT_FIRST_S, RECONNECT_LAST_S = 0.5, 10.0
"""Seconds between attempts to reconnect: the first delay, doubled each time, and the longest."""


NO_CERTIFICATES = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
"""For connections without TLS: reading the certificates of all authorities takes longer than a request."""


class ApiError(CliError):
    """Error response of the service."""

    def __init__(self, message: str, *, status: int, fix: str | None, code: ExitCode, problem: Json) -> None:
        super().__init__(message, fix=fix, code=code)
        self.status = status
        self.problem = problem


@dataclass(frozen=True)
class StreamEvent:
    """Server-sent event: its type, its id and its decoded JSON."""

    kind: str
    id: str
    data: Any


class Client:
    """Connection to a service with a token.

    A failed connection raises ``Unreachable``; a status of 400 or above raises ``ApiError`` with the service's message
    and a fix.
    """

    def __init__(self, target: Target, *, transport: httpx.BaseTransport | None = None) -> None:
        self.target = target
        headers = {"User-Agent": f"naoctl/{__version__}", "Accept": "application/json"}
        if target.token:
            headers["Authorization"] = f"Bearer {target.token}"
        url = httpx.URL(target.url)
        try:
            self._http = httpx.Client(
                base_url=target.url,
                headers=headers,
                timeout=TIMEOUT_S,
                transport=transport,
                follow_redirects=False,
                # proxies of the environment are for other machines, its certificates for all
                trust_env=not is_loopback(url.host),
                verify=httpx.create_ssl_context() if url.scheme == "https" else NO_CERTIFICATES,
            )
        except (ImportError, OSError, ValueError, httpx.InvalidURL) as error:
            raise InvalidInput(
                f"The proxy or certificate settings of the environment cannot be used: {error}",
                fix="Correct HTTP_PROXY, HTTPS_PROXY, ALL_PROXY, SSL_CERT_FILE or SSL_CERT_DIR, or unset them.",
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._http.close()

    def request(
        self,
        method: str,
        path: str,
        *,
        json_body: Any = None,
        archive: bytes | None = None,
        params: Mapping[str, Any] | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> Any:
        """Send a request and return the decoded JSON of the answer, or None when the answer has no body.

        The body is JSON, a tar archive, or empty.
        """
        given = {name: value for name, value in (params or {}).items() if value is not None}
        sent = {**(headers or {}), **({} if archive is None else {"Content-Type": "application/octet-stream"})}
        try:
            response = self._http.request(
                method, _own_path(path), json=json_body, content=archive, params=given, headers=sent
            )
        except httpx.TransportError as error:
            raise unreachable(self.target.url, error) from None
        except ValueError as error:  # JSON has no word for nan
            raise InvalidInput(f"{method} {path}: {error}", fix="Send finite numbers only.") from None
        raise_for_problem(response)
        if not response.content:
            return None
        try:
            return response.json()
        except ValueError:
            raise CliError(
                f"{self.target.url} answered {method} {path} with something other than JSON",
                fix="Check that this is the address of a naosprint service.",
            ) from None

    def get(self, path: str, **params: Any) -> Any:
        """GET a path; parameters that are None are omitted."""
        return self.request("GET", path, params=params)

    def post(self, path: str, body: Any = None, *, headers: Mapping[str, str] | None = None) -> Any:
        """POST a JSON body, or nothing."""
        return self.request("POST", path, json_body=body, headers=headers)

    def pages(self, path: str, *, limit: int, **params: Any) -> Iterator[Json]:
        """Yield up to ``limit`` items of a paged list, following its cursor."""
        cursor: str | None = None
        left = limit
        while left > 0:
            page = self.get(path, limit=min(left, 200), cursor=cursor, **params)
            items = page["items"][:left]
            yield from items
            left -= len(items)
            cursor = page.get("next_cursor")
            if not cursor or not items:
                return

    def every(self, path: str, **params: Any) -> list[Json]:
        """Return all items of a paged list."""
        return list(self.pages(path, limit=sys.maxsize, **params))

    def open_stream(self, path: str, headers: Mapping[str, str]) -> Any:
        """Return the context manager of a streamed GET; the caller checks the answer."""
        return self._http.stream("GET", _own_path(path), headers=dict(headers))

    def events(
        self,
        path: str,
        *,
        last_id: str = "",
        patience_s: float = 300.0,
        on_lost: Callable[[str, float], None] | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> Iterator[StreamEvent]:
        """Yield server-sent events; reconnect after a lost connection and continue after the last event.

        Args:
            path: the stream.
            last_id: id of the event to start after; empty for the beginning.
            patience_s: seconds without a connection after which to give up.
            on_lost: called with the reason and the seconds until the next attempt.
            sleep: function that waits between attempts.

        Raises:
            Unreachable: if there was no connection for ``patience_s``.
            ApiError: if the service refuses the request.
        """
        wait_s, lost_at = RECONNECT_FIRST_S, None
        while True:
            headers = {"Last-Event-ID": last_id} if last_id else {}
            reason = "the stream ended"
            try:
                timeout = httpx.Timeout(STREAM_SILENCE_S, connect=5.0)
                with connect_sse(self._http, "GET", _own_path(path), headers=headers, timeout=timeout) as source:
                    raise_for_problem(source.response)
                    for message in source.iter_sse():
                        wait_s, lost_at = RECONNECT_FIRST_S, None
                        last_id = message.id or last_id
                        if message.data:
                            yield StreamEvent(message.event, message.id, json.loads(message.data))
            except ApiError as error:
                # A service that starts, or that restarts behind a proxy, answers with these; all others are final.
                if error.status not in (429, 502, 503, 504):
                    raise
                reason = error.message
            except (httpx.TransportError, SSEError, ValueError) as error:
                reason = _reason(error)
            now = time.monotonic()
            lost_at = lost_at if lost_at is not None else now
            if now - lost_at > patience_s:
                raise Unreachable(self.target.url, reason)
            if on_lost:
                on_lost(reason, wait_s)
            sleep(wait_s)
            wait_s = min(2 * wait_s, RECONNECT_LAST_S)


def _own_path(path: str) -> str:
    """Return the path of an address of the service, which alone gets the token.

    Raises:
        CliError: if it is the address of another service.
    """
    if not path.startswith("/") or path.startswith("//"):
        raise CliError(
            f"The service named the address {path!r}, which is not one of its own",
            fix="Nothing was sent; do not trust this service.",
        )
    return path


def unreachable(url: str, error: httpx.TransportError) -> CliError:
    """Return the error of a failed connection."""
    return Unreachable(url, _reason(error))


_HINTS = {
    "jobs": ("`naoctl list` shows all jobs.", "`naoctl status JOB` shows the job's state."),
    "policies": ("`naoctl policies list` shows all policies.", None),
    "studies": ("`naoctl study list` shows all studies.", "`naoctl study show STUDY` shows the study and its trials."),
    "matches": ("`naoctl match list` shows all matches.", "`naoctl match show MATCH` shows the match's state."),
    "teams": ("`naoctl team list` shows all teams.", None),
    "webhooks": ("`naoctl webhook list` shows all webhooks.", None),
    "tokens": ("`naoctl token list` shows all tokens.", None),
    "workers": ("`naoctl workers` shows all workers.", None),
}
"""By the first part of an address, where to look if something does not exist, and if it is in the way."""


def raise_for_problem(response: httpx.Response) -> None:
    """Raise ``ApiError`` for an unsuccessful response, with the message of its problem document."""
    status = response.status_code
    if status < 300:
        return
    response.read()
    problem: Json = {}
    try:
        decoded = response.json()
        if isinstance(decoded, dict):
            problem = decoded
    except ValueError:
        pass
    detail = str(problem.get("detail") or problem.get("title") or response.reason_phrase or f"HTTP {status}")
    fields = [
        f"{item.get('field')}: {item.get('message')}" for item in problem.get("errors") or () if isinstance(item, dict)
    ]
    has_fields = fields and status in (400, 422)
    # what begins with a name stays as it is
    first, parts = plain(detail, " ", keep="").partition(" ")[0], response.request.url.path.split("/")
    sentence = detail[:1].upper() + detail[1:] if first.isalpha() and first not in parts else detail
    message = "; ".join(fields) if has_fields else sentence.rstrip(".")
    code, fix = ExitCode.FAILURE, None
    shows_all, shows_one = _HINTS.get(parts[1], (None, None))
    if status in (301, 302, 303, 307, 308):
        message = f"The service moved to {response.headers.get('location', 'another address')}"
        fix = "Use that address with --url."
    elif status == 401:
        code, fix = ExitCode.DENIED, "Sign in with `naoctl login`, or set NAOCTL_TOKEN."
        if not response.request.headers.get("Authorization"):
            message = f"{response.request.url.copy_with(raw_path=b'/')} requires a token"
    elif status == 403:
        code, fix = ExitCode.DENIED, "An administrator can create a token with this scope."
    elif status == 404:
        code, fix = ExitCode.NOT_FOUND, shows_all
    elif status == 409:
        code, fix = ExitCode.CONFLICT, shows_one
    elif status in (400, 413, 415, 422):
        code = ExitCode.USAGE
    elif status == 429:
        wait = response.headers.get("retry-after")
        fix = f"Try again in {plain(wait, keep='')} s." if wait else "Try again later."
    elif status >= 500:
        message = f"The service failed with status {status}: {message}"
        fix = "See its log; on this machine `naoctl doctor` shows where it is."
    # Text of other users must neither control the terminal nor look like a line of ours.
    message = plain(message, " ", keep="")
    raise ApiError(message, status=status, fix=fix, code=code, problem=problem)


def _reason(error: Exception) -> str:
    if isinstance(error, httpx.ConnectTimeout | httpx.ReadTimeout | httpx.WriteTimeout | httpx.PoolTimeout):
        return "no answer in time"
    if isinstance(error, httpx.ConnectError) and "refused" in str(error).lower():
        return "connection refused"
    return str(error).strip() or type(error).__name__
