"""Metrics of the latest episodes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from naosprint.arrays import AnyArray, FloatArray

WINDOW = 100
"""Episodes that live metrics are means of."""


class EpisodeWindow:
    """Means over the latest finished episodes.

    Args:
        names: what is measured of an episode, in the order of the columns of :meth:`add`.

    Attributes:
        episodes: episodes finished so far.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.episodes = 0
        self._rows: FloatArray = np.zeros((WINDOW, len(self.names)))

    def add(self, values: FloatArray) -> None:
        """Add k episodes that ended in the same step, (k, M)."""
        for row in values[-WINDOW:]:
            self._rows[self.episodes % WINDOW] = row
            self.episodes += 1
        self.episodes += max(0, len(values) - WINDOW)

    def means(self) -> dict[str, float]:
        """Return the mean of each metric over the window; nothing before the first episode has ended."""
        filled = min(self.episodes, WINDOW)
        if not filled:
            return {}
        return dict(zip(self.names, self._rows[:filled].mean(axis=0).tolist(), strict=True))

    def state(self) -> dict[str, AnyArray]:
        """Return the window's content."""
        return {"episodes": np.array([self.episodes], dtype=np.int64), "rows": self._rows.copy()}

    def load_state(self, state: Mapping[str, AnyArray]) -> None:
        """Restore what :meth:`state` returned."""
        self.episodes = int(np.asarray(state["episodes"])[0])
        self._rows = np.array(state["rows"], dtype=np.float64)
