"""Specifications of trainings and evaluations, presets, recipes, and the plug-ins that they refer to."""

from __future__ import annotations

from naospec import formats, plugins, presets, recipes
from naospec.sections import Section
from naospec.specification import (
    EvaluationSpec,
    LearnerSettings,
    RuntimeSettings,
    SimulatorSettings,
    Stage,
    TaskSettings,
    TrainingSpec,
    read_stored,
    stored,
    validation_words,
)

__all__ = [
    "EvaluationSpec",
    "LearnerSettings",
    "RuntimeSettings",
    "Section",
    "SimulatorSettings",
    "Stage",
    "TaskSettings",
    "TrainingSpec",
    "formats",
    "plugins",
    "presets",
    "read_stored",
    "recipes",
    "stored",
    "validation_words",
]
