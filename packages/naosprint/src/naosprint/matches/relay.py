"""Pass connections on to an address.

A file of its own that needs nothing but the standard library: `python -I -S relay.py TARGET LISTEN`, or `-c` with its
text in a container. An address is `unix:PATH` or `tcp:HOST:PORT`; port 0 is a free one. Prints `listening` and the port
of TCP.

With `TARGET LISTEN TEAM NUMBER LISTEN TEAM NUMBER ...` each address is the endpoint of one player to a rcssservermj: it
passes exactly one connection, whose first message enters the field as this player. Each line then begins with the
player: `left 1 listening 40123`, `left 1 refused '(init T1 right 1)'` (the first time), `left 1 entered`.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
import sys
import threading

_MOST_CONNECTIONS = 64
_CHUNK_BYTES = 1 << 16
_MOST_INIT_BYTES = 200


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


def _pump(source: socket.socket, sink: socket.socket) -> None:
    """Copy until one of them is closed, and close both."""
    with contextlib.suppress(OSError):
        while data := source.recv(_CHUNK_BYTES):
            sink.sendall(data)
    for each in (source, sink):
        with contextlib.suppress(OSError):
            each.shutdown(socket.SHUT_RDWR)


def _pass(client: socket.socket, target: str, first: bytes = b"") -> None:
    """Pass a connection on, after the bytes ``first``, until one of its sides is closed."""
    with contextlib.suppress(OSError), client:
        server, address = _opened(target)
        with server:
            server.connect(address)
            for each in (client, server):
                if each.family == socket.AF_INET:
                    each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            server.sendall(first)
            back = threading.Thread(target=_pump, args=(server, client), daemon=True)
            back.start()
            _pump(client, server)
            back.join()


def _read(client: socket.socket, count: int) -> bytes:
    """Return so many bytes, fewer if the connection ends."""
    data = b""
    with contextlib.suppress(OSError):
        while len(data) < count and (part := client.recv(count - len(data))):
            data += part
    return data


def _endpoint(listener: socket.socket, target: str, team: str, number: str) -> None:
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
            message = f"(init {found[1]} {player})".encode()  # as the server reads it, in one way only
            _pass(client, target, len(message).to_bytes(4, "big") + message)
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
        listeners = [(_listening(each, f"{team} {number}"), target, team, number) for each, team, number in endpoints]
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
