"""Policies: bundled ones, and users' registered ones with their versions and aliases."""

from __future__ import annotations

from typing import Annotated, Any

import naopolicies
from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import FileResponse
from naojobs import policies
from naojobs.errors import ConflictError, NotFoundError
from naojobs.models import PolicyRecord, PolicyVersion
from naojobs.tokens import Principal
from pydantic import AfterValidator

from naosprint_api import cards, queries
from naosprint_api.dependencies import CountedRoute, FileName, IdempotencyKey, PageLimit, Reader, ServiceDep, Submitter
from naosprint_api.downloads import send_file
from naosprint_api.patterns import ALIAS, PLACE, PLAIN, POLICY, REFERENCE
from naosprint_api.problems import responses
from naosprint_api.routes.artifacts import finished
from naosprint_api.schemas.policies import (
    AliasSet,
    PolicyCard,
    PolicyDetails,
    PolicyPage,
    RequirementsSet,
    VersionCreate,
)
from naosprint_api.service import Service

router = APIRouter(tags=["policies"], route_class=CountedRoute)

_LIST = responses(401, 403, 404, 422, 429, 503)
_READ = responses(401, 403, 404, 409, 422, 429, 503)
_CONTROL: dict[int | str, dict[str, Any]] = {**_READ, **responses(413)}

Reference = Annotated[str, Path(pattern=REFERENCE, description="NAME, NAME@VERSION or NAME@ALIAS.")]
Name = Annotated[str, Path(pattern=POLICY, description="Name of the policy.")]
Number = Annotated[int, Path(ge=1, le=2**31 - 1, description="Number of the version.")]
Alias = Annotated[str, Path(pattern=ALIAS, description="Alias of a version.")]
Owner = Annotated[
    str | None,
    Query(max_length=200, pattern=PLAIN, description="Owner of the policy; others' policies need scope admin."),
]


def _registered(
    service: Service, principal: Principal, reference: str, owner: str | None
) -> tuple[PolicyRecord, PolicyVersion] | None:
    """Return a registered policy that the caller may see; none if it is a bundled one. Raises NotFoundError."""
    with service.reads.begin() as session:
        try:
            return policies.find(session, queries.owned_policies(principal, owner), reference)
        except NotFoundError as error:
            if reference in naopolicies.names():
                return None
            known = ", ".join(naopolicies.names()) or "none"
            raise NotFoundError(f"{error}; bundled policies are {known}") from None


def _own(service: Service, principal: Principal, name: str, owner: str | None) -> PolicyRecord:
    """Return a registered policy that the caller may change. Raises NotFoundError, ConflictError if it is bundled."""
    found = _registered(service, principal, name, owner)
    if found is None:
        raise ConflictError(
            f"{name} is a bundled policy, which cannot be changed; register one of another name", "name"
        )
    return found[0]


@router.get("/policies", responses=_LIST)
def list_policies(
    principal: Reader,
    service: ServiceDep,
    owner: Owner = None,
    limit: PageLimit = 50,
    cursor: Annotated[str | None, Query(pattern=PLACE, description="`next_cursor` of the previous page.")] = None,
) -> PolicyPage:
    """List the bundled policies, then the newest version of each registered one, oldest policy first."""
    return cards.policy_page(service.reads, queries.owned_policies(principal, owner), limit=limit, cursor=cursor)


@router.get("/policies/{reference}", responses=_READ)
def get_policy(reference: Reference, principal: Reader, service: ServiceDep, owner: Owner = None) -> PolicyDetails:
    """Look up a bundled policy, or a version of a registered one: the newest if none is named."""
    found = _registered(service, principal, reference, owner)
    return cards.version_details(service.reads, *found) if found else cards.bundled_details(reference)


@router.get("/policies/{reference}/versions", responses=_READ)
def list_versions(
    reference: Reference,
    principal: Reader,
    service: ServiceDep,
    owner: Owner = None,
    limit: PageLimit = 50,
    cursor: Annotated[int | None, Query(ge=1, le=2**31 - 1, description="`next_cursor` of the previous page.")] = None,
) -> PolicyPage:
    """List the versions of a policy, newest first; a bundled one has a single version."""
    found = _registered(service, principal, reference, owner)
    if found is None:
        return PolicyPage(items=[cards.bundled_card(reference)], next_cursor=None)
    return cards.version_page(service.reads, found[0], limit=limit, before=cursor)


@router.get(
    "/policies/{reference}/replay",
    response_class=Response,
    responses={**_READ, 200: {"description": "The replay", "content": {"application/json": {}}}},
)
def get_policy_replay(
    request: Request, reference: Reference, principal: Reader, service: ServiceDep, owner: Owner = None
) -> Response:
    """Return one episode of a policy, in the format of an evaluation's replay.json."""
    found = _registered(service, principal, reference, owner)
    if found is None:
        return FileResponse(naopolicies.folder(reference) / naopolicies.REPLAY, media_type="application/json")
    card = cards.version_details(service.reads, *found)
    if card.evaluation_id is None:
        raise NotFoundError(f"{card.reference} has no finished evaluation; evaluate its checkpoint first")
    key, manifest = finished(queries.evaluation(service.reads, card.evaluation_id))
    answer = send_file(
        request, service.store, service.store_threads, key, manifest, naopolicies.REPLAY, presigned=False
    )
    # Another evaluation, version or user may have another one at this address.
    answer.headers.update({"Content-Type": "application/json", "Cache-Control": "private, no-cache"})
    return answer


@router.get("/policies/{name}/files/{file}", response_class=FileResponse, responses=_READ)
def get_policy_file(name: Name, file: FileName, principal: Reader) -> FileResponse:
    """Download a file of a bundled policy; those of registered ones have the address of their checkpoint."""
    del principal
    if name not in naopolicies.names() or file not in cards.BUNDLED_FILES:
        raise NotFoundError(f"there is no file {file!r} of a bundled policy {name!r}; use a name from the list")
    return FileResponse(naopolicies.folder(name) / file, filename=file)


@router.post(
    "/policies/{name}/versions",
    status_code=201,
    responses={**_CONTROL, 200: {"model": PolicyCard, "description": "Known already"}},
)
def register_version(
    name: Name,
    body: VersionCreate,
    principal: Submitter,
    service: ServiceDep,
    response: Response,
    idempotency_key: IdempotencyKey = None,
) -> PolicyCard:
    """Register a checkpoint as the next version of a policy; the first one makes the policy.

    The policy belongs to the owner of the job. The checkpoint is kept for as long as the version exists.
    """
    job = queries.visible_job(service.reads, principal, body.job_id)
    version, created = policies.register(
        service.sessions,
        name,
        body.registration(),
        idempotency_key=idempotency_key,
        limits=service.settings.limits,
    )
    if not created:
        response.status_code = 200
    reference = f"{name}@{version.number}"
    response.headers["Location"] = f"/policies/{reference}"
    return get_policy(reference, principal, service, job.owner)


@router.put("/policies/{name}/aliases/{alias}", responses=_CONTROL)
def set_alias(
    name: Name,
    alias: Annotated[Alias, AfterValidator(policies.check_alias)],
    body: AliasSet,
    principal: Submitter,
    service: ServiceDep,
    owner: Owner = None,
) -> PolicyCard:
    """Point an alias at a version; it leaves the one that it named before."""
    policy = _own(service, principal, name, owner)
    policies.promote(service.sessions, policy.id, alias, body.version)
    return get_policy(f"{name}@{body.version}", principal, service, policy.owner)


@router.put("/policies/{name}/aliases/{alias}/requirements", responses=_CONTROL)
def set_requirements(
    name: Name,
    alias: Annotated[Alias, AfterValidator(policies.check_alias)],
    body: RequirementsSet,
    principal: Submitter,
    service: ServiceDep,
    owner: Owner = None,
) -> PolicyDetails:
    """Replace what an alias requires of the versions that it will name; an empty list removes it.

    A version that lacks a result, or has a worse one, is refused with the requirement, its value, and what to run.
    """
    policy = _own(service, principal, name, owner)
    policies.require(service.sessions, policy.id, alias, body.requirements)
    return get_policy(name, principal, service, policy.owner)


@router.delete("/policies/{name}/aliases/{alias}", status_code=204, responses=_READ)
def remove_alias(name: Name, alias: Alias, principal: Submitter, service: ServiceDep, owner: Owner = None) -> None:
    """Remove an alias; its version stays."""
    policies.remove_alias(service.sessions, _own(service, principal, name, owner).id, alias)


@router.delete("/policies/{name}/versions/{number}", status_code=204, responses=_READ)
def delete_version(name: Name, number: Number, principal: Submitter, service: ServiceDep, owner: Owner = None) -> None:
    """Delete a version that no alias names; its checkpoint stays with its job."""
    policies.delete_version(service.sessions, _own(service, principal, name, owner).id, number)


@router.delete("/policies/{name}", status_code=204, responses=_READ)
def delete_policy(name: Name, principal: Submitter, service: ServiceDep, owner: Owner = None) -> None:
    """Delete a policy with its versions and aliases; the checkpoints stay with their jobs."""
    policies.delete_policy(service.sessions, _own(service, principal, name, owner).id)
