"""Remember the latest episodes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from naosprint.arrays import AnyArray, BoolArray, FloatArray

WINDOW = 100
"""Episodes that the live figures are means of."""


class EpisodeWindow:
    """Keep the figures of the latest finished episodes.

    Attributes:
        episodes: episodes finished so far.
    """

    _COLUMNS = ("reward", "distance_m", "episode_length", "fall_rate", "speed_mps")

    def __init__(self) -> None:
        self.episodes = 0
        self._rows: FloatArray = np.zeros((WINDOW, len(self._COLUMNS)))

    def add(
        self,
        *,
        rewards: FloatArray,
        distances_m: FloatArray,
        steps: FloatArray,
        fallen: BoolArray,
        durations_s: FloatArray,
    ) -> None:
        """Add k episodes that ended in the same step, all arguments of shape (k,)."""
        new = np.stack([rewards, distances_m, steps, fallen, distances_m / durations_s], axis=1)
        for row in new[-WINDOW:]:
            self._rows[self.episodes % WINDOW] = row
            self.episodes += 1
        self.episodes += max(0, len(new) - WINDOW)

    def means(self) -> dict[str, float]:
        """Return the mean of each figure over the window; nothing before the first episode is over."""
        filled = min(self.episodes, WINDOW)
        if not filled:
            return {}
        return dict(zip(self._COLUMNS, self._rows[:filled].mean(axis=0).tolist(), strict=True))

    def state(self) -> dict[str, AnyArray]:
        """Return everything the window knows."""
        return {"episodes": np.array([self.episodes], dtype=np.int64), "rows": self._rows.copy()}

    def load_state(self, state: Mapping[str, AnyArray]) -> None:
        """Take over what :meth:`state` returned."""
        self.episodes = int(np.asarray(state["episodes"])[0])
        self._rows = np.array(state["rows"], dtype=np.float64)
