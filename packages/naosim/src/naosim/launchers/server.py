"""Server programs, their addresses, and handles of started servers."""

from __future__ import annotations

import signal
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol


class LauncherUnavailableError(OSError):
    """Failure to reach the engine that starts servers; it may be temporary."""


@dataclass(frozen=True)
class Address:
    """Host and ports on which a server listens."""

    host: str
    agent_port: int
    monitor_port: int


@dataclass(frozen=True)
class ServerProgram:
    """Description of one kind of server for launchers.

    In arguments ``{agent_port}``, ``{monitor_port}`` and ``{home}``, the server's home directory, are replaced.

    Attributes:
        name: the program, looked up in the search path.
        arguments: what follows the program's name, in a process and in a container.
        process_arguments: what follows them in a process; an image holds such settings itself.
        files: files of a process's home directory, name to content.
        agent_port: port for agents in a container.
        monitor_port: port for monitors in a container.
        stop_signal: what ends a process; an image declares its own as STOPSIGNAL.
    """

    name: str
    arguments: tuple[str, ...]
    process_arguments: tuple[str, ...] = ()
    files: Mapping[str, str] = field(default_factory=dict)
    agent_port: int = 3100
    monitor_port: int = 3200
    stop_signal: signal.Signals = signal.SIGTERM

    def process_command(self, agent_port: int, monitor_port: int, home: str) -> list[str]:
        """Return the arguments of a process with these ports and this home directory."""
        values = {"agent_port": agent_port, "monitor_port": monitor_port, "home": home}
        return [text.format(**values) for text in (*self.arguments, *self.process_arguments)]

    def container_command(self) -> list[str]:
        """Return the arguments of a container."""
        return [
            text.format(agent_port=self.agent_port, monitor_port=self.monitor_port, home="") for text in self.arguments
        ]


class ServerHandle(Protocol):
    """Handle of a started server."""

    @property
    def address(self) -> Address:
        """Host and ports on which it listens."""

    def alive(self) -> bool:
        """Return whether it is running."""

    def owns(self, port: int) -> bool:
        """Return whether it is this server that listens on a port."""

    def describe(self) -> str:
        """Return its identity, how it ended and the end of its log.

        What a process printed before it first listened is left out once it does.
        """

    def stop(self) -> None:
        """Stop it and everything it started; release its ports."""


class Launcher(Protocol):
    """Interface that starts servers of one kind."""

    def start(self) -> ServerHandle:
        """Start a server; it may not listen yet.

        Raises:
            OSError: if it cannot be started.
        """
