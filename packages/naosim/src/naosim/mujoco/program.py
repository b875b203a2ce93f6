"""rcssservermj as a program that launchers start."""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections.abc import Mapping

from naosim.launchers import Launcher, ProcessLauncher, ServerProgram, launcher_from_environment, missing_program
from naosim.mujoco.world import MujocoUnavailableError, missing_packages

PROGRAM_VARIABLE = "NAOSPRINT_RCSSSERVERMJ"
"""Environment variable that names the server's program; ``docker:IMAGE`` stands for a container of that image."""

RCSSSERVERMJ = ServerProgram(
    name="rcssservermj",
    arguments=("--aport", "{agent_port}", "--mport", "{monitor_port}", "--sync", "--no-realtime", "--no-render"),
    process_arguments=("--host", "127.0.0.1"),
    agent_port=60000,
    monitor_port=60001,
    stop_signal=signal.SIGINT,
)
"""The league's server in its parallel loop, as fast as its agents; an image adds the address to listen on."""


def server_launcher() -> Launcher:
    """Return the launcher of the program that :data:`PROGRAM_VARIABLE` names.

    Without it the server of this interpreter's environment is started, which ``rcsssmj`` installs.

    Raises:
        FileNotFoundError: if there is no such program, or no server of the league's version; the message states what to
            install or set.
        OSError: if containers are asked for and no Docker engine answers.
        ValueError: if a variable is malformed.
    """
    if os.environ.get(PROGRAM_VARIABLE):
        return launcher_from_environment(PROGRAM_VARIABLE, RCSSSERVERMJ)
    if not missing_packages():
        return ProcessLauncher(RCSSSERVERMJ, (sys.executable, "-P", "-m", "rcsssmj"))
    missing = missing_server({})
    if missing:
        raise MujocoUnavailableError(missing)
    return ProcessLauncher(RCSSSERVERMJ)


def missing_server(environment: Mapping[str, str]) -> str:
    """Return why no server can be started with these variables; empty if one can."""
    if environment.get(PROGRAM_VARIABLE):
        return missing_program(PROGRAM_VARIABLE, RCSSSERVERMJ, environment)
    missing = missing_packages()
    if not missing or shutil.which(RCSSSERVERMJ.name) is not None:
        return ""
    return (
        f"{RCSSSERVERMJ.name}: no server to run ({missing}), or set {PROGRAM_VARIABLE} to its path or to 'docker:IMAGE'"
    )
