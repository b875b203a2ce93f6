"""Tasks: what robots learn. Importing this package loads no PyTorch, so API and command line can describe tasks."""

from __future__ import annotations

from naospec import TaskSettings

from naosprint.tasks.base import End, RewardTerm, Task, World
from naosprint.tasks.metrics import Chart, FieldLine, Metric, Presentation, Reference, Result, ResultTable
from naosprint.tasks.observations import ObservationBlock, blocks
from naosprint.tasks.robot_defaults import RobotDefaults, robot_defaults

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
    "RobotDefaults",
    "Task",
    "TaskSettings",
    "World",
    "blocks",
    "robot_defaults",
]
