"""Retries of calls that may fail, for a limited time."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


class PatienceExhaustedError(RuntimeError):
    """Service that kept failing for longer than the limit."""


def retry(
    call: Callable[[], T],
    *,
    what: str,
    transient: tuple[type[Exception], ...],
    patience_s: float,
    first_delay_s: float = 0.1,
    max_delay_s: float = 5.0,
    on_retry: Callable[[Exception, float], None] | None = None,
    stop: threading.Event | None = None,
) -> T:
    """Return ``call()``, repeating it with exponential, jittered back-off while it raises one of ``transient``.

    ``patience_s`` bounds the time from the first failure to the last try. ``on_retry`` is called with each error and
    the seconds until the next try. Setting ``stop`` ends the waiting at once.

    Raises:
        PatienceExhaustedError: the last try also failed; its cause is the last error, ``what`` names what was tried.
    """
    first_failure: float | None = None
    delay_s = first_delay_s
    while True:
        try:
            return call()
        except transient as error:
            now = time.monotonic()
            first_failure = now if first_failure is None else first_failure
            waited_s = now - first_failure
            stopped = stop is not None and stop.is_set()
            if stopped or waited_s >= patience_s:
                reason = "stopped" if stopped else f"gave up after {waited_s:.0f} s"
                raise PatienceExhaustedError(f"{what}: {reason}; last error: {describe(error)}") from error
            # Jitter keeps many workers from retrying at the same time.
            pause_s = min(delay_s * random.uniform(0.5, 1.0), patience_s - waited_s)  # noqa: S311
            if on_retry is not None:
                on_retry(error, pause_s)
            if stop is None:
                time.sleep(pause_s)
            else:
                stop.wait(pause_s)
            delay_s = min(delay_s * 2, max_delay_s)


def describe(error: BaseException, limit: int = 500) -> str:
    """Return the error's type and first lines on one line, truncated to ``limit`` characters."""
    text = " ".join(str(error).split())
    name = type(error).__name__
    return (f"{name}: {text}" if text else name)[:limit]
