"""The NAO sprint tasks: how a run is learnt and how it is judged.

Importing this package is cheap: PyTorch is loaded by the first use of :func:`train`, so that a process can still call
:func:`naosprint.threads.quiet_openmp` before.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from naosprint.checkpoint import CheckpointError
    from naosprint.evaluation import Evaluation, evaluate
    from naosprint.reporter import NullReporter, Reporter
    from naosprint.training import TrainingDivergedError, TrainResult, train

__all__ = [
    "CheckpointError",
    "Evaluation",
    "NullReporter",
    "Reporter",
    "TrainResult",
    "TrainingDivergedError",
    "evaluate",
    "train",
]

__version__ = "0.1.0"

_HOME = {
    "CheckpointError": "naosprint.checkpoint",
    "Evaluation": "naosprint.evaluation",
    "NullReporter": "naosprint.reporter",
    "Reporter": "naosprint.reporter",
    "TrainResult": "naosprint.training",
    "TrainingDivergedError": "naosprint.training",
    "evaluate": "naosprint.evaluation",
    "train": "naosprint.training",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)
