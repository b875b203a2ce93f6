"""Reinforcement learning for simulated robots: tasks, PPO, evaluation and reports.

Importing this package is cheap: PyTorch is loaded by the first use of :func:`train`, so that a process can still call
:func:`naosprint.threads.quiet_openmp` before. With Gymnasium, every installed task is registered as an environment; see
:mod:`naosprint.envs`.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from naosprint.analysis.evaluation import EvaluationRun, evaluate
    from naosprint.rl.checkpoint import CheckpointError
    from naosprint.rl.learner import TrainingDivergedError
    from naosprint.rl.reporter import NullReporter, Reporter
    from naosprint.rl.runner import TrainResult, train

__all__ = [
    "CheckpointError",
    "EvaluationRun",
    "NullReporter",
    "Reporter",
    "TrainResult",
    "TrainingDivergedError",
    "evaluate",
    "train",
]

__version__ = "0.2.0"

_MODULES = {
    "CheckpointError": "naosprint.rl.checkpoint",
    "Evaluation": "naosprint.analysis.evaluation",
    "NullReporter": "naosprint.rl.reporter",
    "Reporter": "naosprint.rl.reporter",
    "TrainResult": "naosprint.rl.runner",
    "TrainingDivergedError": "naosprint.rl.learner",
    "evaluate": "naosprint.analysis.evaluation",
    "train": "naosprint.rl.runner",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


if find_spec("gymnasium") is not None:
    from naosprint.registration import register_envs

    register_envs()
