"""Show a training in a terminal and keep its figures in a file."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType


class ConsoleReporter:
    """Draw a progress bar with the latest figures, and append each row to ``metrics.jsonl`` in ``workdir``."""

    def __init__(self, workdir: Path, total_steps: int) -> None:
        workdir.mkdir(parents=True, exist_ok=True)
        self._file = (workdir / "metrics.jsonl").open("a", buffering=1)
        self._console = Console(stderr=True)
        self._progress = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.description}"),
            TimeRemainingColumn(),
            console=self._console,
        )
        self._bar = self._progress.add_task("starting", total=total_steps)

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
        """Show and keep the figures of one update."""
        self._file.write(json.dumps(row, allow_nan=False) + "\n")
        parts = [f"{row['steps_per_s']:,.0f} steps/s"]
        if "distance_m" in row:
            parts.append(f"{row['distance_m']:.2f} m")
            parts.append(f"{row['speed_mps']:.2f} m/s")
            parts.append(f"{100 * row['fall_rate']:.0f} % falls")
        self._progress.update(self._bar, completed=int(row["step"]), description=", ".join(parts))

    def checkpoint(self, path: Path, step: int) -> None:
        """Show where a checkpoint is."""
        self._console.print(f"checkpoint at {step:,} steps: {path}", highlight=False)

    def log(self, level: str, message: str) -> None:
        """Show a line."""
        self._console.print(f"{level}: {message}", highlight=False, markup=False)
