"""Workers, and what an owner uses."""

from __future__ import annotations

from datetime import datetime

from pydantic import Field

from naosprint_api.schemas.common import Page, RequestBody, RowView


class WorkerPublic(RowView):
    """Worker."""

    id: str
    host: str
    pid: int
    queues: list[str] = Field(description="Its simulators.", json_schema_extra={"deprecated": True})
    tasks: dict[str, int] = Field(description="Version by name of each task that it can run.")
    robots: list[str]
    simulators: list[str]
    algorithms: list[str]
    version: str
    disk_free_bytes: int | None = Field(description="Free space on the disk of its working folders.")
    drained_at: datetime | None = Field(description="Since when it claims no work at an administrator's request.")
    started_at: datetime
    heartbeat_at: datetime
    alive: bool = Field(description="Whether its last heartbeat is recent.")
    jobs: list[str] = Field(description="Its leased jobs.")
    evaluations: list[str] = Field([], description="Its leased evaluations.")
    matches: list[str] = Field([], description="Its leased matches.")


class WorkerDrain(RequestBody):
    """How to drain a worker."""

    requeue: bool = Field(
        False,
        description="Whether its trainings write a checkpoint and wait for another worker instead of ending here.",
    )


class UsagePublic(RowView):
    """What an owner's work has used in a period."""

    owner: str
    cpu_s: float = Field(description="Seconds of processors that attempts were busy.")
    run_s: float = Field(description="Seconds that attempts took.")


class WorkerPage(Page[WorkerPublic]):
    """Page of workers, by id."""
