"""Sharing: read-only links to a job, and reports that a browser opens without a token."""

from __future__ import annotations

import hashlib
import hmac
import logging
from datetime import UTC, datetime, timedelta
from typing import Annotated

from fastapi import APIRouter, Path
from fastapi.responses import Response
from naojobs.errors import NotFoundError
from naojobs.models import Evaluation
from naojobs.tokens import Scope, create_token, get_token, principal_of, revoke_shared
from starlette.requests import Request

from naosprint_api import queries
from naosprint_api.dependencies import CountedRoute, EvaluationId, JobId, Reader, ServiceDep, Submitter
from naosprint_api.downloads import send_file
from naosprint_api.patterns import TICKET
from naosprint_api.problems import responses
from naosprint_api.routes.artifacts import finished
from naosprint_api.schemas.access import PagePublic, ShareCreate, SharePublic
from naosprint_api.service import Service

router = APIRouter(tags=["sharing"], route_class=CountedRoute)

_log = logging.getLogger(__name__)

REPORT = "report.html"
PAGE_S = 600
"""Seconds that the address of a report is valid."""

REPORT_POLICY = (
    "sandbox allow-downloads; default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:; "
    "frame-ancestors 'self'"
)
"""A report is one file: it runs no script, loads nothing else, and has no access to this origin."""

_READ = responses(401, 403, 404, 422, 429, 503)


@router.post("/jobs/{job_id}/share", status_code=201, responses={**_READ, **responses(409, 413)})
def share_job(job_id: JobId, principal: Submitter, service: ServiceDep, body: ShareCreate | None = None) -> SharePublic:
    """Make a token that can read this job and nothing else, for a link to send to others.

    It is revoked with the token that it was made with, and expires no later.
    """
    job = queries.visible_job(service.reads, principal, job_id)
    days = (body or ShareCreate.model_validate({})).expires_in_days
    token_id, secret = create_token(
        service.sessions,
        name=f"link to {job.name}"[:200],
        owner=job.owner,
        scopes=[Scope.READ],
        valid_for=timedelta(days=days),
        job_id=job_id,
        parent_id=principal.token_id,
        limits=service.settings.limits,
    )
    _log.info("%s (%s) shared job %s by token %s", principal.owner, principal.token_id, job_id, token_id)
    token = get_token(service.reads, token_id)
    return SharePublic.model_validate({"token": secret, "job_id": job_id, "expires_at": token.expires_at})


@router.delete("/jobs/{job_id}/share", status_code=204, responses=_READ)
def unshare_job(job_id: JobId, principal: Submitter, service: ServiceDep) -> None:
    """Revoke all links to this job."""
    queries.visible_job(service.reads, principal, job_id)
    count = revoke_shared(service.sessions, job_id)
    service.principals.forget()
    _log.info("%s (%s) revoked %d links to job %s", principal.owner, principal.token_id, count, job_id)


def _signature(key: str, evaluation_id: str, token_id: str, expires: str) -> str:
    return hmac.new(key.encode(), f"{evaluation_id} {token_id} {expires}".encode(), hashlib.sha256).hexdigest()


def _evaluation_of(service: Service, evaluation_id: str, ticket: str) -> Evaluation:
    """Return the evaluation whose report a ticket opens, if its token may still see it. Raises NotFoundError."""
    token_id, expires, signature = ticket.split(".")
    refused = NotFoundError("this address has expired; open the report from the job's page again")
    if not 0 <= int(expires) - queries.seconds(service.reads) <= PAGE_S:
        raise refused
    principal = principal_of(service.reads, token_id)
    if principal is None or Scope.READ not in principal.scopes:
        raise refused
    expected = _signature(get_token(service.reads, token_id).ticket_key, evaluation_id, token_id, expires)
    if not hmac.compare_digest(signature, expected):
        raise refused
    try:
        return queries.visible_evaluation(service.reads, principal, evaluation_id)
    except NotFoundError:
        raise refused from None


@router.post("/evaluations/{evaluation_id}/report", responses=_READ)
def open_report(evaluation_id: EvaluationId, principal: Reader, service: ServiceDep) -> PagePublic:
    """Get an address at which a browser can show the evaluation's report for ten minutes."""
    _, manifest = finished(queries.visible_evaluation(service.reads, principal, evaluation_id))
    if manifest.entry(REPORT) is None:
        raise NotFoundError(f"evaluation {evaluation_id} has no report; `naoctl report` makes one")
    expires = str(int(queries.seconds(service.reads)) + PAGE_S)
    key = get_token(service.reads, principal.token_id).ticket_key
    ticket = f"{principal.token_id}.{expires}.{_signature(key, evaluation_id, principal.token_id, expires)}"
    return PagePublic(
        url=f"/evaluations/{evaluation_id}/report/{ticket}", expires_at=datetime.fromtimestamp(int(expires), UTC)
    )


@router.get(
    "/evaluations/{evaluation_id}/report/{ticket}",
    response_class=Response,
    responses={
        **responses(404, 422, 503),
        200: {"description": "The report", "content": {"text/html": {"schema": {"type": "string"}}}},
    },
)
def show_report(
    request: Request,
    evaluation_id: EvaluationId,
    ticket: Annotated[str, Path(pattern=TICKET, description="From `POST`.")],
    service: ServiceDep,
) -> Response:
    """Show the report of an evaluation as a page that runs no scripts."""
    key, manifest = finished(_evaluation_of(service, evaluation_id, ticket))
    answer = send_file(request, service.store, service.store_threads, key, manifest, REPORT, presigned=False)
    answer.headers["Content-Type"] = "text/html; charset=utf-8"
    answer.headers["Content-Disposition"] = "inline"
    answer.headers["Cache-Control"] = "no-store"  # a copy would open for longer than the address is valid
    answer.headers["Content-Security-Policy"] = REPORT_POLICY
    answer.headers["X-Frame-Options"] = "SAMEORIGIN"
    return answer
