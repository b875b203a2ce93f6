"""The service itself: health, its own metrics, workers."""

from __future__ import annotations

from datetime import date
from typing import Annotated, Literal

from anyio import to_thread
from fastapi import APIRouter, Depends, Path, Query, Request, Response
from fastapi.security import HTTPAuthorizationCredentials
from naojobs import registry, usage
from naojobs.errors import NotFoundError
from naojobs.tokens import Scope
from pydantic import BaseModel, Field

from naosprint_api import __version__
from naosprint_api.dependencies import (
    Admin,
    CountedRoute,
    PageLimit,
    Reader,
    ServiceDep,
    authenticate,
    count_address,
    require,
    service_of,
)
from naosprint_api.patterns import PLAIN
from naosprint_api.problems import responses
from naosprint_api.schemas.system import UsagePublic, WorkerDrain, WorkerPage, WorkerPublic
from naosprint_api.service import Service
from naosprint_api.views import worker_view

router = APIRouter(tags=["service"], route_class=CountedRoute)

Check = Literal["ok", "failed"]


class Health(BaseModel):
    """Liveness of the process."""

    status: Literal["ok"] = "ok"
    version: str = __version__


class Readiness(BaseModel):
    """Readiness of the service."""

    ready: bool
    database: Check
    schema_revision: Check = Field(description="Whether the database has the revision that this version needs.")
    store: Check
    broker: Check = Field(description="Jobs are accepted and wait even when the broker is down.")


class Identity(BaseModel):
    """Owner of a token."""

    owner: str
    scopes: list[Scope]
    docs_url: str = Field(description="Address of the documentation's site; empty if the service knows none.")
    job_id: str | None = Field(description="The only job that the token gives access to; null for all of the owner's.")


@router.get("/healthz")
def health() -> Health:
    """Check that the process is alive."""
    return Health()


@router.get("/readyz", responses={503: {"model": Readiness, "description": "Not ready"}})
async def readiness(service: ServiceDep, response: Response) -> Readiness:
    """Report whether the database, the store and the broker answer; results are shared for a second."""
    results = await service.probes.results()
    checks: dict[str, Check] = {name: "ok" if good else "failed" for name, good in results.items()}
    ready = all(results[name] for name in ("database", "schema_revision", "store"))
    if not ready:
        response.status_code = 503
    return Readiness(ready=ready, **checks)


async def may_read_figures(request: Request, service: ServiceDep) -> None:
    """Allow access to the metrics: to everybody if the settings allow it, else to tokens with scope metrics."""
    if service.settings.api_metrics_public:
        count_address(request, service)
        return
    scheme, _, secret = request.headers.get("authorization", "").partition(" ")
    known = HTTPAuthorizationCredentials(scheme=scheme, credentials=secret) if scheme.lower() == "bearer" else None
    require(Scope.METRICS, await authenticate(request, service, known), service)


@router.get(
    "/metrics",
    response_class=Response,
    dependencies=[Depends(may_read_figures)],
    responses={
        **responses(401, 403, 429, 503),
        200: {"description": "Prometheus's text format", "content": {"text/plain": {"schema": {"type": "string"}}}},
    },
)
async def figures(request: Request) -> Response:
    """Get the service's metrics for Prometheus."""
    service = service_of(request)
    content = await to_thread.run_sync(service.telemetry.render, await service.probes.results())
    return Response(content, media_type="text/plain; version=0.0.4; charset=utf-8")


@router.get("/whoami", responses=responses(401, 403, 429, 503))
def whoami(principal: Reader, service: ServiceDep) -> Identity:
    """Return the token's owner and scopes."""
    return Identity(
        owner=principal.owner,
        scopes=sorted(principal.scopes),
        job_id=principal.job_id,
        docs_url=service.settings.api_docs_url,
    )


@router.get("/workers", responses=responses(401, 403, 422, 429, 503))
def list_workers(
    principal: Reader,
    service: ServiceDep,
    limit: PageLimit = 50,
    cursor: Annotated[
        str | None, Query(max_length=200, pattern=PLAIN, description="`next_cursor` of the previous page.")
    ] = None,
) -> WorkerPage:
    """List the workers with their capabilities and what they run (one's own, unless the token is admin)."""
    if principal.job_id is not None:
        return WorkerPage(items=[], next_cursor=None)  # a link to a job shows no worker
    rows = registry.workers(service.reads, stale_s=service.settings.lease_s, limit=limit + 1, after=cursor)
    mine = None if principal.is_admin else registry.leased_of(service.reads, principal.owner)
    return WorkerPage.of([worker_view(worker, mine) for worker in rows], limit)


WorkerId = Annotated[str, Path(max_length=200, pattern=PLAIN, description="Id of the worker.")]
CHANGE = responses(401, 403, 404, 422, 429, 503)


@router.post("/workers/{worker_id}/drain", responses={**CHANGE, **responses(413)})
def drain_worker(worker_id: WorkerId, body: WorkerDrain, _: Admin, service: ServiceDep) -> WorkerPublic:
    """Keep a worker from claiming work, for maintenance; what it runs ends there, or trainings continue elsewhere."""
    registry.drain(service.sessions, worker_id, requeue=body.requeue)
    return _worker(service, worker_id)


@router.post("/workers/{worker_id}/undrain", responses=CHANGE)
def undrain_worker(worker_id: WorkerId, _: Admin, service: ServiceDep) -> WorkerPublic:
    """Allow a drained worker to claim work again."""
    registry.undrain(service.sessions, worker_id)
    return _worker(service, worker_id)


def _worker(service: Service, worker_id: str) -> WorkerPublic:
    found = registry.workers(service.reads, stale_s=service.settings.lease_s, only=worker_id)
    return worker_view(found[0])


@router.get("/usage", responses=responses(401, 403, 404, 422, 429, 503))
def get_usage(
    principal: Reader,
    service: ServiceDep,
    since: Annotated[date | None, Query(description="First day (UTC).")] = None,
    until: Annotated[date | None, Query(description="Last day (UTC).")] = None,
    owner: Annotated[
        str | None, Query(max_length=200, pattern=PLAIN, description="This owner only; others need scope admin.")
    ] = None,
) -> list[UsagePublic]:
    """Get what the work of each owner has used of the workers, the most first; deleted work counts, too."""
    if not principal.is_admin:
        if owner is not None and owner != principal.owner:
            raise NotFoundError(f"no usage of {owner} that this token may see; leave `owner` out")
        owner = principal.owner if principal.job_id is None else ""  # a link to a job shows none
    found = usage.usage_by_owner(service.reads, since=since, until=until, owner=owner)
    return [UsagePublic.model_validate(item) for item in found]
