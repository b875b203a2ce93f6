"""One shape of submissions: what makes jobs, groups, studies, evaluations and matches answers alike.

All take an `Idempotency-Key`, wake a worker for what is new, and name its address in `Location`; what the same request
has made before is answered with status 200.
"""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import BackgroundTasks, Depends, Response
from naojobs.models import AnyWork

from naosprint_api.dependencies import IdempotencyKey, ServiceDep


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

    @property
    def options(self) -> dict[str, Any]:
        """What every function of `naojobs` that submits takes."""
        return {"idempotency_key": self._key, "limits": self._service.settings.limits}

    def made(self, location: str, *work: AnyWork, created: bool) -> None:
        """Set the answer's status and address, and wake workers for new `work`."""
        self._response.headers["Location"] = location
        if not created:
            self._response.status_code = 200
        elif work:
            self._background.add_task(self._service.wake_up, *work)


SubmissionDep = Annotated[Submission, Depends(Submission)]
