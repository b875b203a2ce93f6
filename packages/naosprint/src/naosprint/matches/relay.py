"""Pass connections on from one address to another.

A file of its own that needs nothing but the standard library: `python -I -S relay.py LISTEN TARGET`, or `-c` with its
text in a container. An address is `unix:PATH` or `tcp:HOST:PORT`. Prints a line when it listens.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import threading

_MOST_CONNECTIONS = 64
_CHUNK_BYTES = 1 << 16


def _opened(address: str) -> tuple[socket.socket, str | tuple[str, int]]:
    kind, _, rest = address.partition(":")
    if kind == "unix":
        return socket.socket(socket.AF_UNIX), rest
    host, _, port = rest.rpartition(":")
    return socket.socket(), (host, int(port))


def _pump(source: socket.socket, sink: socket.socket) -> None:
    """Copy until one of them is closed, and close both."""
    with contextlib.suppress(OSError):
        while data := source.recv(_CHUNK_BYTES):
            sink.sendall(data)
    for each in (source, sink):
        with contextlib.suppress(OSError):
            each.shutdown(socket.SHUT_RDWR)


def _serve(client: socket.socket, target: str, places: threading.Semaphore) -> None:
    with contextlib.suppress(OSError), client:
        server, address = _opened(target)
        with server:
            server.connect(address)
            for each in (client, server):
                if each.family == socket.AF_INET:
                    each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            back = threading.Thread(target=_pump, args=(server, client), daemon=True)
            back.start()
            _pump(client, server)
            back.join()
    places.release()


def main() -> None:
    """Listen and pass on."""
    listen, target = sys.argv[1:]
    listener, address = _opened(listen)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.bind(address)
    if isinstance(address, str):
        os.chmod(address, 0o666)  # noqa: S103 - for the relays' user; its folder has a name that cannot be guessed
    listener.listen()
    sys.stdout.write("listening\n")
    sys.stdout.flush()
    places = threading.Semaphore(_MOST_CONNECTIONS)
    while True:
        places.acquire()
        client, _ = listener.accept()
        threading.Thread(target=_serve, args=(client, target, places), daemon=True).start()


if __name__ == "__main__":
    main()
