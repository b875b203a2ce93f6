"""Idempotency keys: a request that is sent again returns what it has made already."""

from __future__ import annotations

from typing import TypeVar

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from naojobs.errors import ConflictError
from naojobs.models import Evaluation, Job, Match, PolicyVersion, Study

K = TypeVar("K", Job, Study, Match, Evaluation, PolicyVersion)


def hold_names(session: Session, owner: str) -> None:
    """Wait until no other transaction names or submits work of `owner`.

    Two must not both see the same free name, or the same unused key. A transaction waits for its quotas first
    (`wait_for_turn`), then for this, then for rows: that prevents deadlocks.
    """
    session.execute(select(func.pg_advisory_xact_lock(func.hashtextextended(f"name:{owner}", 0))))


def earlier(
    session: Session, model: type[K], scope: ColumnElement[bool], key: str | None, digest: str | None
) -> K | None:
    """Return what a request with the same key has made; none without a key.

    Args:
        session: a transaction that holds a lock which all requests of the scope take: `hold_names` for those of an
            owner, else the row that the new one belongs to.
        model: what the request makes.
        scope: condition on the rows among which a key is unique.
        key: the request's key.
        digest: the request's SHA-256.

    Raises:
        ConflictError: the key was used for another request.
    """
    if key is None:
        return None
    found = session.scalar(select(model).where(scope, model.idempotency_key == key))
    if found is not None and found.idempotency_digest != digest:
        made = f"version {found.number}" if isinstance(found, PolicyVersion) else found.id
        message = f"the key was used for another request, which made {made}; use a new key"
        raise ConflictError(message, "Idempotency-Key")
    return found
