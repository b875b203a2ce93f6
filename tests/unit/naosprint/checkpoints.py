"""Comparison of checkpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from naospec import TrainingSpec
from naosprint import train
from naosprint.rl.checkpoint import ENVIRONMENT, LEARNER, POLICY, read_arrays


def contents(checkpoint: Path) -> dict[str, Any]:
    """Return every array of a checkpoint."""
    return {
        f"{name}:{key}": value
        for name in (POLICY, LEARNER, ENVIRONMENT)
        for key, value in read_arrays(checkpoint / name).items()
    }


def assert_same(first: Path, second: Path) -> None:
    """Compare two checkpoints bit for bit."""
    ours, theirs = contents(first), contents(second)
    assert ours.keys() == theirs.keys()
    for name in ours:
        assert (ours[name].shape, ours[name].tobytes()) == (theirs[name].shape, theirs[name].tobytes()), name


def assert_resumes(spec: TrainingSpec, stopped_at: int, workdir: Path, recorder: Any) -> None:
    """Resume a training from its checkpoint at ``stopped_at`` steps, and compare how both end, bit for bit."""
    whole = train(spec, workdir=workdir / "whole", reporter=recorder)
    start = workdir / "whole" / f"step-{stopped_at:012d}"
    resumed = train(spec, workdir=workdir / "resumed", reporter=recorder, resume=start)
    assert_same(resumed.checkpoint, whole.checkpoint)
