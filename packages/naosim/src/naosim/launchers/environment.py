"""Launchers as environment variables configure them, and how many servers a machine runs.

Each kind of server has a variable of its own, which names the program; the other variables are for all kinds.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping

from naosim.launchers.docker import ContainerSettings, DockerLauncher, remove_orphans
from naosim.launchers.process import ProcessLauncher
from naosim.launchers.server import Launcher, ServerProgram
from naosim.launchers.sidecar import SidecarLauncher

LABELS_VARIABLE = "NAOSPRINT_SIMSERVER_LABELS"
"""Job and attempt that containers serve, ``job=ID,attempt=NUMBER``; they become labels."""

DOCKER_PREFIX = "docker:"
SERVICE_PREFIX = "launcher:"
EMBEDDED = "embedded"

SERVERS_PER_CORE = 4
"""Running servers per core; more would only wait for each other."""


def launcher_from_environment(
    variable: str, program: ServerProgram, embedded: Callable[[], Launcher] | None = None
) -> Launcher:
    """Return the launcher of the program that an environment variable names.

    Args:
        variable: name of the variable. Its value is a program's name or path, ``docker:IMAGE``, ``launcher:URL`` of a
            launcher service, or ``embedded``. Without it the program's own name is looked up.
        program: the kind of server.
        embedded: returns the launcher that ``embedded`` stands for.

    Raises:
        FileNotFoundError: if there is no such program; the message names the variable.
        OSError: if containers are asked for and no Docker engine answers.
        ValueError: if a variable is malformed.
    """
    value = os.environ.get(variable) or program.name
    if value == EMBEDDED and embedded is not None:
        return embedded()
    if value.startswith(DOCKER_PREFIX):
        image = value.removeprefix(DOCKER_PREFIX)
        if not image:
            raise ValueError(f"{variable}: name the image after '{DOCKER_PREFIX}'")
        return DockerLauncher(program, ContainerSettings(image, labels=_labels()))
    if value.startswith(SERVICE_PREFIX):
        labels = _labels()
        job, attempt = labels.get("job", ""), labels.get("attempt", "")
        if not job or not attempt.isdecimal():
            raise ValueError(f"{LABELS_VARIABLE}: a launcher service needs job=ID,attempt=NUMBER")
        return SidecarLauncher(program, value.removeprefix(SERVICE_PREFIX), job, int(attempt))
    try:
        return ProcessLauncher(program, (value,))
    except FileNotFoundError:
        choices = [f"install {program.name}", f"set {variable} to its path", "to 'docker:IMAGE' for containers"]
        if embedded is not None:
            choices.append("to 'embedded' for the server that comes with naosim")
        advice = ", ".join(choices[:-1]) + f", or {choices[-1]}"
        raise FileNotFoundError(f"{variable}: there is no program {value!r} to run; {advice}") from None


def missing_program(
    variable: str, program: ServerProgram, environment: Mapping[str, str], *, embedded: bool = False
) -> str:
    """Return why no server can be started with the program that a variable names; empty if it is there.

    Containers count as available: the engine is contacted only when one is started.

    Args:
        variable: name of the variable, as for :func:`launcher_from_environment`.
        program: the kind of server.
        environment: the variables.
        embedded: whether ``embedded`` stands for a server.
    """
    value = environment.get(variable) or program.name
    known = value.startswith((DOCKER_PREFIX, SERVICE_PREFIX)) or (embedded and value == EMBEDDED)
    if known or shutil.which(value) is not None:
        return ""
    return f"{variable}: there is no program {value!r}"


def _labels() -> dict[str, str]:
    labels: dict[str, str] = {}
    for word in filter(None, os.environ.get(LABELS_VARIABLE, "").split(",")):
        key, separator, value = word.partition("=")
        if not separator or not key.strip():
            raise ValueError(f"{LABELS_VARIABLE}: must be key=value,key=value, not {word!r}")
        labels[key.strip()] = value.strip()
    return labels


def reap_servers(*programs: str) -> int:
    """Remove server containers whose owner has died; return how many.

    Args:
        programs: values of the servers' variables; only containers need this, processes end with their owner.

    Raises:
        OSError: if no Docker engine answers.
    """
    return remove_orphans() if any(program.startswith(DOCKER_PREFIX) for program in programs) else 0


def most_servers() -> int:
    """Return the most servers that this machine runs."""
    return SERVERS_PER_CORE * (os.cpu_count() or 1)


def require_servers(n: int) -> None:
    """Raise ValueError if this machine cannot run n servers; the message states what to set."""
    most = most_servers()
    if n > most:
        raise ValueError(
            f"n_envs: {n} robots need as many servers, and this machine with {os.cpu_count()} cores runs at most "
            f"{most}; set n_envs to {most} or less, batch_size to a divisor of n_envs * n_steps"
        )
