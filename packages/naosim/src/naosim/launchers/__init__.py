"""Launchers of servers as processes or containers: start, watch, stop and remove them."""

from __future__ import annotations

from naosim.launchers.docker import ContainerSettings, DockerLauncher, Reaper
from naosim.launchers.environment import (
    LABELS_VARIABLE,
    NETWORK_VARIABLE,
    launcher_from_environment,
    missing_program,
    most_servers,
    reap_servers,
    require_servers,
)
from naosim.launchers.process import PortLease, ProcessLauncher
from naosim.launchers.server import Address, Launcher, LauncherUnavailableError, ServerHandle, ServerProgram

__all__ = [
    "LABELS_VARIABLE",
    "NETWORK_VARIABLE",
    "Address",
    "ContainerSettings",
    "DockerLauncher",
    "Launcher",
    "LauncherUnavailableError",
    "PortLease",
    "ProcessLauncher",
    "Reaper",
    "ServerHandle",
    "ServerProgram",
    "launcher_from_environment",
    "missing_program",
    "most_servers",
    "reap_servers",
    "require_servers",
]
