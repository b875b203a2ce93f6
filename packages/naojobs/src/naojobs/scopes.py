"""Scopes of tokens."""

from __future__ import annotations

from enum import StrEnum


class Scope(StrEnum):
    """Scope of a token; each one includes those before it."""

    #: See one's own jobs.
    READ = "read"
    #: Submit and control one's own jobs.
    SUBMIT = "submit"
    #: Access to all users' jobs, to tokens, and to the service's metrics.
    ADMIN = "admin"
