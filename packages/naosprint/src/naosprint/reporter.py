"""Let a training tell the world how it goes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from pathlib import Path


class Reporter(Protocol):
    """Receive what a training has to say; every call comes from the training's own thread."""

    def metrics(self, row: dict[str, float]) -> None:
        """Take the figures of one update; one that has no value yet is missing, never NaN."""

    def checkpoint(self, path: Path, step: int) -> None:
        """Take note of a checkpoint directory, complete at the time of the call."""

    def log(self, level: str, message: str) -> None:
        """Take one line for people; ``level`` is a name of the logging module in lower case."""


class NullReporter:
    """Keep everything to itself."""

    def metrics(self, row: dict[str, float]) -> None:
        """Ignore the figures."""

    def checkpoint(self, path: Path, step: int) -> None:
        """Ignore the checkpoint."""

    def log(self, level: str, message: str) -> None:
        """Ignore the line."""
