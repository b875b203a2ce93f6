"""Reading of evaluation documents of any task."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from naospec.metrics import Metric, format_value
from rich.table import Table

_FIELDS = tuple(field.name for field in fields(Metric) if field.name not in ("live", "families"))


def metric_of(result: Mapping[str, Any]) -> Metric:
    """Return the metric that a result is a value of."""
    return Metric(**{name: result[name] for name in _FIELDS})


def by_name(summary: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the results of an evaluation by name."""
    return {result["name"]: result for result in summary["results"]}


def headline(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the results that the task shows first."""
    results = by_name(summary)
    return [results[name] for name in summary["headline"] if name in results]


def value_text(result: Mapping[str, Any]) -> str:
    """Return a result's value with its unit: ``4.03 m/s``."""
    return format_value(metric_of(result), result["value"])


def range_text(result: Mapping[str, Any]) -> str:
    """Return the ends of a result's confidence interval: ``0.2 to 1.0 %``; empty if it has none."""
    if result["interval"] is None:
        return ""
    metric = metric_of(result)
    low, high = (format_value(metric, bound) for bound in result["interval"])
    unit = f" {metric.unit}" if metric.unit not in ("", "°") else metric.unit
    return f"{low.removesuffix(unit)} to {high}"


def interval_text(result: Mapping[str, Any], confidence: float) -> str:
    """Return a result's confidence interval: ``95 % interval 0.2 to 1.0 %``; empty if it has none."""
    ends = range_text(result)
    return f"{100.0 * confidence:g} % interval {ends}" if ends else ""


def summary_table(summary: Mapping[str, Any]) -> Table:
    """Return the results of an evaluation document as a table for a terminal, the task's main results first."""
    where = ", ".join(str(summary[name]) for name in ("robot", "simulator", "engine") if summary.get(name))
    table = Table(box=None, pad_edge=False, header_style="bold", title_justify="left", title_style="")
    number = summary["episodes"]
    table.title = f"{summary['task']['name']}, {where}: {number:,} episode{'' if number == 1 else 's'}"
    table.add_column("Result")
    for heading in ("Value", f"{100.0 * summary['evaluation']['confidence']:g} % interval", "Spread"):
        table.add_column(heading, justify="right", no_wrap=True)
    main = headline(summary)
    for result in (*main, *(result for result in summary["results"] if result not in main)):
        spread = "" if result["sd"] is None else format_value(metric_of(result), result["sd"])
        table.add_row(result["title"], value_text(result), range_text(result), spread)
    if not summary["results"]:
        table.add_row("none: the task has no method `summarize`")
    return table
