"""Checkpoints and evaluations, and their files."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from naojobs import requests, submission
from naojobs.errors import NotFoundError
from naojobs.models import Evaluation
from naojobs.states import WorkState
from naojobs.store import StoreManifest

from naosprint_api import queries
from naosprint_api.dependencies import (
    CheckpointId,
    CountedRoute,
    Cursor,
    EvaluationId,
    FileName,
    JobId,
    PageLimit,
    Reader,
    ServiceDep,
    Submitter,
)
from naosprint_api.downloads import send_archive, send_file
from naosprint_api.patterns import STEP
from naosprint_api.problems import responses
from naosprint_api.schemas.artifacts import (
    CheckpointPage,
    CheckpointPublic,
    EvaluationCreate,
    EvaluationPage,
    EvaluationPublic,
)
from naosprint_api.submitted import SubmissionDep
from naosprint_api.views import checkpoint_view

router = APIRouter(tags=["artifacts"], route_class=CountedRoute)

_READ = responses(401, 403, 404, 422, 429, 503)
_BYTES: dict[str, Any] = {"schema": {"type": "string", "format": "binary"}}
FILE: dict[int | str, dict[str, Any]] = {
    **_READ,
    **responses(416),
    200: {"description": "All of the file", "content": {"application/octet-stream": _BYTES}},
    206: {"description": "The requested range", "content": {"application/octet-stream": _BYTES}},
    304: {"description": "The copy with this ETag is still valid"},
    307: {"description": "The store serves it at this address"},
}
_ARCHIVE: dict[int | str, dict[str, Any]] = {
    **_READ,
    200: {"description": "A tar archive", "content": {"application/x-tar": _BYTES}},
}

Presigned = Annotated[
    bool, Query(description="Answer with a redirect to the store where it can sign addresses, else with the file.")
]


@router.get("/jobs/{job_id}/checkpoints", responses=_READ)
def list_checkpoints(
    job_id: JobId,
    principal: Reader,
    service: ServiceDep,
    limit: PageLimit = 50,
    cursor: Annotated[str | None, Query(pattern=STEP, description="`next_cursor` of the previous page.")] = None,
) -> CheckpointPage:
    """List the checkpoints of a job, most steps first."""
    queries.visible_job(service.reads, principal, job_id)
    step, _, attempt = (cursor or "").partition("-")
    before = (int(step), int(attempt)) if cursor else None
    rows = queries.checkpoints_of(service.reads, job_id, limit=limit + 1, before=before)
    page = rows[:limit]
    return CheckpointPage(
        items=[checkpoint_view(row) for row in page],
        next_cursor=f"{page[-1].step}-{page[-1].attempt}" if len(rows) > limit else None,
    )


@router.get("/checkpoints/{checkpoint_id}", responses=_READ)
def get_checkpoint(checkpoint_id: CheckpointId, principal: Reader, service: ServiceDep) -> CheckpointPublic:
    """Look up one checkpoint."""
    return checkpoint_view(queries.visible_checkpoint(service.reads, principal, checkpoint_id))


@router.get("/checkpoints/{checkpoint_id}/files/{name:path}", response_class=Response, responses=FILE)
def get_checkpoint_file(
    request: Request,
    checkpoint_id: CheckpointId,
    name: FileName,
    principal: Reader,
    service: ServiceDep,
    presigned: Presigned = False,
) -> Response:
    """Download a file of a checkpoint; a Range header selects a part of it."""
    row = queries.visible_checkpoint(service.reads, principal, checkpoint_id)
    manifest = StoreManifest.model_validate(row.manifest)
    return send_file(request, service.store, service.store_threads, row.key, manifest, name, presigned=presigned)


@router.get("/checkpoints/{checkpoint_id}/archive", response_class=Response, responses=_ARCHIVE)
def get_checkpoint_archive(checkpoint_id: CheckpointId, principal: Reader, service: ServiceDep) -> Response:
    """Download all files of a checkpoint as a tar archive."""
    row = queries.visible_checkpoint(service.reads, principal, checkpoint_id)
    manifest = StoreManifest.model_validate(row.manifest)
    return send_archive(
        service.store, service.store_threads, row.key, manifest, f"{row.job_id}-{row.step}", row.created_at
    )


@router.get("/jobs/{job_id}/evaluations", responses=_READ)
def list_evaluations(
    job_id: JobId, principal: Reader, service: ServiceDep, limit: PageLimit = 50, cursor: Cursor = None
) -> EvaluationPage:
    """List the evaluations of a job, newest first."""
    queries.visible_job(service.reads, principal, job_id)
    rows = queries.evaluations_of(service.reads, job_id, limit=limit + 1, before=cursor)
    return EvaluationPage.of(service.show_evaluations(rows), limit)


@router.post(
    "/jobs/{job_id}/evaluations",
    status_code=202,
    responses={**_READ, **responses(409, 413), 200: {"model": EvaluationPublic, "description": "Exists already"}},
)
def request_evaluation(
    job_id: JobId,
    principal: Submitter,
    service: ServiceDep,
    submitted: SubmissionDep,
    body: EvaluationCreate | None = None,
) -> EvaluationPublic:
    """Queue an evaluation of a checkpoint; look it up again until it has ended.

    202 for a new one; 200 if the idempotency key was used before for this job with the same body.
    """
    queries.visible_job(service.reads, principal, job_id)
    request = (body or EvaluationCreate.model_validate({})).request()
    row, created = submission.submit_evaluation(service.sessions, job_id, request, **submitted.options)
    submitted.made(f"/evaluations/{row.id}", row, created=created)
    return service.show_evaluation(row)


@router.get("/evaluations/{evaluation_id}", responses=_READ)
def get_evaluation(evaluation_id: EvaluationId, principal: Reader, service: ServiceDep) -> EvaluationPublic:
    """Look up one evaluation."""
    return service.show_evaluation(queries.visible_evaluation(service.reads, principal, evaluation_id))


@router.post("/evaluations/{evaluation_id}/cancel", responses={**_READ, **responses(409)})
def cancel_evaluation(evaluation_id: EvaluationId, principal: Submitter, service: ServiceDep) -> EvaluationPublic:
    """Cancel an evaluation. A running one stops soon; it is cancelled when its state is `cancelled`."""
    queries.visible_evaluation(service.reads, principal, evaluation_id)
    return service.show_evaluation(requests.request_cancel(service.sessions, Evaluation, evaluation_id))


def finished(row: Evaluation) -> tuple[str, StoreManifest]:
    """Return the key and the manifest of an evaluation that has succeeded. Raises NotFoundError."""
    if row.state is not WorkState.SUCCEEDED or row.key is None:
        raise NotFoundError(f"evaluation {row.id} is {row.state}; it has no files")
    return row.key, StoreManifest.model_validate(row.manifest)


@router.get("/evaluations/{evaluation_id}/files/{name:path}", response_class=Response, responses=FILE)
def get_evaluation_file(
    request: Request,
    evaluation_id: EvaluationId,
    name: FileName,
    principal: Reader,
    service: ServiceDep,
    presigned: Presigned = False,
) -> Response:
    """Download a file of an evaluation; a Range header selects a part of it."""
    key, manifest = finished(queries.visible_evaluation(service.reads, principal, evaluation_id))
    return send_file(request, service.store, service.store_threads, key, manifest, name, presigned=presigned)


@router.get("/evaluations/{evaluation_id}/archive", response_class=Response, responses=_ARCHIVE)
def get_evaluation_archive(evaluation_id: EvaluationId, principal: Reader, service: ServiceDep) -> Response:
    """Download all files of an evaluation as a tar archive."""
    row = queries.visible_evaluation(service.reads, principal, evaluation_id)
    key, manifest = finished(row)
    return send_archive(service.store, service.store_threads, key, manifest, evaluation_id, row.created_at)
