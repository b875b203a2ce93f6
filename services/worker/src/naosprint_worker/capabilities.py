"""Capabilities of this worker: what the packages installed beside it can run."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator

from naojobs.capabilities import MATCH_QUEUE, MATCH_VERSION, Capabilities, match_task
from naojobs.notifications import DEFAULT_QUEUE
from naosim.launchers.docker import connect
from naosim.mujoco.program import PROGRAM_VARIABLE, missing_server
from naospec import plugins
from naosprint.matches import confine

from naosprint_worker.settings import WorkerSettings

logger = logging.getLogger(__name__)


def installed_capabilities(settings: WorkerSettings) -> Capabilities:
    """Return installed tasks and algorithms, simulators that the settings allow, and robots that one of them runs."""
    matches = _matches(settings)
    return Capabilities(
        tasks={name: task.version for name, task in plugins.usable(plugins.TASKS)} | matches,
        robots=list(_robots(settings)),
        simulators=[*settings.worker_queues, *([MATCH_QUEUE] if matches else [])],
        algorithms=[name for name, _ in plugins.usable(plugins.LEARNERS)],
    )


def _matches(settings: WorkerSettings) -> dict[str, int]:
    """Return the kinds of matches that this machine can play, as tasks with their versions; log why not all."""
    if DEFAULT_QUEUE not in settings.worker_queues:
        return {}
    environment = {**os.environ, **settings.server_environment}
    reason = missing_server(environment)
    if environment.get(PROGRAM_VARIABLE, "").startswith("docker:"):
        reason = f"the server has to be a process of this machine; unset {PROGRAM_VARIABLE}"
    if reason:
        logger.warning("this worker plays no matches: %s", reason)
        return {}
    confines = not (lacks := confine.missing())
    if lacks:
        logger.warning("this worker plays no matches of uploaded teams: %s", lacks)
    kinds = [match_task(confined=False, contained=False)]
    if confines:
        kinds.append(match_task(confined=True, contained=False))
    if _has_containers(settings):
        kinds += [match_task(confined=confined, contained=True) for confined in {False, confines}]
    return dict.fromkeys(kinds, MATCH_VERSION)


def _has_containers(settings: WorkerSettings) -> bool:
    """Return whether teams can play from container images here; log why not."""
    if not settings.relay_image:
        return False
    try:
        connect().close()
    except OSError as error:
        logger.warning("this worker plays no matches of teams with an image: %s", error)
        return False
    return True


def _robots(settings: WorkerSettings) -> Iterator[str]:
    """Yield the robots that this machine can run in one of the worker's simulators; log why others are left out."""
    environment = {**os.environ, **settings.server_environment}
    simulators = {name: plugins.load(plugins.SIMULATORS, name) for name in settings.worker_queues}
    for name, robot in plugins.usable(plugins.ROBOTS):
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
