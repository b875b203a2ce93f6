"""Capabilities of this worker: what the packages installed beside it can run."""

from __future__ import annotations

from naojobs.capabilities import DEFAULT_TASK_VERSION, Capabilities
from naospec import TASKS
from naospec.robots import STANDING_HEIGHT_M

from naosprint_worker.settings import WorkerSettings


def installed_capabilities(settings: WorkerSettings) -> Capabilities:
    """Return the installed tasks and robots, and the simulators that the settings allow."""
    return Capabilities(
        tasks=dict.fromkeys(TASKS, DEFAULT_TASK_VERSION),
        robots=[f"nao-{robot_type}" for robot_type in range(len(STANDING_HEIGHT_M))],
        simulators=list(settings.worker_queues),
    )
