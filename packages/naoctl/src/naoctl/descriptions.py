"""Metrics of tasks and algorithms, from the installed plug-ins or else from the service."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from naospec import plugins
from naospec.metrics import EPISODE_METRICS, Metric, format_value

if TYPE_CHECKING:
    from naoctl.client import Client

PACE = Metric("steps_per_s", "Pace", "steps/s", "Environment steps a second in this update, learning included.", 0)
"""Metric of a training's speed, for any task and algorithm."""

UNNAMED = "?"
"""Name of a section that a stored specification lacks."""


def metric_of(description: Mapping[str, Any]) -> Metric:
    """Return the metric that a JSON object describes: of a task's description, or a result of an evaluation."""
    return Metric(**{field.name: description[field.name] for field in fields(Metric) if field.name in description})


def section_name(spec: Mapping[str, Any], section: str) -> str:
    """Return the name of a section's plug-in in a stored specification, or :data:`UNNAMED` if it has none."""
    value = spec.get(section)
    name = value.get("name") if isinstance(value, Mapping) else value
    return str(name) if name else UNNAMED


class Descriptions:
    """Descriptions of tasks by name.

    Args:
        client: used for tasks that are not installed here; None: these have no metrics.
    """

    def __init__(self, client: Client | None = None) -> None:
        self._client = client
        self._remote: dict[str, dict[str, Any]] | None = None

    def task(self, name: str) -> dict[str, Any]:
        """Return a task's description; empty if neither this installation nor the service has one."""
        if (task := plugins.find(plugins.TASKS, name)) is not None:
            described: dict[str, Any] = task.describe()
            return described
        if self._remote is None:
            self._remote = {} if self._client is None else {item["name"]: item for item in self._client.get("/tasks")}
        return self._remote.get(name, {})

    def listed(self, job: Mapping[str, Any]) -> list[Metric]:
        """Return the live metrics of a job's task that lists show, the most important first."""
        task = self.task(section_name(job["spec"], "task"))
        known = {item["name"]: metric_of(item) for item in task.get("metrics", ())}
        return [known[name] for name in task.get("listed", ()) if name in known]

    def shown(self, job: Mapping[str, Any]) -> list[Metric]:
        """Return the metrics that a job's own displays show: the reward, those listed, and the pace."""
        listed = self.listed(job)
        reward = [metric for metric in EPISODE_METRICS[:1] if metric.name not in {item.name for item in listed}]
        return [*reward, *listed, PACE]


def value_text(metric: Metric, row: Mapping[str, Any]) -> str:
    """Return a metric of a row with its unit; a dash if the row does not have it."""
    value = row.get(metric.name)
    return format_value(metric, value if isinstance(value, int | float) and math.isfinite(value) else None)


def common(groups: Sequence[Sequence[Metric]]) -> list[Metric]:
    """Return the metrics of several jobs, each once: the first of each job, then the second of each, and so on."""
    found: dict[str, Metric] = {}
    for rank in itertools.zip_longest(*groups):
        for metric in rank:
            if metric is not None:
                found.setdefault(metric.name, metric)
    return list(found.values())
