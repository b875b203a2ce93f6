"""Results of evaluations, which describe themselves: titles, units and intervals come with the numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from naospec.metrics import Metric, format_value

from naoctl.client import Client
from naoctl.descriptions import metric_of, value_text
from naoctl.follow import ENDED

TRAINING_MARK = "*"
"""What marks values of training, which includes exploration, among those of evaluations, and its explanation."""
TRAINING_NOTE = "* during training, with exploration"


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


def job_evaluation(client: Client, job_id: str) -> dict[str, Any] | None:
    """Return a job's evaluation, or None: of the finished ones with the most episodes, the newest.

    The service's ``result`` of a job and the dashboard choose the same one.
    """
    found = client.every(f"/jobs/{job_id}/evaluations")
    finished = [evaluation for evaluation in found if evaluation["state"] == "succeeded"]
    return max(
        finished,
        key=lambda evaluation: ((evaluation.get("summary") or {}).get("episodes", 0), str(evaluation["finished_at"])),
        default=None,
    )


def shown_result(job: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the result that displays show of a job: of an ended one its evaluation, of others nothing."""
    result: Mapping[str, Any] | None = job.get("result")
    return result if job["state"] in ENDED else None


def evaluated(result: Mapping[str, Any]) -> str:
    """Return which evaluation a job's result is: its episodes, checkpoint and id."""
    return f"{result['episodes']:,} episodes at step {result['step']:,} ({result['evaluation_id']})"


def metric_text(job: Mapping[str, Any], metric: Metric) -> str:
    """Return a metric of a job for a list: from its evaluation, else from training with :data:`TRAINING_MARK`."""
    result = shown_result(job)
    if result is not None:
        values = {item["name"]: item["value"] for item in result["results"]}
        if metric.name in values:
            return format_value(metric, values[metric.name])
    text = value_text(metric, job.get("latest_metrics") or {})
    return text if text == format_value(metric, None) else text + TRAINING_MARK
