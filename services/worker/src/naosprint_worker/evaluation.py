"""Judge a checkpoint for a child process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import naosprint
from naospec import EvaluationSpec

from naosprint_worker.child_process import Services, StopRequestedError


def evaluate_into(
    folder: Path, checkpoint: Path, spec: EvaluationSpec, *, threads: int, services: Services
) -> dict[str, Any]:
    """Evaluate ``checkpoint``, leave figures and trajectories in ``folder`` and return the figures.

    Raises:
        StopRequestedError: this process was asked to stop meanwhile.
    """
    try:
        evaluation = naosprint.evaluate(checkpoint, spec, threads=threads, stop=services.step)
    except InterruptedError as error:
        raise StopRequestedError from error
    evaluation.save(folder)
    return evaluation.summary
