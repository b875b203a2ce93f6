"""Identifiers that sort by time of creation."""

from __future__ import annotations

import secrets
import time

_ALPHABET = "0123456789abcdefghjkmnpqrstvwxyz"  # Crockford's base 32: no i, l, o, u

_started_ms = time.time_ns() // 1_000_000 - time.monotonic_ns() // 1_000_000
"""Time at which this host's monotonic clock was zero, in milliseconds since 1970."""

PATTERN = r"^[a-z]{2,8}_[0-9a-hjkmnp-tv-z]{26}$"
"""Pattern of an identifier, for path parameters."""


def set_clock(now_s: float) -> None:
    """Correct the time that new identifiers contain by the database's clock, in seconds since 1970.

    Less than a second is not corrected: the answer took some time, and identifiers would not sort any more.
    """
    global _started_ms
    started_ms = round(1_000 * now_s) - time.monotonic_ns() // 1_000_000
    if abs(started_ms - _started_ms) > 1_000:
        _started_ms = started_ms


def new_id(prefix: str) -> str:
    """Return `prefix_` and 26 base-32 digits: 48 bits of milliseconds, then 80 random bits."""
    value = (_started_ms + time.monotonic_ns() // 1_000_000 << 80) | secrets.randbits(80)
    digits = []
    for _ in range(26):
        value, digit = divmod(value, 32)
        digits.append(_ALPHABET[digit])
    return f"{prefix}_{''.join(reversed(digits))}"


def same_id(prefix: str, identifier: str) -> str:
    """Return the identifier with the digits of another kind's `identifier`, for an object that it has once."""
    return f"{prefix}_{identifier.split('_', 1)[1]}"
