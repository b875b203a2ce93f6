"""Tokens: make, list, revoke; users share their own jobs with tokens of scope read."""

from __future__ import annotations

import logging
from datetime import timedelta
from typing import Annotated

from fastapi import APIRouter, Path
from naojobs.errors import NotFoundError
from naojobs.ids import PATTERN
from naojobs.tokens import Scope, create_token, get_token, list_tokens, revoke

from naosprint_api.dependencies import CountedRoute, Cursor, PageLimit, ServiceDep, Submitter, require
from naosprint_api.problems import responses
from naosprint_api.schemas.access import TokenCreate, TokenMade, TokenPage, TokenPublic

router = APIRouter(tags=["tokens"], route_class=CountedRoute)

_log = logging.getLogger(__name__)

TokenId = Annotated[str, Path(pattern=PATTERN, description="Id of the token, never its secret.")]


@router.post("/tokens", status_code=201, responses=responses(401, 403, 409, 413, 422, 429, 503))
def make_token(body: TokenCreate, principal: Submitter, service: ServiceDep) -> TokenMade:
    """Make a token. Its secret is only in this answer: the service stores only its SHA-256.

    With scope submit one can make tokens with scope read, which show all one's own jobs; all others need scope admin.
    Such a token is revoked with the one that it was made with, and expires no later; those that an administrator makes
    are independent.
    """
    if not principal.is_admin and (body.owner != principal.owner or set(body.scopes) != {Scope.READ}):
        require(Scope.ADMIN, principal, service)
    days = body.expires_in_days
    token_id, secret = create_token(
        service.sessions,
        name=body.name,
        owner=body.owner,
        scopes=body.scopes,
        valid_for=None if days is None else timedelta(days=days),
        parent_id=None if principal.is_admin else principal.token_id,
        limits=service.settings.limits,
    )
    _log.info("%s (%s) made token %s", principal.owner, principal.token_id, token_id)
    shown = TokenPublic.model_validate(get_token(service.reads, token_id))
    return TokenMade(**shown.model_dump(), token=secret)


@router.get("/tokens", responses=responses(401, 403, 422, 429, 503))
def show_tokens(principal: Submitter, service: ServiceDep, limit: PageLimit = 50, cursor: Cursor = None) -> TokenPage:
    """List one's own tokens, or all with scope admin, oldest first, without their secrets."""
    owner = None if principal.is_admin else principal.owner
    rows = list_tokens(service.reads, owner, limit=limit + 1, after=cursor)
    return TokenPage.of([TokenPublic.model_validate(token) for token in rows], limit)


@router.delete("/tokens/{token_id}", status_code=204, responses=responses(401, 403, 404, 422, 429, 503))
def revoke_token(token_id: TokenId, principal: Submitter, service: ServiceDep) -> None:
    """Revoke a token and those that were made with it; they stay in the list.

    A token revokes those that have no scope beyond its own, itself among them. Other users' tokens need scope admin.
    """
    token = get_token(service.reads, token_id)
    if not principal.is_admin and token.owner != principal.owner:
        raise NotFoundError(f"no token {token_id}")
    for scope in token.scopes:
        require(Scope(scope), principal, service)
    revoke(service.sessions, token_id)
    service.principals.forget()
    _log.info("%s (%s) revoked token %s", principal.owner, principal.token_id, token_id)
