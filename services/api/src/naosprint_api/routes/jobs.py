"""Jobs: submit, look up, control."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, BackgroundTasks, Depends, Query
from naojobs import requests, submission
from naojobs.errors import NotFoundError
from naojobs.ids import PATTERN
from naojobs.models import Job
from naojobs.states import WorkState
from naojobs.tokens import Principal

from naosprint_api import queries
from naosprint_api.dependencies import (
    MAX_BIGINT,
    After,
    CountedRoute,
    Cursor,
    JobId,
    Limit,
    PageLimit,
    Reader,
    ServiceDep,
    Submitter,
)
from naosprint_api.patterns import PLAIN
from naosprint_api.problems import responses
from naosprint_api.schemas.jobs import (
    EventPage,
    GroupCreate,
    GroupPublic,
    JobCreate,
    JobPage,
    JobPatch,
    JobPublic,
    LogPage,
    MetricsPublic,
)
from naosprint_api.service import Service
from naosprint_api.submitted import SubmissionDep
from naosprint_api.views import event_view, log_view

router = APIRouter(tags=["jobs"], route_class=CountedRoute)

READ = responses(401, 403, 404, 422, 429, 503)
LIST = responses(401, 403, 422, 429, 503)
CONTROL = responses(401, 403, 404, 409, 422, 429, 503)
SUBMIT = responses(401, 403, 409, 413, 422, 429, 503)


def job_filter(
    principal: Reader,
    state: Annotated[list[WorkState], Query(description="Any of these states.")] = [],  # noqa: B006
    tag: Annotated[list[str], Query(max_length=20, description="All of these tags.")] = [],  # noqa: B006
    owner: Annotated[
        str | None, Query(max_length=200, pattern=PLAIN, description="Jobs of this owner; others' need scope admin.")
    ] = None,
    group: Annotated[
        str | None, Query(pattern=PATTERN, description="Jobs of this group, or of the study with this id.")
    ] = None,
    parent: Annotated[str | None, Query(pattern=PATTERN, description="Jobs that start from this job's policy.")] = None,
    task: Annotated[str | None, Query(max_length=100, pattern=PLAIN, description="Jobs of this task.")] = None,
    robot: Annotated[str | None, Query(max_length=100, pattern=PLAIN, description="Jobs of this robot.")] = None,
    q: Annotated[
        str | None,
        Query(
            max_length=200,
            pattern=PLAIN,
            description="Part of the name, of a tag, of the task or the robot, or the beginning or end of the id.",
        ),
    ] = None,
) -> queries.JobFilter:
    """Return the filter of a query, restricted to the jobs that the token may see."""
    if not principal.is_admin:
        if owner is not None and owner != principal.owner:
            raise NotFoundError(f"no jobs of {owner} that this token may see; omit `owner`")
        owner = principal.owner
    return queries.JobFilter(
        states=state,
        tags=tag,
        owner=owner,
        group=group,
        parent=parent,
        task=task,
        robot=robot,
        text=q,
        job_id=principal.job_id,
    )


def controllable(service: Service, principal: Principal, job_id: str) -> Job:
    """Return a job that the caller may change. Raises NotFoundError."""
    return queries.visible_job(service.reads, principal, job_id)


@router.post("/jobs", status_code=201, responses={**SUBMIT, 200: {"model": JobPublic, "description": "Exists already"}})
def submit_job(body: JobCreate, principal: Submitter, service: ServiceDep, submitted: SubmissionDep) -> JobPublic:
    """Queue a training. 201 for a new job; 200 if the idempotency key was used before with the same body."""
    owner, request = principal.owner, body.request()
    job, created = submission.submit(
        service.sessions, request, owner=owner, see_all=principal.is_admin, **submitted.options
    )
    submitted.made(f"/jobs/{job.id}", job, created=created)
    return service.show_job(job)


@router.post(
    "/groups", status_code=201, responses={**SUBMIT, 200: {"model": GroupPublic, "description": "Exists already"}}
)
def submit_group(body: GroupCreate, principal: Submitter, service: ServiceDep, submitted: SubmissionDep) -> GroupPublic:
    """Queue several trainings that differ in seed or in fields of a grid: all of them, or none."""
    owner, request = principal.owner, body.request()
    group_id, jobs, created = submission.submit_group(
        service.sessions, request, owner=owner, see_all=principal.is_admin, **submitted.options
    )
    submitted.made(f"/jobs?group={group_id}", *jobs, created=created)
    return GroupPublic(id=group_id, jobs=service.show_jobs(jobs))


@router.get("/jobs", responses={**LIST, **responses(404)})
def list_jobs(
    wanted: Annotated[queries.JobFilter, Depends(job_filter)],
    service: ServiceDep,
    limit: PageLimit = 50,
    cursor: Cursor = None,
) -> JobPage:
    """List jobs, newest first."""
    rows = queries.list_jobs(service.reads, wanted, limit=limit + 1, before=cursor)
    return JobPage.of(service.show_jobs(rows), limit)


@router.get("/jobs/{job_id}", responses=READ)
def get_job(job_id: JobId, principal: Reader, service: ServiceDep) -> JobPublic:
    """Look up one job."""
    return service.show_job(queries.visible_job(service.reads, principal, job_id))


@router.patch("/jobs/{job_id}", responses={**CONTROL, **responses(413)})
def edit_job(job_id: JobId, body: JobPatch, principal: Submitter, service: ServiceDep) -> JobPublic:
    """Change a job's name, tags, notes or priority; fields left out stay as they are."""
    controllable(service, principal, job_id)
    return service.show_job(
        submission.edit(service.sessions, job_id, **body.model_dump(), limits=service.settings.limits)
    )


@router.post("/jobs/{job_id}/cancel", responses=CONTROL)
def cancel_job(job_id: JobId, principal: Submitter, service: ServiceDep) -> JobPublic:
    """Cancel a job. A running one writes a last checkpoint first; it is cancelled when its state is `cancelled`."""
    controllable(service, principal, job_id)
    return service.show_job(requests.request_cancel(service.sessions, Job, job_id))


@router.post("/jobs/{job_id}/pause", responses=CONTROL)
def pause_job(job_id: JobId, principal: Submitter, service: ServiceDep) -> JobPublic:
    """Pause a job. A running one writes a checkpoint first; it is paused when its state is `paused`."""
    controllable(service, principal, job_id)
    return service.show_job(requests.request_pause(service.sessions, job_id))


@router.post("/jobs/{job_id}/resume", responses=CONTROL)
def resume_job(job_id: JobId, principal: Submitter, service: ServiceDep, background: BackgroundTasks) -> JobPublic:
    """Queue a paused job again; it resumes from its last checkpoint."""
    controllable(service, principal, job_id)
    job = requests.resume(service.sessions, job_id, limits=service.settings.limits)
    background.add_task(service.wake_up, job)
    return service.show_job(job)


@router.post("/jobs/{job_id}/retry", responses=CONTROL)
def retry_job(job_id: JobId, principal: Submitter, service: ServiceDep, background: BackgroundTasks) -> JobPublic:
    """Queue a failed or cancelled job again; it resumes from its last checkpoint."""
    controllable(service, principal, job_id)
    job = requests.retry(service.sessions, Job, job_id, limits=service.settings.limits)
    background.add_task(service.wake_up, job)
    return service.show_job(job)


@router.delete("/jobs/{job_id}", status_code=204, responses=CONTROL)
def delete_job(job_id: JobId, principal: Submitter, service: ServiceDep, background: BackgroundTasks) -> None:
    """Delete an ended job with its metrics, logs, checkpoints and evaluations."""
    controllable(service, principal, job_id)
    requests.delete(service.sessions, job_id)
    service.principals.forget()  # the tokens of its links are deleted with it
    background.add_task(service.discard_artifacts, job_id)


@router.get("/jobs/{job_id}/metrics", responses=READ)
def get_metrics(
    job_id: JobId,
    principal: Reader,
    service: ServiceDep,
    max_points: Annotated[
        int,
        Query(
            ge=2,
            le=queries.MAX_POINTS,
            description="Maximum number of rows; others are omitted evenly, except the last.",
        ),
    ] = queries.MAX_POINTS,
    after_step: Annotated[int, Query(ge=-1, le=MAX_BIGINT, description="Only rows beyond this step.")] = -1,
) -> MetricsPublic:
    """Get the metrics of a job by column."""
    queries.visible_job(service.reads, principal, job_id)
    return queries.metrics_columns(service.reads, job_id, after_step=after_step, max_points=max_points)


@router.get("/jobs/{job_id}/logs", responses=READ)
def get_logs(
    job_id: JobId,
    principal: Reader,
    service: ServiceDep,
    after: After = 0,
    limit: Limit = 200,
    tail: Annotated[bool, Query(description="The last lines instead of those after `after`.")] = False,
    before: Annotated[
        int | None,
        Query(ge=1, le=MAX_BIGINT, description="The last lines before this id instead of those after `after`."),
    ] = None,
) -> LogPage:
    """Get lines of a job's log, oldest first."""
    queries.visible_job(service.reads, principal, job_id)
    if tail or before is not None:
        rows = queries.logs_tail(service.reads, job_id, limit=limit, before=before)
    else:
        rows = queries.logs_after(service.reads, job_id, after=after, limit=limit)
    return LogPage(items=[log_view(row) for row in rows], next_after=rows[-1].id if rows else None)


@router.get("/jobs/{job_id}/events", responses=READ)
def get_events(
    job_id: JobId, principal: Reader, service: ServiceDep, after: After = 0, limit: Limit = 200
) -> EventPage:
    """Get the history of a job, oldest first."""
    queries.visible_job(service.reads, principal, job_id)
    rows = queries.events_after(service.reads, job_id, after=after, limit=limit)
    return EventPage(items=[event_view(row) for row in rows], next_after=rows[-1].id if rows else None)
