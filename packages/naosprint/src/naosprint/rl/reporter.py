"""Interface through which a training reports its progress."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from pathlib import Path


class Reporter(Protocol):
    """Receiver of a training's metrics, checkpoints and log lines, called from the training's own thread."""

    def metrics(self, row: dict[str, float]) -> None:
        """Receive the metrics of one update; one that has no value yet is missing, never NaN."""

    def checkpoint(self, path: Path, step: int) -> None:
        """Receive a checkpoint directory, complete at the time of the call."""

    def log(self, level: str, message: str) -> None:
        """Receive one line for users; ``level`` is a name of the logging module in lower case."""


class NullReporter:
    """Reporter that ignores everything."""

    def metrics(self, row: dict[str, float]) -> None:
        """Ignore the metrics."""

    def checkpoint(self, path: Path, step: int) -> None:
        """Ignore the checkpoint."""

    def log(self, level: str, message: str) -> None:
        """Ignore the line."""
