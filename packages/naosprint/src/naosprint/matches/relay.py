"""Pass connections on to an address.

A file of its own that needs nothing but the standard library: `python -I -S relay.py TARGET LISTEN`, or `-c` with its
text in a container. An address is `unix:PATH` or `tcp:HOST:PORT`; port 0 is a free one. Prints `listening` and the port
of TCP.

With `TARGET LISTEN TEAM NUMBER LISTEN TEAM NUMBER ...` each address is the endpoint of one player to a rcssservermj: it
passes exactly one connection, whose first message enters the field as this player. Each line then begins with the
player: `left 1 listening 40123`, `left 1 refused '(init T1 right 1)'` (the first time), `left 1 entered`.

What the player sends then reaches the server in whole messages, each once it has been checked: rcssservermj trusts the
length of a message, and its simulation starts again, or ends, at numbers and effectors that it does not expect. At the
first message that fails the connection is closed, with the reason in the file `REFUSAL` of the working folder.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
import struct
import sys
import threading
import time
from collections.abc import Collection, Iterable, Iterator

MOST_MESSAGE_BYTES = 1 << 14
"""Most bytes of a message of an agent; one with targets of all joints of a T1 has less than 1000."""
MOST_NUMBER = 1e9
"""Largest number of an agent's message; MuJoCo resets all robots at positions from 1e10."""
MOST_AHEAD = 250
"""Most messages that an agent sends before their cycles, 5 s of play; the server keeps them in memory."""
MOST_WAIT_S = 1800.0
"""Most seconds that the game waits for the answers of a team in all: 0.12 s a cycle of a half of 300 s. The server
itself drops only agents that are silent for 5 s, and would play slower teams for longer than a half may take.
"""
REFUSAL = "{}-{}.refused"
"""File with the reason why the connection of a player, of a team and a number, was closed."""
_ARMS_AND_LEGS = {"he": 2, "lae": 4, "rae": 4, "lle": 6, "rle": 6}
_ANT = {f"l{leg}e": 2 for leg in range(1, 5)}
EFFECTORS = {
    model: frozenset(f"{part}{i + 1}".encode() for part, count in parts.items() for i in range(count))
    for model, parts in {"T1": {**_ARMS_AND_LEGS, "te": 1}, "K1": _ARMS_AND_LEGS, "ant": _ANT}.items()
}
"""Names of the joints' effectors, by the server's models of robots; models of other packages are not checked."""
_MOST_CONNECTIONS = 64
_CHUNK_BYTES = 1 << 16
_MOST_INIT_BYTES = 200
_UNREAD_S = 5
"""Seconds in which an agent reads what waits for it; the server, which allows 5 for an answer, waits meanwhile."""
_ACTION = re.compile(rb"\(([^()]*)")


def _opened(address: str) -> tuple[socket.socket, str | tuple[str, int]]:
    kind, _, rest = address.partition(":")
    if kind == "unix":
        return socket.socket(socket.AF_UNIX), rest
    host, _, port = rest.rpartition(":")
    return socket.socket(), (host, int(port))


def _listening(address: str, who: str = "") -> socket.socket:
    """Return a socket that listens on an address, and say so."""
    listener, place = _opened(address)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.bind(place)
    if isinstance(place, str):
        os.chmod(place, 0o666)  # noqa: S103 - for the relays' user; its folder has a name that cannot be guessed
    listener.listen()
    _say(who, "listening", "" if isinstance(place, str) else str(listener.getsockname()[1]))
    return listener


def _say(*words: str) -> None:
    sys.stdout.write(" ".join(filter(None, words)) + "\n")
    sys.stdout.flush()


def _chunks(source: socket.socket) -> Iterator[bytes]:
    """Yield what comes from a connection until it ends."""
    with contextlib.suppress(OSError):
        while data := source.recv(_CHUNK_BYTES):
            yield data


class RefusalError(Exception):
    """What an agent may not send; the message is the reason."""


def messages(chunks: Iterable[bytes], most_bytes: int = 1 << 32) -> Iterator[bytes]:
    """Yield the whole messages of a connection, without their lengths.

    Args:
        chunks: what comes from it, in pieces of any size.
        most_bytes: most bytes of a message.

    Raises:
        RefusalError: at the length of one that has more.
    """
    rest = bytearray()
    for data in chunks:
        rest += data
        while len(rest) >= 4:
            size = int.from_bytes(rest[:4], "big")
            if size > most_bytes:
                raise RefusalError(f"a message of {size} bytes; the most are {most_bytes}")
            if len(rest) < 4 + size:
                break
            yield bytes(rest[4 : 4 + size])
            del rest[: 4 + size]


def check(message: bytes, effectors: Collection[bytes]) -> None:
    """Check a message of an agent, whose words are what the server takes for words.

    Args:
        message: the message.
        effectors: names of the robot's joints; empty if they are not known.

    Raises:
        RefusalError: for a number that is not finite or too large, or a joint that the robot does not have.
    """
    for action in _ACTION.findall(message):
        name, *words = [word for word in action.split(b" ") if word] or [b""]
        if name == b"SPK":
            words = words[1:2]  # the volume; the text may be any
        elif name == b"syn" or len(words) not in ((3, 5) if name == b"beam" else (5,)):
            continue
        try:
            for number in map(float, words):
                if not -MOST_NUMBER <= number <= MOST_NUMBER:
                    raise RefusalError(f"numbers are finite and at most {MOST_NUMBER:g}, not in {_shown(action)}")
        except ValueError:
            continue  # the server ignores the action
        if effectors and len(words) == 5 and name not in effectors:
            raise RefusalError(f"the robot has no joint {_shown(name)}")


def _shown(text: bytes) -> str:
    return ascii(text[:_MOST_INIT_BYTES].decode(errors="replace"))


def _pump(chunks: Iterable[bytes], source: socket.socket, sink: socket.socket, player: _Player | None = None) -> None:
    """Send the chunks of the source to the sink until one of them is closed, and close both."""
    with contextlib.suppress(OSError):
        try:
            for data in chunks:
                sink.sendall(data)
        except BlockingIOError:
            if player is not None:
                player.refuse(f"it has not read for {_UNREAD_S} s what waits for it")
    for each in (source, sink):
        with contextlib.suppress(OSError):
            each.shutdown(socket.SHUT_RDWR)


def _pass(client: socket.socket, target: str, player: _Player | None = None) -> None:
    """Pass a connection on until one of its sides is closed, from a player only what it may send."""
    with contextlib.suppress(OSError), client:
        server, address = _opened(target)
        with server:
            server.connect(address)
            for each in (client, server):
                if each.family == socket.AF_INET:
                    each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            there, here = _chunks(client), _chunks(server)
            if player is not None:
                client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", _UNREAD_S, 0))
                there, here = player.sent(there), player.received(here)
            back = threading.Thread(target=_pump, args=(here, server, client, player), daemon=True)
            back.start()
            _pump(there, client, server)
            back.join()


class _Team:
    """What the game has waited for the agents of a team in all; waiting for several at a time counts once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._until_s = self._waited_s = 0.0

    def waited(self, since_s: float) -> float:
        """Add the time since an agent that answers now was asked; return the seconds in all."""
        with self._lock:
            now = time.monotonic()
            self._waited_s += now - max(since_s, self._until_s)
            self._until_s = now
            return self._waited_s


class _Player:
    """What passes between the agent of a player and the server, in messages with their lengths.

    Args:
        model: the robot's model.
        team: name of its team.
        number: its uniform number.
        waits: what the game has waited for its team.
    """

    def __init__(self, model: str, team: str, number: str, waits: _Team) -> None:
        self._init = f"(init {model} {team} {number})".encode()  # as the server reads it, in one way only
        self._effectors = EFFECTORS.get(model, frozenset())
        self._refusal = REFUSAL.format(team, number)
        self._sent = self._received = 0
        self._asked_s: float | None = None
        self._waits = waits

    def sent(self, chunks: Iterable[bytes]) -> Iterator[bytes]:
        """Yield its entry and what it may send of all that it sends; end at the first that it may not."""
        yield _framed(self._init)
        try:
            for message in messages(chunks, MOST_MESSAGE_BYTES):
                check(message, self._effectors)
                self._sent += 1
                if self._sent - self._received > MOST_AHEAD:
                    raise RefusalError(f"more than {MOST_AHEAD} messages before their cycles; send one a cycle")
                if self._asked_s is not None:
                    asked_s, self._asked_s = self._asked_s, None
                    if self._waits.waited(asked_s) > MOST_WAIT_S:
                        raise RefusalError(f"the game has waited {MOST_WAIT_S:g} s for its team; answer sooner")
                yield _framed(message)
        except RefusalError as error:
            self.refuse(str(error))

    def received(self, chunks: Iterable[bytes]) -> Iterator[bytes]:
        """Yield what it gets, one message a cycle."""
        for message in messages(chunks):
            self._received += 1
            self._asked_s = self._asked_s or time.monotonic()
            yield _framed(message)

    def refuse(self, reason: str) -> None:
        """Note why the connection is closed now."""
        with open(self._refusal, "w", encoding="ascii") as file:
            file.write(reason)


def _framed(message: bytes) -> bytes:
    return len(message).to_bytes(4, "big") + message


def _read(client: socket.socket, count: int) -> bytes:
    """Return so many bytes, fewer if the connection ends."""
    data = b""
    with contextlib.suppress(OSError):
        while len(data) < count and (part := client.recv(count - len(data))):
            data += part
    return data


def _endpoint(listener: socket.socket, target: str, team: str, number: str, waits: _Team) -> None:
    """Pass the one connection that enters the field as a player; close those before it, and say what the first was."""
    player, said = f"{team} {number}", False
    init = re.compile(rf"\s*\(\s*init\s+([\w-]+)\s+{re.escape(team)}\s+{number}\s*\)\s*", re.ASCII)
    while True:
        client, _ = listener.accept()
        size = int.from_bytes(_read(client, 4), "big")
        text = _read(client, min(size, _MOST_INIT_BYTES)).decode(errors="replace")
        if found := init.fullmatch(text):
            listener.close()
            _say(player, "entered")
            _pass(client, target, _Player(found[1], team, number, waits))
            return
        client.close()
        if not said:
            _say(player, "refused", ascii(text))
        said = True


def main() -> None:
    """Listen and pass on."""
    target, *addresses = sys.argv[1:]
    if len(addresses) > 1:
        endpoints = zip(addresses[0::3], addresses[1::3], addresses[2::3], strict=True)
        waits = {team: _Team() for team in addresses[1::3]}
        listeners = [
            (_listening(each, f"{team} {number}"), target, team, number, waits[team])
            for each, team, number in endpoints
        ]
        threads = [threading.Thread(target=_endpoint, args=each) for each in listeners]
        for thread in threads:
            thread.start()
        return
    listener, places = _listening(addresses[0]), threading.Semaphore(_MOST_CONNECTIONS)

    def serve(client: socket.socket) -> None:
        _pass(client, target)
        places.release()

    while True:
        places.acquire()
        client, _ = listener.accept()
        threading.Thread(target=serve, args=(client,), daemon=True).start()


if __name__ == "__main__":
    main()
