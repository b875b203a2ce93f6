"""Tokens against a real Postgres."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from functools import partial

import pytest
from naojobs.errors import NotFoundError
from naojobs.models import Job, Token
from naojobs.submission import JobRequest, submit
from naojobs.tokens import KEEP, Scope, create_token, forget, list_tokens, revoke, verify
from sqlalchemy import text, update
from sqlalchemy.orm import Session, sessionmaker

Sessions = sessionmaker[Session]


def test_only_the_hash_is_kept(sessions: Sessions) -> None:
    token_id, secret = create_token(sessions, name="n", owner="alice", scopes=[Scope.SUBMIT])
    with sessions.begin() as session:
        row = session.execute(text("SELECT * FROM tokens WHERE id = :id"), {"id": token_id}).one()
    assert secret not in str(row)
    principal = verify(sessions, secret)
    assert principal is not None
    assert (principal.owner, principal.scopes) == ("alice", {Scope.READ, Scope.SUBMIT})
    assert not principal.is_admin
    assert verify(sessions, secret[:-1]) is None
    assert verify(sessions, row.sha256) is None


def test_an_expired_or_revoked_token_is_no_token(sessions: Sessions) -> None:
    _, expired = create_token(sessions, name="", owner="a", scopes=[Scope.READ], valid_for=timedelta(seconds=-1))
    assert verify(sessions, expired) is None
    token_id, secret = create_token(sessions, name="", owner="a", scopes=[Scope.ADMIN], valid_for=timedelta(minutes=1))
    assert verify(sessions, secret) is not None
    revoke(sessions, token_id)
    assert verify(sessions, secret) is None
    first = next(token for token in list_tokens(sessions) if token.id == token_id).revoked_at
    revoke(sessions, token_id)
    assert next(token for token in list_tokens(sessions) if token.id == token_id).revoked_at == first


def test_tokens_are_forgotten_a_month_after_their_end(sessions: Sessions) -> None:
    def make(**changes: datetime) -> str:
        identifier, _ = create_token(sessions, name="", owner="old", scopes=[Scope.READ])
        with sessions.begin() as session:
            session.execute(update(Token).where(Token.id == identifier).values(changes or {"name": "valid"}))
        return identifier

    now = datetime.now(UTC)
    long_ago, recently, soon = now - KEEP - timedelta(days=1), now - timedelta(days=1), now + timedelta(days=1)
    kept = [make(), make(revoked_at=recently), make(expires_at=soon), make(expires_at=recently, revoked_at=recently)]
    for end in ({"revoked_at": long_ago}, {"expires_at": long_ago}, {"revoked_at": long_ago, "expires_at": soon}):
        make(**end)
    assert forget(sessions) == 3
    assert [token.id for token in list_tokens(sessions, "old")] == kept


@pytest.mark.parametrize(("owner", "scopes"), [("", [Scope.READ]), ("a" * 201, [Scope.READ]), ("a", [])])
def test_a_token_needs_an_owner_and_a_scope(sessions: Sessions, owner: str, scopes: list[Scope]) -> None:
    with pytest.raises(ValueError, match=r"^(owner|scopes): give"):
        create_token(sessions, name="", owner=owner, scopes=scopes)


def test_a_token_of_a_job_that_is_being_deleted_finds_none(sessions: Sessions) -> None:
    job_id = submit(sessions, JobRequest(), owner="dora")[0].id
    make = partial(create_token, sessions, name="", owner="dora", scopes=[Scope.READ], job_id=job_id)
    make()
    with ThreadPoolExecutor(1) as pool:
        with sessions.begin() as session:
            session.delete(session.get_one(Job, job_id))
            session.flush()
            token = pool.submit(make)
            while not session.scalar(text("SELECT count(*) FROM pg_locks WHERE NOT granted")):
                assert not token.done(), "it did not wait"
        with pytest.raises(NotFoundError, match=job_id):
            token.result(30)
    assert list_tokens(sessions, "dora") == []
