"""One shape of submissions: what makes jobs, groups, studies, evaluations and matches answers alike.

All take an `Idempotency-Key`, refuse an owner without space, wake a worker for what is new, and name its address in
`Location`; what the same request has made before is answered with status 200.
"""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import BackgroundTasks, Depends, Response
from naojobs.models import AnyWork
from naojobs.quotas import Quota, require_room

from naosprint_api.dependencies import IdempotencyKey, ServiceDep
from naosprint_api.service import Service


def require_space(service: Service, owner: str) -> None:
    """Raise QuotaError if the owner's jobs have stored as much as they may."""
    with service.reads.begin() as session:
        require_room(session, owner, service.settings.limits, Quota.BYTES, Quota.ROWS)


class Submission:
    """A request that submits work, and its answer."""

    def __init__(
        self,
        service: ServiceDep,
        background: BackgroundTasks,
        response: Response,
        idempotency_key: IdempotencyKey = None,
    ) -> None:
        self._service = service
        self._background = background
        self._response = response
        self._key = idempotency_key

    def options(self, owner: str) -> dict[str, Any]:
        """Return what every function of `naojobs` that submits takes. Raises QuotaError without space for `owner`."""
        require_space(self._service, owner)
        return {"idempotency_key": self._key, "limits": self._service.settings.limits}

    def made(self, location: str, *work: AnyWork, created: bool) -> None:
        """Set the answer's status and address, and wake workers for new `work`."""
        self._response.headers["Location"] = location
        if not created:
            self._response.status_code = 200
        elif work:
            self._background.add_task(self._service.wake_up, *work)


SubmissionDep = Annotated[Submission, Depends(Submission)]
