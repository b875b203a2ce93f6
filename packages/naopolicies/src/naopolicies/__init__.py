"""Sprint policies in the box: weights, cards and a run of each to look at; data alone, nothing to import with it.

Each policy is a folder under ``shipped``:

    checkpoint.json, policy.npz     a checkpoint without what only its training would need
    card.json                       what it is, how it came about, how good it is
    replay.json                     one episode as it looked
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

CARD = "card.json"
CHECKPOINT = "checkpoint.json"
REPLAY = "replay.json"

_SHIPPED = Path(__file__).parent / "shipped"


def names() -> tuple[str, ...]:
    """Return the names of all shipped policies."""
    return tuple(sorted(card.parent.name for card in _SHIPPED.glob(f"*/{CARD}")))


def folder(name: str) -> Path:
    """Return the folder of the policy called ``name``.

    Raises:
        ValueError: if there is none; the message lists those that exist.
    """
    if name not in names():
        raise ValueError(f"unknown policy {name!r}: choose one of {', '.join(names())}")
    return _SHIPPED / name


def card(name: str) -> dict[str, Any]:
    """Return the card of the policy called ``name``.

    Raises:
        ValueError: if there is none; the message lists those that exist.
    """
    found: dict[str, Any] = json.loads((folder(name) / CARD).read_bytes())
    return found


def spec(name: str) -> dict[str, Any]:
    """Return the specification of the last training of the policy called ``name``: the fields of a ``TrainingSpec``.

    Raises:
        ValueError: if there is no such policy; the message lists those that exist.
    """
    found: dict[str, Any] = json.loads((folder(name) / CHECKPOINT).read_bytes())["spec"]
    return found


def resolve(text: str) -> Path:
    """Return the folder that a user means: a checkpoint's path, or the name of a shipped policy.

    Raises:
        ValueError: if it is neither.
    """
    path = Path(text)
    if path.exists():
        return path
    if text in names():
        return folder(text)
    raise ValueError(
        f"{text!r} is neither a checkpoint's folder nor a shipped policy; those are: {', '.join(names()) or 'none'}"
    )
