"""What a token may allow."""

from __future__ import annotations

from enum import StrEnum


class Scope(StrEnum):
    """What a token allows; each one includes those before it."""

    #: See one's own jobs.
    READ = "read"
    #: Submit and steer one's own jobs.
    SUBMIT = "submit"
    #: See and steer everybody's jobs, make and revoke tokens, and read the service's own figures.
    ADMIN = "admin"
