"""Evaluation of a checkpoint in a child process."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import naosprint
from naospec import EvaluationSpec

from naosprint_worker.child_process import Services, StopRequestedError

logger = logging.getLogger(__name__)


def evaluate_into(
    folder: Path,
    checkpoint: Path,
    spec: EvaluationSpec,
    *,
    threads: int,
    services: Services,
    warn: Callable[[str], None] = logger.warning,
) -> dict[str, Any]:
    """Evaluate ``checkpoint``, write results and trajectories to ``folder`` and return the results.

    Raises:
        StopRequestedError: this process was asked to stop meanwhile.
    """
    try:
        evaluation = naosprint.evaluate(checkpoint, spec, threads=threads, stop=services.step)
    except InterruptedError as error:
        raise StopRequestedError from error
    for warning in evaluation.warnings:
        warn(warning)
    evaluation.save(folder)
    return evaluation.summary
