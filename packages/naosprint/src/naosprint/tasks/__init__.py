"""Tasks: what robots learn. Importing this package loads no PyTorch, so API and command line can describe tasks."""

from __future__ import annotations

from naospec import TaskSettings

from naosprint.tasks.base import End, RewardTerm, Task, World
from naosprint.tasks.metrics import Chart, FieldLine, Metric, Presentation, Reference, Result, ResultTable
from naosprint.tasks.observations import ObservationBlock, blocks

__all__ = [
    "Chart",
    "End",
    "FieldLine",
    "Metric",
    "ObservationBlock",
    "Presentation",
    "Reference",
    "Result",
    "ResultTable",
    "RewardTerm",
    "Task",
    "TaskSettings",
    "World",
    "blocks",
]
