"""Scopes of tokens."""

from __future__ import annotations

from enum import StrEnum


class Scope(StrEnum):
    """Scope of a token; submit includes read, admin includes all others."""

    READ = "read"
    """See one's own jobs."""
    SUBMIT = "submit"
    """Submit and control one's own jobs."""
    METRICS = "metrics"
    """Read the service's metrics, and nothing else."""
    ADMIN = "admin"
    """Access to all users' jobs, to tokens, and to the service's metrics."""
