"""Display of a training in a terminal."""

from __future__ import annotations

import fcntl
import json
from typing import TYPE_CHECKING

from naospec.files import named_errors
from naospec.metrics import format_value
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from naosprint import tasks
from naosprint.rl.columns import columns

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path
    from types import TracebackType

    from naospec import TrainingSpec


def listed_text(spec: TrainingSpec, row: Mapping[str, float]) -> list[str]:
    """Return the metrics of a row that the task shows first: ``["distance 27.95 m", "falls 0.4 %"]``."""
    known = {metric.name: metric for metric in columns(spec)}
    listed = [known[name] for name in tasks.get(spec.task.name).presentation.listed if name in row]
    return [f"{metric.title.lower()} {format_value(metric, row[metric.name])}" for metric in listed]


def _remove_torn_line(path: Path) -> None:
    """Remove a last line that a full disk has cut, so that the next row begins a line of its own."""
    with path.open("r+b") as stream:
        stream.truncate(stream.read().rfind(b"\n") + 1)


class ConsoleReporter:
    """Progress bar with the latest metrics, which also go to ``metrics.jsonl`` in ``workdir``.

    Args:
        workdir: made if it is missing.
        spec: the training, whose task decides which metrics are shown.

    Raises:
        ValueError: if another process trains in ``workdir``.
    """

    def __init__(self, workdir: Path, spec: TrainingSpec) -> None:
        workdir.mkdir(parents=True, exist_ok=True)
        self._path = workdir / "metrics.jsonl"
        self._file = self._path.open("a", buffering=1, encoding="utf-8")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # until the process ends, however it does
        except BlockingIOError:
            self._file.close()
            raise ValueError(f"{workdir}: another process trains in this folder; use another one") from None
        except OSError:
            pass  # a file system without locks
        _remove_torn_line(self._path)
        self._spec = spec
        self._console = Console(stderr=True)
        self._progress = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.description}"),
            TimeRemainingColumn(),
            console=self._console,
        )
        self._bar = self._progress.add_task("starting", total=spec.planned_steps)

    def __enter__(self) -> ConsoleReporter:
        """Start drawing."""
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop drawing and close the file."""
        self._progress.stop()
        self._file.close()

    def metrics(self, row: dict[str, float]) -> None:
        """Show and store the metrics of one update."""
        with named_errors(self._path):
            self._file.write(json.dumps(row, allow_nan=False) + "\n")
        parts = [f"{row['steps_per_s']:,.0f} steps/s"]
        parts += listed_text(self._spec, row)
        self._progress.update(self._bar, completed=int(row["step"]), description=", ".join(parts))

    def checkpoint(self, path: Path, step: int) -> None:
        """Show where a checkpoint is."""
        self._console.print(f"checkpoint at {step:,} steps: {path}", highlight=False, markup=False)

    def log(self, level: str, message: str) -> None:
        """Show a line."""
        self._console.print(f"{level}: {message}", highlight=False, markup=False)
