"""What all tests need of the process in which they run."""

from __future__ import annotations

import signal

# A shell starts programs in the background with SIGINT ignored, and so would every program be that a test interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
