"""What command lines share: numbers within bounds, and one line where what was asked for cannot be done."""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
from typing import TYPE_CHECKING, NoReturn

from naosim.simulator import ServerLostError
from naospec import plugins

from naosprint.matches.game import MatchError

if TYPE_CHECKING:
    from collections.abc import Callable

EXPECTED_ERRORS = (
    *(OSError, ValueError, subprocess.SubprocessError),
    *(MatchError, ServerLostError, plugins.BrokenPluginError),
)
"""Errors whose message says what cannot be done; any other is a mistake in the program and keeps its traceback."""


def integer(least: int = 1, most: int = 10**9) -> Callable[[str], int]:
    """Return a type of arguments for `argparse`: whole numbers from ``least`` to ``most``."""

    def read(text: str) -> int:
        if not text.isdecimal() or not least <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text!r}: expected a number of {least:,} to {most:,}")
        return int(text)

    return read


def above_zero(text: str, most: float = math.inf) -> float:
    """Return a number above 0, at most ``most``. Raises argparse.ArgumentTypeError."""
    try:
        found = float(text)
    except ValueError:
        found = math.nan
    if not 0.0 < found <= min(most, sys.float_info.max):
        bound = f" and at most {most:,}" if most < math.inf else ""
        raise argparse.ArgumentTypeError(f"{text!r}: expected more than 0{bound}")
    return found


def error_text(error: BaseException) -> str:
    """Return what cannot be done; of a file or folder its path and why, without the system's number.

    An error that came through a plug-in of another package is followed by its line there.
    """
    if isinstance(error, FileExistsError) and error.filename is not None:
        return f"{error.filename}: is a file, not a folder"
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    place = plugins.place_of(error)
    return f"{error} ({place})" if place else str(error)


def run_program(main: Callable[[], int | None]) -> NoReturn:
    """Run a program and exit with its status, or with 1 and one line if it cannot do what was asked for."""
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
    except EXPECTED_ERRORS as error:
        sys.exit(f"error: {error_text(error)}")
