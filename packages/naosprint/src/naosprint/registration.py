"""Registration of all tasks as Gymnasium environments, without loading PyTorch."""

from __future__ import annotations

import logging

from naospec import plugins

from naosprint import tasks

logger = logging.getLogger(__name__)

NAMESPACE = "naosprint"

DEFAULT_ID = f"{NAMESPACE}/Sprint-v0"
"""Environment of the task that specifications train by default, for any version of the task."""


def env_id(name: str, version: int) -> str:
    """Return the id of a task's environment: ``naosprint/RunBackwards-v1`` for version 1 of ``run-backwards``."""
    camel = "".join(part[:1].upper() + part[1:] for part in name.replace("_", "-").split("-"))
    return f"{NAMESPACE}/{camel}-v{version}"


def register_envs() -> None:
    """Register every installed task that is not registered yet; Gymnasium must be installed.

    ``import naosprint`` does this. A package that is imported before naosprint, and offers a task itself, is not yet
    complete then; call this function again after importing it.
    """
    from gymnasium.envs.registration import register, registry
    from naospec.fields import DEFAULTS

    wanted = {DEFAULT_ID: DEFAULTS["task"]}
    for name in plugins.names(plugins.TASKS):
        try:
            wanted[env_id(name, tasks.get(name).version)] = name
        except plugins.BrokenPluginError as error:
            logger.debug("not registered: %s", error)
    for identity, name in wanted.items():
        if identity not in registry:
            register(
                identity,
                entry_point="naosprint.envs:TaskEnv",
                vector_entry_point="naosprint.envs:TaskVectorEnv",
                kwargs={"task": name} if identity == DEFAULT_ID else {"registered_task": name},
            )
