"""rcssserver3d as a program that launchers start, and naosim's stand-in for it."""

from __future__ import annotations

import sys

from naosim.launchers import Launcher, ProcessLauncher, ServerProgram, launcher_from_environment

PROGRAM_VARIABLE = "NAOSPRINT_SIMSERVER"
"""Environment variable that names the server's program; ``embedded`` stands for ``naosim serve``, ``docker:IMAGE`` for
a container of that image."""

SERVER_SCRIPT = """\
# Headless and as fast as its agent: one trainer, one robot, no log files, no window.
$recordLogfile = false
$enableInternalMonitor = false
$enableRealTimeMode = false
$useRealTime = false
$agentSyncMode = true
$agentStep = 0.02
$monitorStep = 0.02
$serverMultiThreadedMode = false
$threadedAgentControl = false
sparkSetupServer()
sparkResetLogging()
sparkLogErrorToCerr()
run "scripts/materials.rb"
run "naosoccersim.rb"
"""
"""The server's settings for training, for its option ``--script-path``; the image has the same file."""

RCSSSERVER3D = ServerProgram(
    name="rcssserver3d",
    arguments=("--agent-port", "{agent_port}", "--server-port", "{monitor_port}"),
    process_arguments=("--script-path", "{home}/trainer.rb"),
    files={"trainer.rb": SERVER_SCRIPT},
)
"""The league's server, or any program with the same arguments."""

_SERVER_DIGITS = (2, 3)


def embedded_launcher(*arguments: str) -> ProcessLauncher:
    """Return a launcher of ``naosim serve`` with these arguments besides ports."""
    return ProcessLauncher(RCSSSERVER3D, (sys.executable, "-P", "-m", "naosim", "serve", "--quiet", *arguments))


def server_launcher(digits: int | None = 2) -> Launcher:
    """Return the launcher of the program that :data:`PROGRAM_VARIABLE` names.

    Args:
        digits: decimals that ``naosim serve`` prints; other programs have their own.

    Raises:
        FileNotFoundError: if there is no such program; the message names the variable.
        OSError: if containers are asked for and no Docker engine answers.
        ValueError: if no server prints this number of digits, or a variable is malformed.
    """
    if digits not in _SERVER_DIGITS:
        raise ValueError(f"sensor_digits: servers send 2 or 3 decimals, not all; use 2 or 3, not {digits}")
    return launcher_from_environment(PROGRAM_VARIABLE, RCSSSERVER3D, lambda: embedded_launcher("--digits", str(digits)))
