"""rcssservermj as a program that launchers start."""

from __future__ import annotations

import os
import shutil
import signal
import sys

from naosim.launchers import Launcher, ProcessLauncher, ServerProgram, launcher_from_environment
from naosim.mujoco.world import MujocoUnavailableError, require_package

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
        FileNotFoundError: if there is no such program, or no server of the league's version; the message says what to
            install or set.
        OSError: if containers are asked for and no Docker engine answers.
        ValueError: if a variable is malformed.
    """
    if os.environ.get(PROGRAM_VARIABLE):
        return launcher_from_environment(PROGRAM_VARIABLE, RCSSSERVERMJ)
    try:
        require_package("mujoco")
        require_package("rcsssmj")
    except MujocoUnavailableError as error:
        if shutil.which(RCSSSERVERMJ.name) is not None:
            return ProcessLauncher(RCSSSERVERMJ)
        raise MujocoUnavailableError(
            f"{RCSSSERVERMJ.name}: no server to run ({error}), or set {PROGRAM_VARIABLE} to its path or "
            "to 'docker:IMAGE'"
        ) from None
    return ProcessLauncher(RCSSSERVERMJ, (sys.executable, "-m", "rcsssmj"))
