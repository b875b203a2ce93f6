"""Errors of this package."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class JobError(Exception):
    """Base of all errors of this package."""


class NotFoundError(JobError):
    """Reference to a job, checkpoint or evaluation that does not exist."""


class ConflictError(JobError):
    """Request that the current state does not allow; `field` names what to change."""

    def __init__(self, message: str, field: str = "state") -> None:
        super().__init__(message)
        self.field = field


class InvalidError(JobError):
    """Wrong value that only the database could reveal; `field` names it."""

    def __init__(self, message: str, field: str) -> None:
        super().__init__(message)
        self.field = field


@contextmanager
def within(place: str) -> Iterator[None]:
    """Put `place` before the field of an InvalidError: of a job in a group or a study, ``job.spec.robot``."""
    try:
        yield
    except InvalidError as error:
        raise InvalidError(str(error), f"{place}.{error.field}") from None


class QuotaError(JobError):
    """Request of an owner who has as much as a quota allows."""


class LeaseLostError(JobError):
    """Lease that is no longer the caller's, who must stop and write nothing more."""
