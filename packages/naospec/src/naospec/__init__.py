"""Specifications of trainings and evaluations, presets, recipes, and the plug-ins that they refer to."""

from __future__ import annotations

from naospec import plugins, presets, recipes
from naospec.sections import Section
from naospec.specification import (
    EvaluationSpec,
    LearnerSettings,
    RuntimeSettings,
    Stage,
    TaskSettings,
    TrainingSpec,
    needs,
    validation_words,
)

__all__ = [
    "EvaluationSpec",
    "LearnerSettings",
    "RuntimeSettings",
    "Section",
    "Stage",
    "TaskSettings",
    "TrainingSpec",
    "needs",
    "plugins",
    "presets",
    "recipes",
    "validation_words",
]
