"""Sequential test whether a team does not lose to another one, which stops as early as it may. Wald (1945)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


class Verdict(StrEnum):
    """Result of the test."""

    HOLDS = "does not lose"
    """The first team wins its share of the games that are not drawn."""
    LOSES = "loses"
    """It wins clearly less than its share."""
    OPEN = "undecided"
    """More games are needed."""


@dataclass(frozen=True)
class Gate:
    """Wald's sequential probability ratio test on the games that are not drawn.

    With the probability p that the first team wins such a game, it decides between p = ``losing`` and p = ``holding``
    by the logarithm of the likelihood ratio, which each game changes::

        ratio += log(holding / losing)              after a win
        ratio += log((1 - holding) / (1 - losing))  after a loss

    It ends at log((1 - error) / error) with `Verdict.HOLDS`, at the negative of it with `Verdict.LOSES`; at most a
    share of about ``error`` of the decisions is wrong.

    Attributes:
        losing: probability of a team that loses.
        holding: probability of a team that does not.
        error: share of wrong decisions, for both kinds.
    """

    losing: float = 0.3
    holding: float = 0.5
    error: float = 0.1

    def __post_init__(self) -> None:
        """Check.

        Raises:
            ValueError: naming the number.
        """
        if not 0.0 < self.losing < self.holding < 1.0:
            raise ValueError(f"losing, holding: expected 0 < losing < holding < 1, got {self.losing}, {self.holding}")
        if not 0.0 < self.error < 0.5:
            raise ValueError(f"error: must be between 0 and 0.5, not {self.error}")

    def ratio(self, differences: Iterable[int]) -> float:
        """Return the logarithm of the likelihood ratio after games with these goal differences."""
        win, loss = math.log(self.holding / self.losing), math.log((1 - self.holding) / (1 - self.losing))
        return sum(win if difference > 0 else loss for difference in differences if difference != 0)

    def verdict(self, differences: Iterable[int]) -> Verdict:
        """Return the result after games with these goal differences, in their order."""
        bound = math.log((1 - self.error) / self.error)
        played: list[int] = []
        for difference in differences:
            played.append(difference)
            ratio = self.ratio(played)
            if abs(ratio) >= bound:
                return Verdict.HOLDS if ratio > 0 else Verdict.LOSES
        return Verdict.OPEN
