"""Parser of command lines, shared by the programs that use argparse."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


class ArgumentParser(argparse.ArgumentParser):
    """Parser that refuses an empty argument, which a variable that is not set leaves, unless the type is ``str``.

    As a path it would be the current folder.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.register("type", None, _given)
        self.register("type", Path, lambda text: Path(_given(text)))

    def add_subparsers(self, **options: Any) -> Any:
        """Add commands; their parsers check their arguments."""
        commands = super().add_subparsers(**options)
        commands.type = str
        return commands


def _given(text: str) -> str:
    if not text:
        raise argparse.ArgumentTypeError("is empty")
    return text
