"""Errors as RFC 9457 problem documents that name the field and the fix."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from anyio import to_thread
from fastapi import APIRouter, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from naojobs.database import Sessions, schema_mismatch
from naojobs.errors import ConflictError, InvalidError, NotFoundError, QuotaError
from naojobs.store import MissingArtifactError, StoreError
from psycopg.errors import DiskFull, LockNotAvailable, ReadOnlySqlTransaction
from pydantic import BaseModel, Field
from sqlalchemy.exc import DBAPIError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from naosprint_api import patterns

MEDIA_TYPE = "application/problem+json"

MAX_ERRORS, MAX_NAME, MAX_MESSAGE = 20, 100, 1000
"""Most errors that a response names, and the longest part of a field's path and message in it, characters."""

_REFUSALS: Mapping[type | None, str] = {
    DiskFull: "the database's disk is full, so nothing can be stored; try again when there is room",
    ReadOnlySqlTransaction: "the database takes no changes at present; it can be read. Try again later",
}
"""What is answered when the database works, but cannot store a change, by the driver's error."""

_log = logging.getLogger(__name__)


class FieldError(BaseModel):
    """Field of a request that is wrong."""

    field: str = Field(
        description="Path of the field, e.g. spec.algorithm.learning_rate; `body` for the request as a whole."
    )
    message: str = Field(description="What is wrong, and what is expected.")


class Problem(BaseModel):
    """Problem document: what is wrong with a request."""

    type: str = Field("about:blank", description="Kind of problem.")
    title: str = Field(description="The status in words.")
    status: int
    detail: str = Field(description="What went wrong with this request.")
    errors: list[FieldError] = Field(default_factory=list, description="The fields to change.")


class ProblemError(HTTPException):
    """Error that is answered with a problem document."""

    def __init__(
        self,
        status: int,
        detail: str,
        errors: Sequence[FieldError] = (),
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(status, detail, dict(headers or {}))
        self.errors = list(errors)


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI entries of a route that may answer with these problems."""
    schema = {"schema": {"$ref": "#/components/schemas/Problem"}}
    return {status: {"description": HTTPStatus(status).phrase, "content": {MEDIA_TYPE: schema}} for status in statuses}


def problem_response(
    status: int,
    detail: str,
    errors: Sequence[FieldError] = (),
    headers: Mapping[str, str] | None = None,
) -> JSONResponse:
    """Return a problem document as a response."""
    problem = Problem(type="about:blank", title=HTTPStatus(status).phrase, status=status, detail=detail)
    body = problem.model_dump() | {"errors": [error.model_dump() for error in errors]}
    return JSONResponse(body, status_code=status, headers=dict(headers or {}), media_type=MEDIA_TYPE)


def field_errors(error: RequestValidationError) -> list[FieldError]:
    """Return one entry for each thing that is wrong with a request, by the path of its field."""
    found = []
    problems = error.errors()
    for item in problems[:MAX_ERRORS]:
        place, *path = item["loc"] or ("body",)
        message = str(item["msg"]).removeprefix("Value error, ")
        if item["type"] == "json_invalid":
            message = f"not JSON: {item.get('ctx', {}).get('error', message)} at character {path[-1] if path else 0}"
            path = []
        elif item["type"] == "string_pattern_mismatch":
            message = patterns.words(item["ctx"]["pattern"])
        elif item["type"] == "extra_forbidden":
            message = "no such field; remove it or correct its name"
        elif item["type"] == "missing":
            message = "missing; give it a value" if path else "give a JSON body and Content-Type: application/json"
        elif item["type"] in {"model_attributes_type", "dict_type", "model_type"} and not path:
            message = "give a JSON object and Content-Type: application/json"
        # A validator of several fields starts its message with the field to change.
        head, colon, rest = message.partition(": ")
        if colon and all(part.isidentifier() or part.isdecimal() for part in head.split(".")):
            path, message = [*path, *_below(path, head.split("."))], rest
        field = ".".join(str(part)[:MAX_NAME] for part in path) or str(place)
        found.append(FieldError(field=field, message=message[:MAX_MESSAGE]))
    if len(problems) > MAX_ERRORS:
        found.append(FieldError(field="body", message=f"{len(problems) - MAX_ERRORS:,} more errors"))
    return found


def _below(path: Sequence[Any], named: list[str]) -> list[str]:
    """Return the part of a named path that is not the end of ``path`` already."""
    return named[1:] if path and path[-1] == named[0] else named


def allowed_methods(routers: Sequence[APIRouter], path: str) -> set[str]:
    """Return the methods that some route takes at `path`."""
    return {
        method
        for router in routers
        for route in router.routes
        if isinstance(route, APIRoute) and route.path_regex.match(path)
        for method in route.methods or ()
    }


def _schema_mismatch(sessions: Sessions) -> str:
    """Return how the database's schema differs from the API's, as after an upgrade; empty if that is not known."""
    try:
        with sessions() as session:
            return schema_mismatch(session)
    except SQLAlchemyError:
        return ""


def install(app: FastAPI, routers: Sequence[APIRouter]) -> None:
    """Make `app`, which has these routers, answer every error with a problem document."""

    async def invalid(_request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, RequestValidationError)
        errors = field_errors(error)
        detail = "; ".join(f"{item.field}: {item.message}" for item in errors[:5])
        return problem_response(422, detail, errors)

    async def http(request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, HTTPException)
        headers = dict(error.headers or {})
        if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
            headers["Allow"] = ", ".join(sorted(allowed_methods(routers, request.url.path))) or "GET"
            detail = f"this address accepts {headers['Allow']}"
        elif error.status_code == HTTPStatus.BAD_REQUEST and error.detail == "There was an error parsing the body":
            message = "the body is not valid JSON, or is nested too deeply"
            return problem_response(422, message, [FieldError(field="body", message=message)])
        elif error.status_code == HTTPStatus.NOT_FOUND and error.detail == "Not Found":
            detail = "no such address; /openapi.json lists all addresses"
        else:
            detail = str(error.detail)
        return problem_response(error.status_code, detail, headers=headers)

    async def problem(_request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, ProblemError)
        return problem_response(error.status_code, error.detail, error.errors, error.headers)

    async def missing(_request: Request, error: Exception) -> JSONResponse:
        return problem_response(404, str(error))

    async def conflict(_request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, ConflictError)
        return problem_response(409, str(error), [FieldError(field=error.field, message=str(error))])

    async def refused(_request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, InvalidError)
        return problem_response(422, f"{error.field}: {error}", [FieldError(field=error.field, message=str(error))])

    async def quota(_request: Request, error: Exception) -> JSONResponse:
        return problem_response(429, str(error), [FieldError(field="owner", message=str(error))], {"Retry-After": "60"})

    async def lost_artifact(_request: Request, error: Exception) -> JSONResponse:
        _log.error("an artifact that is recorded is not in the store: %s", error)
        return problem_response(404, "the file is recorded, but it is no longer in the store")

    async def store(_request: Request, error: Exception) -> JSONResponse:
        _log.error("the store failed: %s", error)
        return problem_response(
            503, "the artifact store does not answer; try again later", headers={"Retry-After": "5"}
        )

    async def database(request: Request, error: Exception) -> JSONResponse:
        if isinstance(error, DBAPIError) and isinstance(error.orig, LockNotAvailable):
            _log.warning("a lock was not granted: %s", error)
            message = "another change of the same is still being stored; try again"
            return problem_response(429, message, headers={"Retry-After": "2"})
        if isinstance(error, DBAPIError) and not (error.connection_invalidated or isinstance(error, OperationalError)):
            mismatch = await to_thread.run_sync(_schema_mismatch, request.app.state.service.reads)
            if not mismatch:
                raise error
            _log.error("%s: %s", mismatch, error)
            message = f"{mismatch}; try again, so that a service of its version answers"
            return problem_response(503, message, headers={"Retry-After": "5"})
        _log.error("the database failed: %s", error)
        kind = type(error.orig) if isinstance(error, DBAPIError) else None
        message = _REFUSALS.get(kind, "the database does not answer; try again later")
        return problem_response(503, message, headers={"Retry-After": "2"})

    async def left(_request: Request, _error: Exception) -> JSONResponse:
        return problem_response(400, "the connection ended before the body did")  # only counted and logged

    async def unexpected(_request: Request, _error: Exception) -> JSONResponse:
        # The envelope logs the traceback; the response has no internal details.
        return problem_response(500, "internal error; see the service's log")

    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(HTTPException, http)
    app.add_exception_handler(ProblemError, problem)
    app.add_exception_handler(NotFoundError, missing)
    app.add_exception_handler(ConflictError, conflict)
    app.add_exception_handler(InvalidError, refused)
    app.add_exception_handler(QuotaError, quota)
    app.add_exception_handler(MissingArtifactError, lost_artifact)
    app.add_exception_handler(StoreError, store)
    app.add_exception_handler(DBAPIError, database)
    app.add_exception_handler(PoolTimeoutError, database)
    app.add_exception_handler(ClientDisconnect, left)
    app.add_exception_handler(Exception, unexpected)
