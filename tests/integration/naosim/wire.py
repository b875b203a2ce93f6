"""A server in a thread and minimal clients."""

from __future__ import annotations

import asyncio
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, ClassVar

from naosim.simspark import protocol
from naosim.simspark.server import Server, ServerSettings

TIMEOUT_S = 20.0


class Wire:
    """Talk to one port."""

    wires: ClassVar[list[Wire]] = []
    """All open connections; the fixtures close them."""

    def __init__(self, port: int, host: str = "127.0.0.1") -> None:
        self.socket = socket.create_connection((host, port), timeout=TIMEOUT_S)
        self.wires.append(self)

    def send(self, text: str | bytes) -> None:
        payload = text.encode() if isinstance(text, str) else text
        self.socket.sendall(protocol.frame(payload))

    def receive(self) -> str:
        size = int.from_bytes(self._exactly(4), "big")
        return self._exactly(size).decode()

    def ask(self, text: str | bytes) -> str:
        self.send(text)
        return self.receive()

    def closed(self) -> bool:
        """Wait for the server to hang up; what it still sends is dropped."""
        try:
            while self.socket.recv(65536):
                pass
        except ConnectionResetError:
            return True
        except TimeoutError:
            return False
        return True

    def close(self) -> None:
        self.socket.close()

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            part = self.socket.recv(size - len(data))
            if not part:
                raise ConnectionError("closed by the server")
            data += part
        return data


class Player(Wire):
    """Enter the field like an agent of the league."""

    def __init__(self, port: int, team: str = "A", number: int = 0, robot_type: int = 0) -> None:
        super().__init__(port)
        self.ask(f"(scene rsg/agent/nao/nao_hetero.rsg {robot_type})")
        self.ask(f"(init (unum {number})(teamname {team}))")
        self.greeting = [self.ask("(syn)") for _ in range(3)]

    def step(self, commands: str = "") -> str:
        return self.ask(commands + "(syn)")


def senses(message: str) -> dict[str, list[str]]:
    """Return a message's expressions by their tag; HJ and FRP by their part's name."""
    found: dict[str, list[str]] = {}
    depth = start = 0
    for at, character in enumerate(message):
        if character == "(":
            start = at if depth == 0 else start
            depth += 1
        elif character == ")":
            depth -= 1
            if depth == 0:
                tag, _, rest = message[start + 1 : at].partition(" ")
                name = re.match(r"\(n (\w+)\)", rest)
                found.setdefault(f"{tag} {name[1]}" if name else tag, []).append(rest)
    return found


@contextmanager
def serving(**settings: Any) -> Iterator[Server]:
    """Run a server in a thread until the end of the block."""
    server = Server(ServerSettings(agent_port=0, monitor_port=0, **settings))
    ready = threading.Event()
    loops: list[asyncio.AbstractEventLoop] = []

    async def main() -> None:
        loops.append(asyncio.get_running_loop())
        await server.run(lambda _: ready.set())

    thread = threading.Thread(target=lambda: asyncio.run(main()))
    thread.start()
    try:
        assert ready.wait(TIMEOUT_S)
        yield server
    finally:
        with suppress(RuntimeError):  # its loop is closed: the server has stopped by itself, killed by a trainer
            loops[0].call_soon_threadsafe(server.stop, "the test ends")
        thread.join(TIMEOUT_S)
        assert not thread.is_alive()
