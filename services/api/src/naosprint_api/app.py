"""The application: routes, errors, pages."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fastapi import Depends, FastAPI, Request, Response
from fastapi.openapi.utils import get_openapi
from fastapi.responses import FileResponse, JSONResponse
from fastapi.staticfiles import StaticFiles
from naojobs.teams import MAX_TEAM_BYTES
from starlette.middleware.gzip import DEFAULT_EXCLUDED_CONTENT_TYPES, GZipMiddleware
from starlette.types import ASGIApp, Scope

from naosprint_api import __version__, problems
from naosprint_api.dependencies import ARCHIVE, CountedRoute, admit, service_of, storable_body
from naosprint_api.middleware import BodyLimit, Envelope
from naosprint_api.problems import Problem
from naosprint_api.routes import (
    artifacts,
    catalog,
    jobs,
    matches,
    policies,
    sharing,
    streams,
    studies,
    system,
    tokens,
    webhooks,
)
from naosprint_api.service import Service
from naosprint_api.settings import ApiSettings

STATIC = Path(__file__).parent / "static"

_NOT_COMPRESSED = (*DEFAULT_EXCLUDED_CONTENT_TYPES, "application/octet-stream", "application/x-tar")
"""Artifacts are compressed already, and clients ask for ranges of them."""

_DESCRIPTION = """\
Submit trainings of simulated humanoid robots, follow them live and download the trained policies.

Every error is a problem document (RFC 9457) whose `errors` name the fields to change.
"""


class CountedFiles(StaticFiles):
    """Static files, whose requests count like others without a token."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return a file, or an error."""
        request = Request(scope)
        await admit(request, service_of(request))
        return await super().get_response(path, scope)


def create_app(service: Service) -> FastAPI:
    """Return the application around `service`, without what happens to every request."""

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        async with service.running():
            yield

    app = FastAPI(
        title="naosprint",
        version=__version__,
        description=_DESCRIPTION,
        lifespan=lifespan,
        # The framework's pages load scripts from other origins; only the document is served.
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
        redirect_slashes=False,
        dependencies=[Depends(storable_body)],
    )
    app.state.service = service
    # Streams come before jobs: the `stream` in /jobs/stream is not an id.
    routers = (
        system.router,
        catalog.router,
        streams.router,
        jobs.router,
        studies.router,
        artifacts.router,
        matches.router,
        policies.router,
        tokens.router,
        sharing.router,
        webhooks.router,
    )
    problems.install(app, routers)
    for router in routers:
        app.include_router(router)

    app.router.route_class = CountedRoute

    @app.get("/", include_in_schema=False)
    def index() -> FileResponse:
        """Serve the dashboard."""
        return FileResponse(STATIC / "index.html", headers={"Cache-Control": "no-cache"})

    if service.settings.api_docs_public:

        @app.get("/openapi.json", include_in_schema=False)
        def description() -> JSONResponse:
            """Serve the OpenAPI document."""
            return JSONResponse(app.openapi())

    pages = CountedFiles(directory=STATIC, html=True, check_dir=False)
    app.mount("/ui", pages, name="ui")

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = describe(app)
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]
    return app


def describe(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document, with problems in place of the framework's own errors."""
    document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
    schemas = document["components"]["schemas"]
    model = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
    schemas.update(model.pop("$defs"))
    schemas["Problem"] = model
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    return document


def openapi_document() -> dict[str, Any]:
    """Return the OpenAPI document without a running service, which it does not depend on."""
    with TemporaryDirectory() as folder:
        settings = ApiSettings.model_validate(
            {
                "mode": "local",
                "database_url": "postgresql:///none",
                "broker_url": "redis://none",
                "artifact_url": Path(folder).as_uri(),
            }
        )
        return describe(create_app(Service.build(settings)))


def create_asgi(settings: ApiSettings) -> tuple[ASGIApp, Service]:
    """Return the application for a server, and its service."""
    service = Service.build(settings)
    app = create_app(service)
    compressed = GZipMiddleware(app, minimum_size=1000, compresslevel=1, exclude_content_types=_NOT_COMPRESSED)
    archives = {("PUT", "/teams/", ARCHIVE): MAX_TEAM_BYTES}
    return Envelope(BodyLimit(compressed, settings.api_max_body_bytes, archives), service.telemetry), service
