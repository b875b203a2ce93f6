"""Specifications of trainings and evaluations, presets, recipes, and the plug-ins that they refer to."""

from __future__ import annotations

from naospec import formats, plugins, presets, recipes
from naospec.fields import Stage
from naospec.sections import Section
from naospec.settings import LearnerSettings, RuntimeSettings, SimulatorSettings, TaskSettings
from naospec.specification import EvaluationSpec, TrainingSpec, read_stored, stored, validation_words
from naospec.written import WrittenSpec

__all__ = [
    "EvaluationSpec",
    "LearnerSettings",
    "RuntimeSettings",
    "Section",
    "SimulatorSettings",
    "Stage",
    "TaskSettings",
    "TrainingSpec",
    "WrittenSpec",
    "formats",
    "plugins",
    "presets",
    "read_stored",
    "recipes",
    "stored",
    "validation_words",
]
