"""Results of evaluations, which describe themselves: titles, units and intervals come with the numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from naosprint.tasks.metrics import format_value

from naoctl.client import Client
from naoctl.descriptions import metric_of


def headline(summary: Mapping[str, Any]) -> dict[str, str]:
    """Return the main results of an evaluation by title, with their confidence intervals.

    The task chooses them; where it chooses none, these are all results.
    """
    results = {result["name"]: result for result in summary.get("results", ())}
    chosen = [results[name] for name in summary.get("headline", ()) if name in results] or list(results.values())
    return {result["title"]: result_text(result) for result in chosen}


def result_text(result: Mapping[str, Any]) -> str:
    """Return a result with its unit and its interval, or else its standard deviation."""
    metric, interval, spread = metric_of(result), result.get("interval"), result.get("sd")
    text = format_value(metric, result["value"])
    if result["value"] is None:
        return text
    if interval:
        return f"{text} [{', '.join(format_value(metric, end).removesuffix(metric.unit).rstrip() for end in interval)}]"
    return text if spread is None else f"{text} (sd {format_value(metric, spread).removesuffix(metric.unit).rstrip()})"


def newest_evaluation(client: Client, job_id: str) -> dict[str, Any] | None:
    """Return a job's newest finished evaluation as the service shows it, or None."""
    found: list[dict[str, Any]] = client.get(f"/jobs/{job_id}/evaluations")
    finished = [evaluation for evaluation in found if evaluation["state"] == "succeeded"]
    return max(finished, key=lambda evaluation: str(evaluation["finished_at"]), default=None)
