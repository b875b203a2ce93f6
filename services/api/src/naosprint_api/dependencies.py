"""Dependencies of routes: the service and the caller."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from functools import partial
from math import ceil, isfinite
from typing import Annotated, Any, cast

from anyio import move_on_after, to_thread
from fastapi import Depends, Header, Path, Query, Request, Response, Security
from fastapi.routing import APIRoute
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from naojobs.ids import PATTERN
from naojobs.tokens import Principal, Scope

from naosprint_api.patterns import KEY
from naosprint_api.problems import FieldError, ProblemError
from naosprint_api.service import Service

_log = logging.getLogger(__name__)

_bearer = HTTPBearer(
    auto_error=False,
    scheme_name="token",
    description="A token made by `POST /tokens`, or the first one by `python -m naojobs token create`.",
)

MAX_BIGINT = 2**63 - 1
"""Largest value of the database's integer columns."""
MAX_VALUES, MAX_DEPTH = 100_000, 64
"""Most values and deepest nesting of a JSON body."""
DRAIN_S = 1.0
"""Seconds in which the body of a refused request is read and discarded."""
ARCHIVE = "application/octet-stream"
"""Type of the content of an uploaded folder."""
BODY_METHODS = frozenset({"POST", "PUT", "PATCH", "DELETE"})
"""Methods of requests that may have a body."""


def service_of(request: Request) -> Service:
    """Return this process's services."""
    return cast(Service, request.app.state.service)


async def _service(request: Request) -> Service:
    # Functions that do not block are async, so that they need no thread.
    return service_of(request)


ServiceDep = Annotated[Service, Depends(_service)]


async def storable_body(request: Request) -> None:
    """Refuse a JSON body with values that JSON allows, but no column of the database holds.

    Raises ProblemError for a number beyond 64 bits, one that is not finite, text with half of a surrogate pair, and
    for a body of more than :data:`MAX_VALUES` values or deeper than :data:`MAX_DEPTH`.
    """
    if request.method not in BODY_METHODS or request.headers.get("content-type") == ARCHIVE:
        return  # an archive is read where it is checked who sends it
    if not await request.body():
        return
    try:
        body = await request.json()
    except (ValueError, RecursionError):
        return  # the framework has refused it, or the route does not read JSON
    if problem := _body_problem(body):
        place, message = problem
        field = ".".join(str(part)[:100] for part in place).encode(errors="replace").decode() or "body"
        raise ProblemError(422, f"{field}: {message}", [FieldError(field=field, message=message)])


def _body_problem(body: object) -> tuple[list[str | int], str] | None:
    """Return the path of the first value that cannot be stored, and why; a level costs one iterator."""
    path: list[str | int] = []
    levels = [_parts(body)]
    count = 0
    if reason := _unstorable(body):
        return [], reason
    while levels:
        part = next(levels[-1], None)
        if part is None:
            levels.pop()
            del path[len(levels) - 1 :]
            continue
        name, value = part
        count += 1
        del path[len(levels) - 1 :]
        path.append(name)
        if count > MAX_VALUES:
            return [], f"more than {MAX_VALUES:,} values; send fewer"
        if reason := _unstorable(name) or _unstorable(value):
            return path, reason
        if isinstance(value, dict | list):
            if len(levels) == MAX_DEPTH:
                return path[:5], f"nested more than {MAX_DEPTH} levels deep; send a flatter body"
            levels.append(_parts(value))
    return None


def _parts(value: object) -> Iterator[tuple[str | int, object]]:
    if isinstance(value, dict):
        return iter(value.items())
    return iter(enumerate(value)) if isinstance(value, list) else iter(())


def _unstorable(value: object) -> str:
    """Return why a value cannot be stored; empty if it can."""
    if isinstance(value, int) and not -MAX_BIGINT <= value <= MAX_BIGINT:
        return "the number is beyond 64 bits; use a smaller one"
    if isinstance(value, float) and not isfinite(value):
        return "the number is not finite; use a finite one"
    if isinstance(value, str) and any("\ud800" <= character <= "\udfff" for character in value):
        return "the text has half of a surrogate pair; send whole characters"
    return ""


def _caller(request: Request) -> str:
    return request.client.host if request.client else "unknown"


Credentials = Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)]


async def admit(request: Request, service: Service, *, public: bool = True) -> None:
    """Count a request without a token, or to a public route, and authenticate one that may have a body.

    That comes before anything is read or done.

    Raises ProblemError: a limit is exceeded, or the token of a request with a body is missing or not valid.
    """
    credentials = await _bearer(request)
    if credentials is None or (public and request.method not in BODY_METHODS):
        count_address(request, service)
    if request.method in BODY_METHODS:
        request.state.principal = await _authenticate(request, service, credentials, to_thread.run_sync)


async def authenticate(request: Request, service: ServiceDep, credentials: Credentials) -> Principal:
    """Return the owner of the token, and count the request against the rate limit."""
    admitted: Principal | None = getattr(request.state, "principal", None)
    return admitted or await _authenticate(request, service, credentials, to_thread.run_sync)


async def _authenticate(
    request: Request,
    service: Service,
    credentials: HTTPAuthorizationCredentials | None,
    in_thread: Callable[[Callable[[], Principal | None]], Awaitable[Principal | None]],
) -> Principal:
    if credentials is None:
        count_address(request, service)
        raise ProblemError(
            401,
            "this address needs a token; send the header `Authorization: Bearer <token>`",
            [FieldError(field="Authorization", message="missing; send `Bearer <token>`")],
            {"WWW-Authenticate": "Bearer"},
        )
    secret = credentials.credentials
    if not service.principals.found(secret):
        # Before the look-up: guesses cost no more queries than the limit, and hold up no token that was valid before.
        count_address(request, service)
    principal = service.principals.find(secret) or await in_thread(partial(service.principals.get, secret))
    if principal is None:
        count_address(request, service)  # a token that was valid before is not counted yet
        _log.warning("refused an unknown token from %s", _caller(request))
        service.telemetry.refused.labels("token").inc()
        raise ProblemError(
            401,
            "the token is unknown, expired or revoked; use another one",
            [FieldError(field="Authorization", message="unknown, expired or revoked token")],
            {"WWW-Authenticate": 'Bearer error="invalid_token"'},
        )
    if getattr(request.state, "counted", False):
        request.state.counted = False
        service.limiter.put_back(f"address {_caller(request)}")
    _limit(service, principal.token_id)
    return principal


def count_address(request: Request, service: Service) -> None:
    """Count a request against the limit of its address, once. Raises ProblemError."""
    if not getattr(request.state, "counted", False):
        _limit(service, f"address {_caller(request)}")
        request.state.counted = True


def _limit(service: Service, caller: str) -> None:
    wait = service.limiter.take(caller)
    if wait > 0:
        service.telemetry.refused.labels("rate").inc()
        settings = service.settings
        raise ProblemError(
            429,
            f"more than {settings.api_rate_per_s:g} requests per second; try again in {wait:.1f} s",
            headers={"Retry-After": str(ceil(wait))},
        )


class CountedRoute(APIRoute):
    """Route that admits a request before its body is read; every router of the API uses it."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return the route's function behind :func:`admit`."""
        handle = super().get_route_handler()
        public = 401 not in self.responses

        async def admitted(request: Request) -> Response:
            try:
                await admit(request, service_of(request), public=public)
            except ProblemError:
                # many clients read the answer only when they have sent everything
                with move_on_after(DRAIN_S):
                    async for _ in request.stream():
                        pass
                raise
            return await handle(request)

        return admitted


def require(scope: Scope, principal: Principal, service: Service) -> Principal:
    """Return `principal`. Raises ProblemError if its token does not have `scope`."""
    if scope not in principal.scopes:
        _log.warning("refused %s (%s): no scope %s", principal.owner, principal.token_id, scope)
        service.telemetry.refused.labels("scope").inc()
        raise ProblemError(
            403,
            f"this token does not have scope {scope}; use one that does",
            [FieldError(field="Authorization", message=f"scope {scope} is needed")],
        )
    return principal


def needs(scope: Scope) -> Callable[..., Awaitable[Principal]]:
    """Return a dependency that lets only tokens with `scope` pass."""

    async def check(principal: Annotated[Principal, Depends(authenticate)], service: ServiceDep) -> Principal:
        return require(scope, principal, service)

    return check


async def follower(request: Request, service: ServiceDep, credentials: Credentials) -> Principal:
    """Return the owner of the token, looked up in the threads for followers, since many may connect at once."""
    principal = await _authenticate(request, service, credentials, service.feed.in_thread)
    return require(Scope.READ, principal, service)


Reader = Annotated[Principal, Depends(needs(Scope.READ))]
Follower = Annotated[Principal, Depends(follower)]
Submitter = Annotated[Principal, Depends(needs(Scope.SUBMIT))]
Admin = Annotated[Principal, Depends(needs(Scope.ADMIN))]

JobId = Annotated[str, Path(pattern=PATTERN, description="Id of the job.")]
CheckpointId = Annotated[str, Path(pattern=PATTERN, description="Id of the checkpoint.")]
EvaluationId = Annotated[str, Path(pattern=PATTERN, description="Id of the evaluation.")]
FileName = Annotated[str, Path(max_length=900, description="Name of the file as in the list of files.")]
After = Annotated[int, Query(ge=0, le=MAX_BIGINT, description="Only items after this id.")]
Limit = Annotated[int, Query(ge=1, le=1000, description="Maximum number of items.")]
PageLimit = Annotated[int, Query(ge=1, le=200, description="Maximum number of items.")]
Cursor = Annotated[str | None, Query(pattern=PATTERN, description="`next_cursor` of the previous page.")]
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        pattern=KEY,
        description="Key chosen by the client; requests with the same key and body create one job.",
    ),
]
