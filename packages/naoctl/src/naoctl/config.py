"""Where the command line finds its service and its token: flags, then environment, then one small file.

The file (``config.toml`` in the user's configuration folder, mode 0600) holds one token per service address and which
address is the current one. ``naoctl login`` and ``naoctl up`` write it.
"""

from __future__ import annotations

import json
import os
import tempfile
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path

import httpx
import platformdirs

from naoctl.errors import InvalidInput

DEFAULT_URL = "http://127.0.0.1:8000"


def normal_url(url: str) -> str:
    """Return the address in the one form that names a service: scheme, host, port and path, without a closing slash.

    Raises:
        InvalidInput: when it is no http or https address, or carries a user name or password.
    """
    try:
        parsed = httpx.URL(url.strip())
    except httpx.InvalidURL as error:
        raise InvalidInput(f"{url!r} is no address: {error}", fix=f"Write it as {DEFAULT_URL}.") from None
    if parsed.scheme not in ("http", "https") or not parsed.host:
        raise InvalidInput(f"{url!r} is no http address", fix=f"Write it as {DEFAULT_URL}.")
    if parsed.userinfo:
        raise InvalidInput("An address must not carry a password", fix="Sign in with `naoctl login`.")
    return str(parsed.copy_with(query=None, fragment=None)).rstrip("/")


def config_path() -> Path:
    """Return the configuration file: ``NAOCTL_CONFIG`` or ``config.toml`` in the user's configuration folder."""
    named = os.environ.get("NAOCTL_CONFIG")
    if named:
        return Path(named).expanduser()
    return platformdirs.user_config_path("naosprint", appauthor=False) / "config.toml"


@dataclass(frozen=True)
class Config:
    """Hold the tokens by service address and the address that commands use when none is named."""

    current: str | None = None
    tokens: dict[str, str] = field(default_factory=dict)

    @classmethod
    def load(cls, path: Path | None = None) -> Config:
        """Read the file; a file that is not there is an empty configuration.

        Raises:
            InvalidInput: when the file cannot be read or is not what ``save`` writes.
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
            current = data.get("current")
            servers = data.get("servers", {})
            if not isinstance(current, str | None) or not isinstance(servers, dict):
                raise ValueError("`current` is a string and `servers` a table")
            tokens = {normal_url(url): entry["token"] for url, entry in servers.items()}
            if not all(isinstance(token, str) for token in tokens.values()):
                raise ValueError("every server has a `token`, a string")
        except (tomllib.TOMLDecodeError, ValueError, KeyError, TypeError) as error:
            raise InvalidInput(
                f"{path} is damaged ({error})", fix="Remove it and sign in again with `naoctl login`."
            ) from None
        return cls(current=normal_url(current) if current else None, tokens=tokens)

    def save(self, path: Path | None = None) -> Path:
        """Write the file whole or not at all, readable by its owner only, and return its path."""
        path = path or config_path()
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = []
        if self.current:
            lines.append(f"current = {_quoted(self.current)}\n")
        lines += [
            f"\n[servers.{_quoted(url)}]\ntoken = {_quoted(token)}\n" for url, token in sorted(self.tokens.items())
        ]
        write_private(path, "".join(lines))
        return path

    def with_token(self, url: str, token: str, *, current: bool = True) -> Config:
        """Return a copy that knows this token and, if asked, uses its service from now on."""
        url = normal_url(url)
        return replace(self, current=url if current else self.current, tokens={**self.tokens, url: token})

    def without(self, url: str) -> Config:
        """Return a copy that has forgotten this service."""
        url = normal_url(url)
        tokens = {known: token for known, token in self.tokens.items() if known != url}
        return replace(self, current=None if self.current == url else self.current, tokens=tokens)


@dataclass(frozen=True)
class Target:
    """Name the service a command talks to and the token it shows there."""

    url: str
    token: str | None


def resolve_target(url: str | None = None, token: str | None = None, config: Config | None = None) -> Target:
    """Choose service and token: the flag, else ``NAOCTL_URL`` / ``NAOCTL_TOKEN``, else the file, else this machine.

    A token from the file is only ever shown to the service it was given by.
    """
    config = config if config is not None else Config.load()
    chosen = normal_url(url or os.environ.get("NAOCTL_URL") or config.current or DEFAULT_URL)
    token = token or os.environ.get("NAOCTL_TOKEN") or config.tokens.get(chosen)
    return Target(url=chosen, token=token)


def write_private(path: Path, text: str) -> None:
    """Replace a file's text atomically; the file is readable and writable by its owner only (0600) from the start."""
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def _quoted(text: str) -> str:
    # A TOML basic string escapes what a JSON string escapes, and DEL besides.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
