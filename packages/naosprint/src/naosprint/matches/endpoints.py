"""Endpoints of a game: each agent connects to the server through one of its own, which accepts its player only."""

from __future__ import annotations

import os
import sys
from typing import IO, TYPE_CHECKING

from naosim.launchers import Address, GuardedProcess

from naosprint.matches import relay

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from naosprint.matches.stream import Player

SOCKET = "server"
"""Name of an endpoint that is a Unix socket, in a folder of its own."""
_HOST = "127.0.0.1"


class AgentEndpoints:
    """The endpoints of all players of a half, in one process.

    Args:
        server: address of the server.
        players: of each player by the server's names whether its endpoint is a Unix socket, for a container, instead of
            a port.

    Raises:
        OSError: if they do not open.
    """

    def __init__(self, server: Address, players: Mapping[Player, bool]) -> None:
        self._process = GuardedProcess("naosprint-relay-")
        self._ports: dict[Player, int] = {}
        self._entered: set[Player] = set()
        self._refused: dict[Player, str] = {}
        self._rest = b""
        try:
            self._output = self._open(server, players)
        except BaseException:
            self.close()
            raise

    def _open(self, server: Address, players: Mapping[Player, bool]) -> IO[bytes]:
        """Start the relay; return its output, behind the line of each endpoint."""
        words: list[str] = []
        for (team, number), is_socket in players.items():
            listen = f"tcp:{_HOST}:0"
            if is_socket:
                folder = self.folder((team, number))
                folder.mkdir()
                folder.chmod(0o711)  # the relays' user opens what it has the name of
                listen = f"unix:{folder / SOCKET}"
            words += [listen, team, str(number)]
        target = f"{server.host}:{server.agent_port}"
        self._process.start([sys.executable, "-I", "-S", relay.__file__, f"tcp:{target}", *words], piped=True)
        output = self._process.process.stdout
        assert output is not None
        for player in players:
            line = output.readline().split()
            if not line:
                raise OSError(f"the relay to {target} does not start: {self._process.describe()}")
            if not players[player]:
                self._ports[player] = int(line[-1])
        os.set_blocking(output.fileno(), False)
        return output

    def address(self, player: Player) -> Address:
        """Return what is the server to an agent; it has no monitor port."""
        return Address(_HOST, self._ports[player], 0)

    def folder(self, player: Player) -> Path:
        """Return the folder with the Unix socket `SOCKET` of a player."""
        return self._process.folder / f"{player[0]}-{player[1]}"

    def entered(self) -> set[Player]:
        """Return the players whose agents have asked the server to enter the field."""
        self._read()
        return self._entered

    def refused(self, player: Player) -> str:
        """Return what an agent began with in place of its own entry, for people; empty without."""
        self._read()
        if player in self._entered or player not in self._refused:
            return ""
        return f"; it began with {self._refused[player]}, not with (init MODEL {player[0]} {player[1]})"

    def failure(self) -> str:
        """Return how their process failed; empty if it runs, or ended after all of its connections had."""
        failed = self._process.process.poll() not in (None, 0)
        return f"the relay of the agents ended: {self._process.describe()}" if failed else ""

    def _read(self) -> None:
        while data := self._output.read(1 << 16):
            *lines, self._rest = (self._rest + data).split(b"\n")
            for line in lines:
                team, number, what, *words = line.decode("ascii").split(" ", 3)
                if what == "entered":
                    self._entered.add((team, int(number)))
                else:
                    self._refused[team, int(number)] = " ".join(words)

    def close(self) -> None:
        """Close them, after each of the agents has been stopped."""
        self._process.stop()
