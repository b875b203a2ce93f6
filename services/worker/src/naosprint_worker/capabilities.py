"""Capabilities of this worker: what the packages installed beside it can run."""

from __future__ import annotations

from naojobs.capabilities import Capabilities
from naospec import plugins

from naosprint_worker.settings import WorkerSettings


def installed_capabilities(settings: WorkerSettings) -> Capabilities:
    """Return the installed tasks and robots, and the simulators that the settings allow."""
    return Capabilities(
        tasks={name: plugins.load(plugins.TASKS, name).version for name in plugins.names(plugins.TASKS)},
        robots=list(plugins.names(plugins.ROBOTS)),
        simulators=list(settings.worker_queues),
    )
