"""Evaluation of a checkpoint in a child process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import naosprint
from naospec import EvaluationSpec

from naosprint_worker.child_process import Services, StopRequestedError


def evaluate_into(
    folder: Path, checkpoint: Path, spec: EvaluationSpec, *, threads: int, services: Services
) -> dict[str, Any]:
    """Evaluate ``checkpoint``, write results and trajectories to ``folder`` and return the results.

    Raises:
        StopRequestedError: this process was asked to stop meanwhile.
    """
    try:
        evaluation = naosprint.evaluate(checkpoint, spec, threads=threads, stop=services.step)
    except InterruptedError as error:
        raise StopRequestedError from error
    evaluation.save(folder)
    return evaluation.summary
