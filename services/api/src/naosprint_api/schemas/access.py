"""Tokens and shared pages."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from naojobs.scopes import Scope
from naojobs.tokens import MAX_DAYS
from pydantic import BaseModel, Field, StringConstraints

from naosprint_api.patterns import PLAIN
from naosprint_api.schemas.common import Page, RequestBody, RowView


class ShareCreate(RequestBody):
    """Sharing of a job."""

    expires_in_days: float = Field(30, gt=0, le=366, description="Days until the link expires.")


class SharePublic(BaseModel):
    """Read-only token for one job."""

    token: str = Field(description="The secret. It is shown only here.")
    job_id: str
    expires_at: datetime


class PagePublic(BaseModel):
    """Address of a page that can be opened without a token for a few minutes."""

    url: str = Field(description="Where the page is, below the API's root.")
    expires_at: datetime


class TokenCreate(RequestBody):
    """Token to make."""

    owner: Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=PLAIN)] = Field(
        description="User whose jobs the token gives access to."
    )
    name: Annotated[str, StringConstraints(max_length=200, pattern=PLAIN)] = Field(
        "", description="Purpose of the token."
    )
    scopes: list[Scope] = Field(
        default_factory=lambda: [Scope.SUBMIT],
        min_length=1,
        max_length=len(Scope),
        description="read: see one's own jobs; submit: also submit and control them; metrics: the "
        "service's metrics only; admin: all jobs, and tokens.",
    )
    expires_in_days: float | None = Field(None, gt=0, le=MAX_DAYS, description="Days until it expires; null for never.")


class TokenPublic(RowView):
    """Token without its secret."""

    id: str
    name: str
    owner: str
    scopes: list[Scope]
    job_id: str | None = Field(description="The only job that it gives access to; null for all jobs of the owner.")
    parent_id: str | None = Field(
        description="The token that it was made with and is revoked with; null if an administrator made it."
    )
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None


class TokenPage(Page[TokenPublic]):
    """Page of tokens, oldest first."""


class TokenMade(TokenPublic):
    """New token with its secret."""

    token: str = Field(description="The secret. It is shown only here: the service stores only its SHA-256.")
