"""What a sprint training and its evaluation are: specifications, presets and tasks."""

from __future__ import annotations

from naospec.presets import PRESET_SUMMARIES, PRESETS, PresetName
from naospec.robots import STANDING_HEIGHT_M
from naospec.specification import EvaluationSpec, SimulatorName, TrainingSpec
from naospec.tasks import ERECT_MIN_HEIGHT_M, FINISH_X_M, MIN_HEIGHT_M, TASKS, Task, task

__all__ = [
    "ERECT_MIN_HEIGHT_M",
    "FINISH_X_M",
    "MIN_HEIGHT_M",
    "PRESETS",
    "PRESET_SUMMARIES",
    "STANDING_HEIGHT_M",
    "TASKS",
    "EvaluationSpec",
    "PresetName",
    "SimulatorName",
    "Task",
    "TrainingSpec",
    "task",
]
