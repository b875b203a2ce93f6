"""Passwords of a stack's database and broker, in a file that only its owner can read."""

from __future__ import annotations

import json
import secrets
from dataclasses import asdict, dataclass

from naospec.files import write_whole

from naoctl.config import PRIVATE
from naoctl.errors import StackError
from naoctl.stack.layout import Layout
from naoctl.stack.postgres import is_cluster


@dataclass(frozen=True)
class Secrets:
    """Passwords: hexadecimal digits, which need no quoting."""

    postgres: str
    broker: str


def read_secrets(layout: Layout) -> Secrets:
    """Return the passwords; create them before the database is made.

    Raises:
        StackError: when the file is damaged or lost; the database cannot be opened without it.
    """
    try:
        return Secrets(**json.loads(layout.secrets.read_text(encoding="utf-8")))
    except FileNotFoundError:
        if is_cluster(layout.postgres):
            raise StackError(
                f"{layout.secrets} is missing: it has the password of the database in {layout.postgres}",
                fix="Restore it from a copy of the data folder.",
            ) from None
        made = Secrets(secrets.token_hex(24), secrets.token_hex(24))
        write_whole(layout.secrets, json.dumps(asdict(made)) + "\n", mode=PRIVATE)
        return made
    except (OSError, ValueError, TypeError) as error:
        raise StackError(f"{layout.secrets} is damaged ({error})", fix="Restore it from a backup.") from None
