"""Scopes of tokens."""

from __future__ import annotations

from enum import StrEnum


class Scope(StrEnum):
    """Scope of a token; submit includes read, admin includes all others."""

    #: See one's own jobs.
    READ = "read"
    #: Submit and control one's own jobs.
    SUBMIT = "submit"
    #: Read the service's metrics, and nothing else.
    METRICS = "metrics"
    #: Access to all users' jobs, to tokens, and to the service's metrics.
    ADMIN = "admin"
