"""Bearer tokens: 256 random bits, of which the database keeps only the SHA-256.

A plain hash is enough, since a random secret cannot be guessed from a dictionary.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta

from sqlalchemy import ColumnElement, delete, func, select, update
from sqlalchemy.orm import Session

from naojobs.database import Sessions
from naojobs.errors import ConflictError, NotFoundError
from naojobs.ids import new_id
from naojobs.models import Job, Token
from naojobs.quotas import NO_LIMITS, Limits, Quota, require_room
from naojobs.scopes import Scope

__all__ = [
    "Principal",
    "Scope",
    "create_token",
    "forget",
    "get_token",
    "hold",
    "is_valid",
    "list_tokens",
    "principal_of",
    "revoke",
    "revoke_shared",
    "verify",
]

_PREFIX = "nao_"
MAX_NAME = 200
"""Characters of the name of a token, and of its owner's."""
MAX_DAYS = 36_500
"""Days until a token expires; far beyond, there are times that only the database can read."""
KEEP = timedelta(days=30)
"""Time for which tokens are listed that have been revoked or have expired."""

_INCLUDES = {
    Scope.READ: frozenset({Scope.READ}),
    Scope.SUBMIT: frozenset({Scope.READ, Scope.SUBMIT}),
    Scope.METRICS: frozenset({Scope.METRICS}),
    Scope.ADMIN: frozenset(Scope),
}


@dataclass(frozen=True, slots=True)
class Principal:
    """Sender of a request and its scopes."""

    token_id: str
    owner: str
    scopes: frozenset[Scope]
    job_id: str | None = None
    """The only job that it may access; none for all jobs of the owner."""

    @property
    def is_admin(self) -> bool:
        """Whether it may access all users' jobs."""
        return Scope.ADMIN in self.scopes

    def may_see(self, owner: str, job_id: str) -> bool:
        """Return whether it may access a job of `owner`."""
        return self.job_id in (None, job_id) and (self.is_admin or owner == self.owner)


def create_token(
    sessions: Sessions,
    *,
    name: str,
    owner: str,
    scopes: Sequence[Scope],
    valid_for: timedelta | None = None,
    job_id: str | None = None,
    parent_id: str | None = None,
    limits: Limits = NO_LIMITS,
) -> tuple[str, str]:
    """Make a token, of one job if `job_id` is given; return its id and the secret, which cannot be read again.

    One made with the token `parent_id` is revoked with it and expires no later. Raises ConflictError if that token is
    not valid any more, NotFoundError if there is no such job, and QuotaError if `owner` has as many tokens as `limits`
    allow.
    """
    if not scopes:
        raise ValueError(f"scopes: give at least one of {', '.join(Scope)}")
    if not owner or len(owner) > MAX_NAME:
        raise ValueError(f"owner: give 1 to {MAX_NAME} characters")
    if len(name) > MAX_NAME:
        raise ValueError(f"name: give at most {MAX_NAME} characters")
    if valid_for is not None and valid_for > timedelta(days=MAX_DAYS):
        raise ValueError(f"days: give at most {MAX_DAYS:,}, or none for a token that does not expire")
    secret = _PREFIX + secrets.token_urlsafe(32)
    expires_at = func.now() + valid_for if valid_for is not None else None
    with sessions.begin() as session:
        if parent_id is not None:
            parent = hold(session, parent_id)
            expires_at = func.least(expires_at, parent.expires_at) if parent.expires_at is not None else expires_at
        require_room(session, owner, limits, Quota.TOKENS)
        if job_id is not None:
            job = select(Job.id).where(Job.id == job_id).with_for_update(read=True, key_share=True)
            if session.scalar(job) is None:
                raise NotFoundError(f"no job {job_id}")
        session.connection()  # ids have the time of its clock
        token_id = new_id("token")
        session.add(
            Token(
                id=token_id,
                name=name,
                owner=owner,
                sha256=_sha256(secret),
                scopes=sorted(str(Scope(scope)) for scope in scopes),
                job_id=job_id,
                parent_id=parent_id,
                expires_at=expires_at,
            ),
        )
    return token_id, secret


def hold(session: Session, token_id: str) -> Token:
    """Return a valid token whose revocation waits until the transaction has ended. Raises ConflictError."""
    token = session.scalar(select(Token).where(Token.id == token_id, Token.is_valid()).with_for_update(read=True))
    if token is None:
        raise ConflictError("the token has been revoked or has expired; use another one", "Authorization")
    return token


def verify(sessions: Sessions, secret: str) -> Principal | None:
    """Return the principal of `secret`, or none if it is unknown, expired or revoked."""
    return _principal(sessions, Token.sha256 == _sha256(secret))


def principal_of(sessions: Sessions, token_id: str) -> Principal | None:
    """Return the principal of a token by its id, or none if it is unknown, expired or revoked."""
    return _principal(sessions, Token.id == token_id)


def _principal(sessions: Sessions, condition: ColumnElement[bool]) -> Principal | None:
    with sessions.begin() as session:
        token = session.scalar(select(Token).where(condition, Token.is_valid()))
        if token is None:
            return None
        scopes = frozenset().union(*(_INCLUDES[Scope(scope)] for scope in token.scopes))
        return Principal(token.id, token.owner, scopes, token.job_id)


def is_valid(sessions: Sessions, token_id: str) -> bool:
    """Return whether a token is neither expired nor revoked."""
    with sessions.begin() as session:
        return session.scalar(select(Token.id).where(Token.id == token_id, Token.is_valid())) is not None


def revoke(sessions: Sessions, token_id: str) -> None:
    """Revoke a token and all that were made with it; webhooks see it in `webhooks.take_due`. Raises NotFoundError."""
    with sessions.begin() as session:
        if session.scalar(select(Token.id).where(Token.id == token_id).with_for_update()) is None:
            raise NotFoundError(f"no token {token_id}")
        made = select(Token.id).where(Token.id == token_id).cte(recursive=True)
        made = made.union_all(select(Token.id).join(made, Token.parent_id == made.c.id))
        session.execute(
            update(Token)
            .where(Token.id.in_(select(made.c.id)), Token.revoked_at.is_(None))
            .values(revoked_at=func.now())
            .execution_options(synchronize_session=False)
        )


def revoke_shared(sessions: Sessions, job_id: str) -> int:
    """Revoke all tokens that give access to one job only; return their number."""
    with sessions.begin() as session:
        statement = (
            update(Token).where(Token.job_id == job_id, Token.revoked_at.is_(None)).values(revoked_at=func.now())
        )
        return len(session.scalars(statement.returning(Token.id)).all())


def forget(sessions: Sessions) -> int:
    """Delete tokens that were revoked or have expired long ago; return how many."""
    ended = func.least(Token.revoked_at, Token.expires_at)  # of null and a time the time
    with sessions.begin() as session:
        return len(session.scalars(delete(Token).where(ended < func.now() - KEEP).returning(Token.id)).all())


def get_token(sessions: Sessions, token_id: str) -> Token:
    """Return a token, without its secret. Raises NotFoundError."""
    with sessions.begin() as session:
        token = session.get(Token, token_id)
    if token is None:
        raise NotFoundError(f"no token {token_id}")
    return token


def list_tokens(
    sessions: Sessions, owner: str | None = None, *, limit: int | None = None, after: str | None = None
) -> list[Token]:
    """Return all tokens, or those of an owner, or `limit` of them after the token `after`; oldest first."""
    statement = select(Token).order_by(Token.id).limit(limit)
    if owner is not None:
        statement = statement.where(Token.owner == owner)
    if after is not None:
        statement = statement.where(Token.id > after)
    with sessions.begin() as session:
        return list(session.scalars(statement))


def _sha256(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
