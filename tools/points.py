"""Points of a gate: a measurement, its bound, and whether it passes."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Point:
    """One line of a gate.

    Attributes:
        command: what the robot has to do.
        name: what is measured.
        value: the measurement; None if there is none, or it is not finite, as no number of JSON is.
        bound: its bound, with the sign of the side that passes.
        passed: whether it passes.
    """

    command: str
    name: str
    value: float | None
    bound: str
    passed: bool

    def __str__(self) -> str:
        """Return it as a line of a table."""
        value = "none" if self.value is None else f"{self.value:.3f}"
        mark = "pass" if self.passed else "FAIL"
        return f"  {mark}  {self.command:<42}{self.name:<32}{value:>8}  {self.bound}"


def at_least(command: str, name: str, value: float | None, bound: float) -> Point:
    """Return a point that large values pass."""
    value = _finite(value)
    return Point(command, name, value, f">= {bound:g}", value is not None and value >= bound)


def at_most(command: str, name: str, value: float | None, bound: float) -> Point:
    """Return a point that small values pass."""
    value = _finite(value)
    return Point(command, name, value, f"<= {bound:g}", value is not None and value <= bound)


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
