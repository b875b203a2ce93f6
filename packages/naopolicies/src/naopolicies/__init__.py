"""Bundled policies: weights, cards and a recorded episode of each. Data only; importing it loads nothing else.

Each policy is a folder under ``bundled``:

- ``checkpoint.json``, ``policy.npz``: a checkpoint without what only its training would need.
- ``card.json``: what it is, how it was trained, and the results of its evaluation.
- ``replay.json``: one recorded episode.
- ``earlier``, of some: a whole checkpoint shortly before, from which the last segment of the training can be repeated.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

CARD = "card.json"
CHECKPOINT = "checkpoint.json"
REPLAY = "replay.json"
WEIGHTS = "policy.npz"
EARLIER = "earlier"

_METRIC = ("title", "unit", "description", "digits", "better", "kind")
"""What describes a result's metric. A stored card has it once, in ``results``, and not in its tables and conditions."""

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
    metrics = {one["name"]: {key: one[key] for key in _METRIC} for one in found["results"]}
    for result in _repeated(found):
        result.update({**metrics.get(result["name"], {}), **result})
    return found


def stored(card: dict[str, Any]) -> dict[str, Any]:
    """Return a card as its file contains it, which :func:`card` completes."""
    slim = deepcopy(card)
    metrics = {one["name"] for one in slim["results"]}
    for result in _repeated(slim):
        for key in _METRIC if result["name"] in metrics else ():
            del result[key]
    return slim


def _repeated(card: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the results of a card that other conditions or tables repeat."""
    for part in (*card.get("robustness", ()), *(column for table in card["tables"] for column in table["columns"])):
        yield from part["results"]


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

    A folder that only happens to be called like a bundled policy, as one of its recipe's training is, is none.

    Raises:
        ValueError: if it is neither.
    """
    path = Path(text)
    if path.exists() and (text not in names() or (path / CHECKPOINT).exists()):
        return path
    if text in names():
        return folder(text)
    raise ValueError(
        f"{text!r} is neither a checkpoint directory nor a bundled policy; these are: {', '.join(names()) or 'none'}"
    )
