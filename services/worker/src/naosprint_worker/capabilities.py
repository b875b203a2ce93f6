"""Capabilities of this worker: what the packages installed beside it can run."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator

from naojobs.capabilities import Capabilities
from naospec import plugins

from naosprint_worker.settings import WorkerSettings

logger = logging.getLogger(__name__)


def installed_capabilities(settings: WorkerSettings) -> Capabilities:
    """Return installed tasks and algorithms, simulators that the settings allow, and robots that one of them runs."""
    return Capabilities(
        tasks={name: task.version for name, task in plugins.usable(plugins.TASKS)},
        robots=list(_robots(settings)),
        simulators=list(settings.worker_queues),
        algorithms=[name for name, _ in plugins.usable(plugins.LEARNERS)],
    )


def _robots(settings: WorkerSettings) -> Iterator[str]:
    """Yield the robots that this machine can run in one of the worker's simulators; log why others are left out."""
    environment = {**os.environ, **settings.server_environment}
    simulators = {name: plugins.load(plugins.SIMULATORS, name) for name in settings.worker_queues}
    for name in plugins.names(plugins.ROBOTS):
        robot = plugins.load(plugins.ROBOTS, name)
        reasons = {
            simulator: kind.unavailable(robot, environment)
            for simulator, kind in simulators.items()
            if kind.supports(robot)
        }
        for simulator, reason in reasons.items():
            if reason:
                logger.warning("robot %s cannot run in simulator %s: %s", name, simulator, reason)
        if "" in reasons.values():
            yield name
