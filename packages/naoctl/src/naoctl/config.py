"""Service and token of the command line: from flags, else the environment, else a configuration file.

The file (``config.toml`` in the user's configuration folder, mode 0600) holds one token per service address and which
address is the current one. ``naoctl login`` and ``naoctl up`` write it.
"""

from __future__ import annotations

import json
import os
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path

import httpx
import platformdirs
from naospec.files import write_whole

from naoctl.errors import InvalidInput

DEFAULT_URL = "http://127.0.0.1:8000"
PRIVATE = 0o600
"""Permissions of files with secrets: the owner only."""


def normal_url(url: str) -> str:
    """Return the normal form of a service's address: scheme, host, port and path, without a trailing slash.

    Raises:
        InvalidInput: if it is not an http or https address, or contains a user name or password.
    """
    try:
        parsed = httpx.URL(url.strip())
    except httpx.InvalidURL as error:
        raise InvalidInput(f"{url!r} is not an address: {error}", fix=f"Write it as {DEFAULT_URL}.") from None
    if parsed.scheme not in ("http", "https") or not parsed.host:
        raise InvalidInput(f"{url!r} is not an http address", fix=f"Write it as {DEFAULT_URL}.")
    if parsed.userinfo:
        raise InvalidInput("An address must not contain a password", fix="Sign in with `naoctl login`.")
    return str(parsed.copy_with(query=None, fragment=None)).rstrip("/")


def config_path() -> Path:
    """Return the configuration file: ``NAOCTL_CONFIG`` or ``config.toml`` in the user's configuration folder."""
    named = os.environ.get("NAOCTL_CONFIG")
    if named:
        return Path(named).expanduser()
    return platformdirs.user_config_path("naosprint", appauthor=False) / "config.toml"


@dataclass(frozen=True)
class Config:
    """Tokens by service address, the address that commands use by default, and the one that they used before."""

    current: str | None = None
    previous: str | None = None
    tokens: dict[str, str] = field(default_factory=dict)

    @classmethod
    def load(cls, path: Path | None = None) -> Config:
        """Read the file; a missing file is an empty configuration.

        Raises:
            InvalidInput: if the file cannot be read or is not in the format of ``save``.
        """
        path = path or config_path()
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return cls()
        except (OSError, UnicodeDecodeError) as error:
            raise InvalidInput(f"Cannot read {path}: {error}", fix="Repair or remove the file.") from None
        try:
            data = tomllib.loads(text)
            current, previous = data.get("current"), data.get("previous")
            servers = data.get("servers", {})
            if not isinstance(current, str | None) or not isinstance(previous, str | None):
                raise ValueError("`current` and `previous` are strings")
            if not isinstance(servers, dict):
                raise ValueError("`servers` is a table")
            tokens = {normal_url(url): entry["token"] for url, entry in servers.items()}
            if not all(isinstance(token, str) for token in tokens.values()):
                raise ValueError("every server has a `token`, a string")
        except (tomllib.TOMLDecodeError, ValueError, KeyError, TypeError) as error:
            raise InvalidInput(
                f"{path} is damaged ({error})", fix="Remove it and sign in again with `naoctl login`."
            ) from None
        current, previous = (normal_url(url) if url else None for url in (current, previous))
        return cls(current=current, previous=previous, tokens=tokens)

    def save(self, path: Path | None = None) -> Path:
        """Write the file atomically, readable by its owner only, and return its path."""
        path = path or config_path()
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = []
        if self.current:
            lines.append(f"current = {_quoted(self.current)}\n")
        if self.previous:
            lines.append(f"previous = {_quoted(self.previous)}\n")
        lines += [
            f"\n[servers.{_quoted(url)}]\ntoken = {_quoted(token)}\n" for url, token in sorted(self.tokens.items())
        ]
        write_whole(path, "".join(lines), mode=PRIVATE)
        return path

    def with_token(self, url: str, token: str, *, current: bool = True) -> Config:
        """Return a copy with this token, and with its service as the current one if requested."""
        url = normal_url(url)
        tokens = {**self.tokens, url: token}
        if not current:
            return replace(self, tokens=tokens)
        return replace(
            self, current=url, previous=self.previous if self.current == url else self.current, tokens=tokens
        )

    def stopped(self, url: str) -> Config:
        """Return a copy in which a service that was stopped is not the current one, if another was before it."""
        if self.current != normal_url(url) or self.previous not in self.tokens:
            return self
        return replace(self, current=self.previous, previous=None)

    def without(self, url: str) -> Config:
        """Return a copy without this service."""
        url = normal_url(url)
        tokens = {known: token for known, token in self.tokens.items() if known != url}
        previous = None if url in (self.current, self.previous) else self.previous
        return replace(self, current=None if self.current == url else self.current, previous=previous, tokens=tokens)


@dataclass(frozen=True)
class Target:
    """Service of a command, and the token for it."""

    url: str
    token: str | None


def resolve_target(url: str | None = None, token: str | None = None, config: Config | None = None) -> Target:
    """Return service and token, from the first that has them: flag, ``NAOCTL_URL`` / ``NAOCTL_TOKEN``, file, defaults.

    A token from the file is only sent to its own service.
    """
    config = config if config is not None else Config.load()
    chosen = normal_url(url or os.environ.get("NAOCTL_URL") or config.current or DEFAULT_URL)
    token = token or os.environ.get("NAOCTL_TOKEN") or config.tokens.get(chosen)
    return Target(url=chosen, token=token)


def _quoted(text: str) -> str:
    # A TOML basic string escapes what a JSON string escapes, and DEL besides.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
