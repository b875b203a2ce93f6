"""Studies: start, look up, end."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query
from naojobs import studies
from naojobs.errors import InvalidError, NotFoundError
from naojobs.ids import PATTERN
from naojobs.models import Study
from naojobs.studies import StudyRequest
from naospec.search import SearchSpec

from naosprint_api import queries
from naosprint_api.dependencies import CountedRoute, Cursor, PageLimit, Reader, ServiceDep, Submitter
from naosprint_api.patterns import PLAIN
from naosprint_api.problems import responses
from naosprint_api.schemas.studies import (
    StudyCreate,
    StudyDetails,
    StudyExtend,
    StudyPage,
    StudyPublic,
    TrialAsked,
    TrialPublic,
    TrialTell,
)
from naosprint_api.service import Service
from naosprint_api.submitted import SubmissionDep

router = APIRouter(tags=["studies"], route_class=CountedRoute)

READ = responses(401, 403, 404, 422, 429, 503)
CONTROL = responses(401, 403, 404, 409, 422, 429, 503)

StudyId = Annotated[str, Path(pattern=PATTERN, description="Id of the study.")]


def _details(service: Service, study: Study) -> StudyDetails:
    with service.reads.begin() as session:
        trials = studies.trials_of(session, study.id)
    return StudyDetails(
        **StudyPublic.model_validate(study).model_dump(),
        trials=[TrialPublic.model_validate(trial) for trial in trials],
        best=studies.pareto_front(SearchSpec.model_validate(study.spec), trials),
    )


@router.post(
    "/studies",
    status_code=201,
    responses={
        **responses(401, 403, 409, 413, 422, 429, 503),
        200: {"model": StudyPublic, "description": "Exists already"},
    },
)
def submit_study(body: StudyCreate, principal: Submitter, service: ServiceDep, submitted: SubmissionDep) -> StudyPublic:
    """Start a search for settings; its trials are jobs of a group with the study's id."""
    limit = service.settings.api_max_open_jobs
    if body.search.parallel > limit:
        raise InvalidError(f"at most {limit} jobs may be open at a time; use a lower number", "search.parallel")
    owner, request = principal.owner, StudyRequest(body.job.request(), body.search, body.name)
    study, created = studies.submit_study(
        service.sessions, request, owner=owner, see_all=principal.is_admin, **submitted.options
    )
    submitted.made(f"/studies/{study.id}", created=created)
    return StudyPublic.model_validate(study)


@router.get("/studies", responses=READ)
def list_studies(
    principal: Reader,
    service: ServiceDep,
    owner: Annotated[
        str | None, Query(max_length=200, pattern=PLAIN, description="Studies of this owner; others' need scope admin.")
    ] = None,
    q: Annotated[str | None, Query(max_length=200, pattern=PLAIN, description="Part of the name.")] = None,
    limit: PageLimit = 50,
    cursor: Cursor = None,
) -> StudyPage:
    """List studies, newest first."""
    if not principal.is_admin:
        if owner is not None and owner != principal.owner:
            raise NotFoundError(f"no studies of {owner} that this token may see; leave `owner` out")
        owner = principal.owner if principal.job_id is None else ""  # a link to a job shows no study
    rows = queries.list_studies(service.reads, owner=owner, text=q, limit=limit + 1, before=cursor)
    return StudyPage.of([StudyPublic.model_validate(study) for study in rows], limit)


@router.get("/studies/{study_id}", responses=READ)
def get_study(study_id: StudyId, principal: Reader, service: ServiceDep) -> StudyDetails:
    """Look up one study with its trials."""
    return _details(service, queries.visible_study(service.reads, principal, study_id))


@router.post("/studies/{study_id}/cancel", responses=CONTROL)
def cancel_study(study_id: StudyId, principal: Submitter, service: ServiceDep) -> StudyDetails:
    """Cancel a study and its open jobs."""
    queries.visible_study(service.reads, principal, study_id)
    return _details(service, studies.cancel_study(service.sessions, study_id))


@router.post("/studies/{study_id}/extend", responses={**CONTROL, **responses(413)})
def extend_study(study_id: StudyId, body: StudyExtend, principal: Submitter, service: ServiceDep) -> StudyDetails:
    """Give a study more trials; one that has ended runs again, with what its sampler has learned."""
    queries.visible_study(service.reads, principal, study_id)
    extended = studies.extend_study(service.sessions, study_id, body.trials, limits=service.settings.limits)
    return _details(service, extended)


@router.post("/studies/{study_id}/ask", responses=CONTROL)
def ask_for_trial(study_id: StudyId, principal: Submitter, service: ServiceDep) -> TrialAsked:
    """Take a trial of a study whose trials run elsewhere; 409 while none waits to be taken."""
    queries.visible_study(service.reads, principal, study_id)
    trial, job = studies.ask(service.sessions, study_id)
    spec = job.spec.model_dump(mode="json")
    return TrialAsked(**TrialPublic.model_validate(trial).model_dump(), spec=spec)


@router.post("/studies/{study_id}/trials/{number}/tell", responses={**CONTROL, **responses(413)})
def tell_trial(
    study_id: StudyId,
    number: Annotated[int, Path(ge=0, le=100_000, description="Number of the trial.")],
    body: TrialTell,
    principal: Submitter,
    service: ServiceDep,
) -> TrialPublic:
    """Report the values of a trial that has run elsewhere, or why it has none."""
    queries.visible_study(service.reads, principal, study_id)
    told = studies.tell(service.sessions, study_id, number, values=body.values, error=body.error)
    return TrialPublic.model_validate(told)


@router.delete("/studies/{study_id}", status_code=204, responses=CONTROL)
def delete_study(study_id: StudyId, principal: Submitter, service: ServiceDep) -> None:
    """Delete a study that has ended; its jobs stay."""
    queries.visible_study(service.reads, principal, study_id)
    studies.delete_study(service.sessions, study_id)
