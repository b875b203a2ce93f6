"""Updates of a job from the service's stream until it ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import httpx

from naoctl.client import Client
from naoctl.errors import CliError, ExitCode

ENDED = frozenset({"succeeded", "failed", "cancelled"})
"""States in which nothing more happens unless a user requests it."""
RESULT = {
    "succeeded": ExitCode.OK,
    "failed": ExitCode.JOB_FAILED,
    "cancelled": ExitCode.JOB_CANCELLED,
    "paused": ExitCode.JOB_PAUSED,
}
"""Exit code by final state of a job."""


@dataclass(frozen=True)
class Update:
    """One message of the stream, and the job after it.

    ``kind`` is ``job`` (its row changed), ``metrics`` (a row of metrics), ``log`` or ``event``.
    """

    kind: str
    data: dict[str, Any]
    job: dict[str, Any]


def follow(
    client: Client,
    job: dict[str, Any],
    *,
    only: Sequence[str] = (),
    logs_after: int = 0,
    events_after: int = 0,
    on_lost: Callable[[str, float], None] | None = None,
) -> Iterator[Update]:
    """Yield the updates of a job, from its first metrics row and log line, until it ends or is paused.

    Args:
        client: the service.
        job: the job as ``GET /jobs/{id}`` shows it.
        only: kinds of messages to ask for: metrics, log, event, state; all when empty.
        logs_after: id of the last log line that is known.
        events_after: id of the last event that is known.
        on_lost: called with the reason and the seconds until the next attempt when the connection is lost.
    """
    query = httpx.QueryParams({"only": list(only), "logs_after": logs_after, "events_after": events_after})
    for event in client.events(f"/jobs/{job['id']}/stream?{query}", on_lost=on_lost):
        data = event.data if isinstance(event.data, dict) else {}
        if event.kind == "state":
            job = {**job, **data}
            yield Update("job", job, job)
            if is_over(job):
                return
        elif event.kind in ("metrics", "log", "event"):
            yield Update(event.kind, data, job)
        elif event.kind == "gone":
            raise CliError(f"Job {job['id']} was deleted", code=ExitCode.NOT_FOUND)
        elif event.kind == "end":
            return


def is_over(job: dict[str, Any]) -> bool:
    """Return whether a job has ended or is paused."""
    return job["state"] in ENDED or job["state"] == "paused"


def result_of(job: dict[str, Any]) -> ExitCode:
    """Return the exit code of a followed job."""
    return RESULT.get(job["state"], ExitCode.FAILURE)
