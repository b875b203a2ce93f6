"""What all tests need of the process in which they run."""

from __future__ import annotations

import signal

import pytest


@pytest.fixture(autouse=True)
def default_signals() -> None:
    """Reset the handlers of SIGINT and SIGTERM, which a test before may have replaced.

    A shell starts programs in the background with SIGINT ignored, and so would every program be that a test interrupts.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
