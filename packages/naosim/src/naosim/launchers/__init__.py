"""Launchers of servers as processes or containers: start, watch, stop and remove them."""

from __future__ import annotations

from naosim.launchers.docker import ContainerSettings, DockerLauncher
from naosim.launchers.environment import (
    LABELS_VARIABLE,
    launcher_from_environment,
    missing_program,
    most_servers,
    reap_servers,
    require_servers,
)
from naosim.launchers.guarded import GuardedProcess
from naosim.launchers.process import PortLease, ProcessLauncher
from naosim.launchers.server import Address, Launcher, LauncherUnavailableError, ServerHandle, ServerProgram
from naosim.launchers.sidecar import SidecarLauncher

__all__ = [
    "LABELS_VARIABLE",
    "Address",
    "ContainerSettings",
    "DockerLauncher",
    "GuardedProcess",
    "Launcher",
    "LauncherUnavailableError",
    "PortLease",
    "ProcessLauncher",
    "ServerHandle",
    "ServerProgram",
    "SidecarLauncher",
    "launcher_from_environment",
    "missing_program",
    "most_servers",
    "reap_servers",
    "require_servers",
]
