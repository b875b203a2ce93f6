"""Errors of this package."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_STATEMENT = re.compile(r"(?<!\s)\s*(\[SQL: |\bDETAIL: ).*?(?=\n\s*\n|\Z)", re.DOTALL)
"""What the database's driver and SQLAlchemy append to their messages; a match begins where white space does."""
_ADDRESS = re.compile(
    r"\b[A-Za-z][A-Za-z0-9+.-]{0,30}://[^\s'\"<>)\]]+|(?<=server at )\"[^\"]*\"(?: \([^)]*\))?, port \d+"
)
_PATH = re.compile(r"(?<![\w./…-])(['\"]?)(/(?:(?:(?<=['\"]/)[^'\"\n]*|[^\s'\":;,()]*))/([^\s'\":;,()/]*))")
"""Absolute path of at least two names, quoted or not: the quote, the path and its last name."""


def public(text: str) -> str:
    """Return a text for the user whose work it is about, without what only the operator may see.

    Users get no SQL statement, no address of a service and no folder of a worker: of a module's file they get the path
    from where its package lies, of others the name. The worker's log has the rest.
    """
    return _PATH.sub(_shortened, _ADDRESS.sub("(address)", _STATEMENT.sub("", text)))


def _shortened(path: re.Match[str]) -> str:
    quote, whole, name = path.groups()
    roots = (root for root in sys.path if name.endswith(".py") and root and whole.startswith(f"{root}/"))
    root = max(roots, key=len, default=None)
    return quote + (f"…/{name}" if root is None else whole[len(root) + 1 :])


class JobError(Exception):
    """Base of all errors of this package."""


class NotFoundError(JobError):
    """Reference to a job, checkpoint or evaluation that does not exist."""


class OtherSchemaError(JobError):
    """Database of another version's schema."""


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
