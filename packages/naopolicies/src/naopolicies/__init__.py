"""Bundled policies: weights, cards and a recorded episode of each. Data only; importing it loads nothing else.

Each policy is a folder under ``bundled``:

- ``checkpoint.json``, ``policy.npz``: a checkpoint without what only its training would need.
- ``card.json``: what it is, how it was trained, and the results of its evaluation.
- ``replay.json``: one recorded episode.
- ``earlier``, of some: a whole checkpoint shortly before, from which the last segment of the training can be repeated.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

CARD = "card.json"
CHECKPOINT = "checkpoint.json"
REPLAY = "replay.json"
WEIGHTS = "policy.npz"
EARLIER = "earlier"

_BUNDLED = Path(__file__).parent / "bundled"


def names() -> tuple[str, ...]:
    """Return the names of all bundled policies."""
    return tuple(sorted(card.parent.name for card in _BUNDLED.glob(f"*/{CARD}")))


def folder(name: str) -> Path:
    """Return the folder of the policy called ``name``.

    Raises:
        ValueError: if there is none; the message lists those that exist.
    """
    if name not in names():
        raise ValueError(f"unknown policy {name!r}: choose one of {', '.join(names())}")
    return _BUNDLED / name


def card(name: str) -> dict[str, Any]:
    """Return the card of the policy called ``name``.

    Raises:
        ValueError: if there is none; the message lists those that exist.
    """
    found: dict[str, Any] = json.loads((folder(name) / CARD).read_bytes())
    return found


def spec(name: str) -> dict[str, Any]:
    """Return the specification of the last training of the policy called ``name``: the sections of a ``TrainingSpec``.

    Raises:
        ValueError: if there is no such policy; the message lists those that exist.
    """
    found: dict[str, Any] = checkpoint(name)["spec"]
    return found


def checkpoint(name: str) -> dict[str, Any]:
    """Return the manifest of the checkpoint of the policy called ``name``.

    Raises:
        ValueError: if there is no such policy; the message lists those that exist.
    """
    found: dict[str, Any] = json.loads((folder(name) / CHECKPOINT).read_bytes())
    return found


def resolve(text: str) -> Path:
    """Return the folder of a checkpoint that is given by its path, or by the name of a bundled policy.

    Raises:
        ValueError: if it is neither.
    """
    path = Path(text)
    if path.exists():
        return path
    if text in names():
        return folder(text)
    raise ValueError(
        f"{text!r} is neither a checkpoint directory nor a bundled policy; these are: {', '.join(names()) or 'none'}"
    )
