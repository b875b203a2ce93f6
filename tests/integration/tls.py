"""TLS before the servers of the tests: the broker and Postgres of the wheels are built without it."""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_SSL_REQUEST = bytes([0, 0, 0, 8, 4, 210, 22, 47])
"""The first message of a client of Postgres that wants TLS: its length, and a code."""


@contextmanager
def tls_before(target: int | str, certificates: Path, *, postgres: bool = False) -> Iterator[int]:
    """Accept TLS on a loopback port and pass what comes to a port or a socket's path; yield the port.

    Args:
        target: where the server listens.
        certificates: folder with server.crt and server.key.
        postgres: answer the request for TLS first that Postgres's protocol begins with.
    """
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(certificates / "server.crt", certificates / "server.key")
    listener = socket.create_server(("127.0.0.1", 0))
    open_sockets: list[socket.socket] = [listener]
    threads: list[threading.Thread] = []

    def pump(source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                sink.sendall(data)
        for side in (source, sink):
            with contextlib.suppress(OSError):
                side.shutdown(socket.SHUT_RDWR)

    def serve(client: socket.socket) -> None:
        try:
            if postgres:
                assert client.recv(8, socket.MSG_WAITALL) == _SSL_REQUEST
                client.sendall(b"S")
            secure = context.wrap_socket(client, server_side=True)
        except OSError:  # the client has refused the certificate
            client.close()
            return
        family = socket.AF_UNIX if isinstance(target, str) else socket.AF_INET
        server = socket.socket(family)
        server.connect(target if isinstance(target, str) else ("127.0.0.1", target))
        open_sockets.extend((secure, server))
        back = threading.Thread(target=pump, args=(server, secure))
        back.start()
        pump(secure, server)
        back.join()

    def accept() -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = listener.accept()
                thread = threading.Thread(target=serve, args=(client,))
                threads.append(thread)
                thread.start()

    threads.append(threading.Thread(target=accept))
    threads[0].start()
    try:
        yield int(listener.getsockname()[1])
    finally:
        for opened in open_sockets:
            with contextlib.suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)
            opened.close()
        for thread in threads:
            thread.join(10)
        for opened in open_sockets:
            opened.close()
