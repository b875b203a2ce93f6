"""What can go wrong between a user, a worker and the database."""

from __future__ import annotations


class JobError(Exception):
    """Is the root of everything that this package refuses."""


class NotFoundError(JobError):
    """Says that there is no such job, checkpoint or evaluation."""


class ConflictError(JobError):
    """Says that the request does not fit the state of the job; `field` names what to change."""

    def __init__(self, message: str, field: str = "state") -> None:
        super().__init__(message)
        self.field = field


class InvalidError(JobError):
    """Says that a value that only the database can judge is wrong; `field` names it."""

    def __init__(self, message: str, field: str) -> None:
        super().__init__(message)
        self.field = field


class QuotaError(JobError):
    """Says that an owner has too many open jobs."""


class LeaseLostError(JobError):
    """Says that the lease is no longer the caller's: it must stop and write nothing more."""
