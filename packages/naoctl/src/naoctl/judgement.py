"""The figures of an evaluation that people ask for first, with their confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from naoctl.client import Client
from naoctl.render import MISSING

#: Where a figure stands in the summary, what it is called, its unit; dots lead into tables.
SPREADS: tuple[tuple[str, str, str], ...] = (
    ("distance_m", "Distance", "m"),
    ("speed_mps", "Speed, whole run", "m/s"),
    ("run_challenge.score", "Run challenge score", ""),
)
SHARES: tuple[tuple[str, str], ...] = (("falls", "Falls"), ("arrivals", "Arrivals"))


def headline(summary: Mapping[str, Any]) -> dict[str, str]:
    """Return the main figures of an evaluation by name, written with their confidence intervals.

    A figure that the summary lacks is left out; one that no episode supports is a dash.
    """
    figures: dict[str, str] = {}
    for path, title, unit in SPREADS:
        spread = _at(summary, path)
        if isinstance(spread, Mapping):
            figures[title] = _with_interval(spread.get("mean"), spread.get("ci"), lambda v: f"{v:.2f}", unit)
    top = _at(summary, "paper")
    if isinstance(top, Mapping) and "top_speed_mps" in top:
        value, spread_mps = top["top_speed_mps"], top.get("top_speed_sd_mps")
        figures["Top speed (paper)"] = (
            MISSING
            if value is None
            else f"{value:.2f} m/s" + (f" (sd {spread_mps:.2f})" if spread_mps is not None else "")
        )
    for path, title in SHARES:
        share = _at(summary, path)
        if isinstance(share, Mapping):
            figures[title] = _with_interval(share.get("rate"), share.get("ci"), lambda v: f"{v:.1%}", "")
    return figures


def newest_evaluation(client: Client, job_id: str) -> dict[str, Any] | None:
    """Return a job's newest finished evaluation as the service shows it, or None."""
    found: list[dict[str, Any]] = client.get(f"/jobs/{job_id}/evaluations")
    finished = [evaluation for evaluation in found if evaluation["state"] == "succeeded"]
    return max(finished, key=lambda evaluation: str(evaluation["finished_at"]), default=None)


def _at(summary: Mapping[str, Any], path: str) -> Any:
    value: Any = summary
    for name in path.split("."):
        value = value.get(name) if isinstance(value, Mapping) else None
    return value


def _with_interval(value: Any, interval: Any, write: Any, unit: str) -> str:
    if not isinstance(value, int | float) or not math.isfinite(value):
        return MISSING
    text = f"{write(value)} {unit}".rstrip()
    if isinstance(interval, list | tuple) and len(interval) == 2:
        text += f" [{write(interval[0])}, {write(interval[1])}]"
    return text
