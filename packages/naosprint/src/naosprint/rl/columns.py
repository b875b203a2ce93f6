"""Metrics that every training reports."""

from __future__ import annotations

from typing import TYPE_CHECKING

from naospec.metrics import ENGINES, EPISODE_METRICS, PACE, PROGRESS, Metric

from naosprint import tasks
from naosprint.rl.learner import learner_kind

if TYPE_CHECKING:
    from naospec import TrainingSpec

__all__ = ["ENGINES", "PACE", "PROGRESS", "columns"]


def columns(spec: TrainingSpec) -> tuple[Metric, ...]:
    """Return the columns of a training's metrics, in order."""
    kind = learner_kind(spec.algorithm.name)
    live = [metric for metric in tasks.get(spec.task.name).metrics if metric.live]
    return (*PROGRESS, *EPISODE_METRICS, *live, *kind.metrics, *ENGINES, *PACE)
