"""Patterns of text in requests, and their descriptions: errors show no regular expressions."""

from __future__ import annotations

from naojobs.ids import PATTERN
from naojobs.promotion import SETTING
from naospec.sections import PLAIN_NAME

ID = PATTERN
"""The identifier of anything."""
TAG = r"^[A-Za-z0-9][A-Za-z0-9._:/=-]{0,49}$"
"""A tag of a job."""
_INVISIBLE = (
    r"\x00-\x1f\x7f-\x9f\xad\u0600-\u0605\u061c\u06dd\u070f\u0890-\u0891\u08e2\u180e\u200b-\u200f\u2028-\u202e"
    r"\u2060-\u2064\u2066-\u206f\ufeff\ufff9-\ufffb"
)
"""Characters that no terminal and no list should get raw: controls, formats such as directions of text, line separators
(categories Cc, Cf, Zl and Zp of Unicode's basic plane). `naojobs.submission.free_name` checks names of all planes.
"""
NAME = PLAIN = rf"^[^{_INVISIBLE}]*$"
"""The name of a job, and other text of one line."""
TEXT = r"^[^\x00-\x08\x0b\x0c\x0e-\x1f\x7f]*$"
"""Text of several lines."""
KEY = r"^[\x21-\x7e]{1,150}$"
"""An idempotency key."""
POLICY = r"^[a-z0-9-]{1,60}$"
"""The name of a policy."""
REFERENCE = r"^[a-z0-9-]{1,60}(@[a-z0-9-]{1,60})?$"
"""A policy by name, or one of its versions by number or alias."""
ALIAS = r"^[a-z][a-z0-9-]{0,59}$"
"""The alias of a version."""
STEP = r"^[0-9]{1,18}-[0-9]{1,9}$"
"""The place of a checkpoint among those of its job: step and attempt."""
PLACE = rf"{POLICY}|{PATTERN}"
"""The place of a policy in the list of policies: the name of a bundled one, the id of a registered one."""
RESULT = SETTING
"""The name of a result, or of a setting of a task."""
TICKET = r"^[a-z0-9_]{1,80}\.[0-9]{1,12}\.[0-9a-f]{64}$"
"""What lets a browser open a report: token, time of expiry, signature."""

WORDS = {
    ID: "expected a full id, such as job_01jd8z6vq9k3m5t7x2c4b6n8pr",
    TAG: "expected a letter or digit, then letters, digits and ._:/=- (at most 50 characters)",
    PLAIN: "expected text without control, format and separator characters",
    TEXT: "expected text without control characters",
    STEP: "expected `next_cursor` of the previous page",
    PLACE: "expected `next_cursor` of the previous page",
    KEY: "expected 1 to 150 ASCII characters without spaces",
    TICKET: "expected the address of a report as the service returned it",
    PLAIN_NAME: "expected a letter, digit or _, then letters, digits and _.- (at most 64 characters)",
    POLICY: "expected a name of lower-case letters, digits and hyphens (at most 60 characters)",
    REFERENCE: "expected NAME, NAME@VERSION or NAME@ALIAS of lower-case letters, digits and hyphens",
    RESULT: "expected a lower-case letter, then lower-case letters, digits and _ (at most 60 characters)",
    ALIAS: "expected a lower-case letter, then lower-case letters, digits and hyphens (at most 60 characters)",
}


def words(pattern: str) -> str:
    """Return what a pattern allows."""
    return WORDS.get(pattern, "has characters that are not allowed")
