"""Specifications of trainings and evaluations, presets, recipes, and the plug-ins that they refer to."""

from __future__ import annotations

from naospec import formats, plugins, presets, recipes
from naospec.sections import Section
from naospec.specification import (
    EvaluationSpec,
    LearnerSettings,
    RuntimeSettings,
    Stage,
    TaskSettings,
    TrainingSpec,
    needs,
    read_stored,
    stored,
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
    "formats",
    "needs",
    "plugins",
    "presets",
    "read_stored",
    "recipes",
    "stored",
    "validation_words",
]
