"""Capabilities of this worker: what the packages installed beside it can run."""

from __future__ import annotations

import logging

from naojobs.capabilities import Capabilities
from naospec import plugins

from naosprint_worker.settings import WorkerSettings


logger = logging.getLogger(__name__)


def installed_capabilities(settings: WorkerSettings) -> Capabilities:
    """Return the installed tasks and robots, and the simulators that the settings allow."""
    return Capabilities(
        tasks=_versions(),
        robots=list(plugins.names(plugins.ROBOTS)),
        simulators=list(settings.worker_queues),
    )


def _versions() -> dict[str, int]:
    """Return the version of each installed task by name; one that cannot be loaded is left out."""
    versions = {}
    for name in plugins.names(plugins.TASKS):
        try:
            versions[name] = int(plugins.load(plugins.TASKS, name).version)
        except plugins.BrokenPluginError as error:
            logger.warning("task left out: %s", error)
    return versions
