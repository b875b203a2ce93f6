"""What a policy's card says beyond its results: peaks of its motion, results under disturbances, ranges it stands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from naosprint.analysis import robustness
from naosprint.analysis.motion import ROWS, motion
from naosprint.analysis.results import value_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from rich.table import Table

PARTS = ("motion", "conditions", *robustness.BY_NAME)
"""What can be examined: two tables, and the range of each disturbance."""


@dataclass(frozen=True)
class Examination:
    """What was found.

    Attributes:
        episodes: episodes at each strength and under each condition.
        most_failures: share of episodes that may fail within a range.
        motion: peaks while running and standing; empty for robots without.
        conditions: the headline results under each condition.
        ranges: for each disturbance the range within which few enough episodes fail.
    """

    episodes: int
    most_failures: float
    motion: dict[str, dict[str, float]]
    conditions: list[dict[str, Any]]
    ranges: list[robustness.Range]

    def to_dict(self) -> dict[str, Any]:
        """Return it as a JSON object, as cards contain it."""
        ranges = {
            "episodes": self.episodes,
            "most_failures": self.most_failures,
            "disturbances": [each.to_dict() for each in self.ranges],
        }
        return {"motion": self.motion, "robustness": self.conditions, "ranges": ranges}


def examine(
    checkpoint: Path,
    *,
    episodes: int = 100,
    most_failures: float = 0.05,
    names: Sequence[str] = (),
    threads: int = 2,
    tell: Callable[[str], None] = lambda text: None,
) -> Examination:
    """Examine a policy.

    Args:
        checkpoint: the policy.
        episodes: episodes at each strength and under each condition.
        most_failures: share of episodes that may fail within a range.
        names: which of `PARTS`; all by default.
        threads: threads of the simulator.
        tell: called with what is being examined.

    Raises:
        ValueError: if there is no such part, or the task measures neither falls nor success.
    """
    unknown = sorted(set(names) - set(PARTS))
    if unknown:
        raise ValueError(f"{', '.join(unknown)}: unknown; choose among {', '.join(PARTS)}")
    wanted = names or PARTS

    def tell_point(disturbance: robustness.Disturbance, point: robustness.Point) -> None:
        text = f"{disturbance.name} {point.strength:g} {disturbance.unit}".rstrip()
        tell(f"{text}: {100.0 * point.failures:.1f} % failed")

    return Examination(
        episodes,
        most_failures,
        motion(checkpoint, threads) if "motion" in wanted else {},
        robustness.conditions(checkpoint, episodes=episodes, threads=threads, on_condition=tell)
        if "conditions" in wanted
        else [],
        robustness.ranges(
            checkpoint,
            episodes=episodes,
            most_failures=most_failures,
            names=[name for name in robustness.BY_NAME if name in wanted],
            threads=threads,
            on_point=tell_point,
        ),
    )


def rows(found: Mapping[str, Any]) -> Iterator[tuple[str, list[list[str]]]]:
    """Yield the title and the rows, the header first, of each table of a card that has any."""
    if found.get("motion"):
        running, standing = found["motion"]["running"], found["motion"]["standing"]
        lines = [[title, *(f"{each[key]:g} {unit}" for each in (running, standing))] for title, key, unit in ROWS]
        shares = [f"{100.0 * each['torque_at_limit']:.1f} %" for each in (running, standing)]
        yield "Motion", [["", "Running", "Standing"], *lines, ["Motors at their torque limit", *shares]]
    if found.get("robustness"):
        # a card may lack what no episode supported
        titles = {result["name"]: result["title"] for row in found["robustness"] for result in row["results"]}
        texts = [{result["name"]: value_text(result) for result in row["results"]} for row in found["robustness"]]
        lines = [
            [row["disturbance"], *(text.get(name, "-") for name in titles)]
            for row, text in zip(found["robustness"], texts, strict=True)
        ]
        yield "Robustness", [["Disturbance", *titles.values()], *lines]
    ranges = found.get("ranges") or {}
    if ranges.get("disturbances"):
        title = f"Ranges in which at most {100.0 * ranges['most_failures']:g} % of {ranges['episodes']} episodes fail"
        lines = [[each["disturbance"], each["title"], each["text"]] for each in ranges["disturbances"]]
        yield title, [["Disturbance", "Strength", "Range"], *lines]


def tables(found: Mapping[str, Any]) -> Iterator[Table]:
    """Yield what was found as tables for a terminal."""
    from rich.table import Table

    for title, (header, *lines) in rows(found):
        table = Table(*header, title=title, title_justify="left", box=None, pad_edge=False, header_style="bold")
        for line in lines:
            table.add_row(*line)
        yield table
