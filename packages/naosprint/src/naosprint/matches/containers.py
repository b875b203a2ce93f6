"""Agents in containers that reach nothing but the server of their game.

A container of an agent has no network of its own: it is in that of a second container, its relay, which has no way out
but a Unix socket of this machine, the agent's endpoint. What the agent sends to its loopback goes through it to the
server.

    agent --TCP, loopback of the two--> relay --Unix socket--> endpoint on this machine --TCP--> server
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from naosim.launchers import ContainerSettings
from naosim.launchers.docker import (
    confined_options,
    connect,
    create_container,
    describe_server,
    engine_errors,
    new_name,
    owner_labels,
    remove_orphans,
    remove_server,
    server_runs,
)

from naosprint.matches import relay
from naosprint.matches.endpoints import SOCKET

if TYPE_CHECKING:
    from collections.abc import Mapping

    from naosprint.matches.agents import Limits
    from naosprint.matches.teams import Team

RELAY_VARIABLE = "NAOSPRINT_RELAY_IMAGE"
"""Image with Python 3 that the relays of agents in containers run from; without it such teams do not play."""
ENFORCED = ("CPU", "TCP", "UDP", "cpu", "files", "memory", "processes")
"""What the engine limits of an agent."""
_INSIDE, _PORT = "/run/naosprint", 3100
_START_S, _LOOK_S = 30.0, 0.5


class ContainerAgents:
    """The agents of one game that are containers.

    Raises:
        OSError: if no relay image is named, or no Docker engine answers.
    """

    def __init__(self) -> None:
        self._image = os.environ.get(RELAY_VARIABLE, "")
        if not self._image:
            raise OSError(
                f"{RELAY_VARIABLE}: not set, so that no team plays from a container image here; set it to an image "
                "with Python 3 that is on this machine, such as python:3.11-slim-bookworm"
            )
        self._client: Any = connect()
        self.api: Any = self._client.api
        remove_orphans(self.api)

    def start(self, team: Team, name: str, number: int, players: int, endpoint: Path, limits: Limits) -> AgentContainer:
        """Start an agent.

        Args:
            team: its team, which has an image.
            name: name with which it enters the game.
            number: its uniform number.
            players: number of players of its team.
            endpoint: folder with the socket that leads it to the server.
            limits: what it may use.

        Raises:
            OSError: if it cannot be started; the message names the image if it is missing.
        """
        assert team.image is not None
        agent = AgentContainer(self.api, number)
        try:
            self._create(agent.relay, self._image, RELAY_VARIABLE, relay_options(endpoint))
            self._await_relay(agent.relay)
            values = {"host": "127.0.0.1", "port": _PORT, "team": name, "number": number, "players": players}
            command = team.agent(**values)
            options = agent_options(agent.relay, limits)
            self._create(agent.name, team.image, "image", {**options, "command": command})
        except BaseException:
            agent.stop()
            raise
        return agent

    def _create(self, name: str, image: str, field: str, options: dict[str, Any]) -> None:
        """Create and start a container; raise OSError if there is no such image."""
        with engine_errors():
            if not self.api.images(image):
                raise OSError(
                    f"{field}: there is no image {image!r} on this machine; build it here, or 'docker pull {image}'"
                )
            create_container(self.api, name, image, options)

    def _await_relay(self, name: str) -> None:
        deadline, pause = time.monotonic() + _START_S, threading.Event()
        with engine_errors():
            while b"listening" not in self.api.logs(name):
                if time.monotonic() > deadline or not server_runs(self.api, name):
                    break
                pause.wait(0.05)
            else:
                return
        raise OSError(f"{RELAY_VARIABLE}: the relay does not start: {describe_server(self.api, name)}")

    def close(self) -> None:
        """Close the connection to the engine, after each of the agents has been stopped."""
        self._client.close()


def _settings(image: str, memory_mb: int) -> ContainerSettings:
    return ContainerSettings(image, labels=owner_labels(), memory=f"{memory_mb}m")


def relay_options(folder: Path) -> dict[str, Any]:
    """Return the options of a relay's container: no network but its own loopback, and a folder with the socket."""
    options = confined_options(_settings("relay", 64))
    text = Path(relay.__file__).read_text(encoding="utf-8")
    return {
        **options,
        "entrypoint": ["python3", "-I", "-S", "-c", text],
        "command": [f"unix:{_INSIDE}/{SOCKET}", f"tcp:127.0.0.1:{_PORT}"],
        "network_mode": "none",
        "binds": {str(folder): {"bind": _INSIDE, "mode": "ro"}},
    }


def agent_options(relay_name: str, limits: Limits) -> dict[str, Any]:
    """Return the options of an agent's container: the network of its relay, and its limits."""
    seconds = {"name": "cpu", "soft": limits.cpu_s, "hard": limits.cpu_s}
    options = confined_options(_settings("agent", limits.memory_mb))
    return {**options, "network_mode": f"container:{relay_name}", "ulimits": [seconds]}


class AgentContainer:
    """One agent of a team, in a container, with the container that is its relay.

    Args:
        api: a `docker.APIClient`.
        number: its uniform number.
    """

    def __init__(self, api: Any, number: int) -> None:
        self.number, self.cpu_s = number, 0.0
        self.name, self.relay = new_name(), new_name()
        self._api = api
        self._runs, self._looked_at = True, 0.0

    @property
    def enforced(self) -> list[str]:
        """Limits that the engine enforces."""
        return list(ENFORCED)

    def alive(self) -> bool:
        """Return whether it runs, or did half a second ago."""
        if self._runs and time.monotonic() - self._looked_at > _LOOK_S:
            self._runs = server_runs(self._api, self.name)
            self._looked_at = time.monotonic()
        return self._runs

    def describe(self) -> str:
        """Return how it ended and the end of what it printed."""
        return describe_server(self._api, self.name)

    def stop(self) -> None:
        """Remove both containers."""
        self._runs = False
        for name in (self.name, self.relay):
            remove_server(self._api, name, grace_s=0)

    def note_cpu(self, _used_s: Mapping[int, float]) -> None:
        """Note the processor time that it has used so far."""
        with contextlib.suppress(OSError, KeyError), engine_errors():
            used = self._api.stats(self.name, stream=False, one_shot=True)["cpu_stats"]["cpu_usage"]["total_usage"]
            self.cpu_s = max(self.cpu_s, used * 1e-9)
