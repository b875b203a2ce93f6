"""Comparison of checkpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
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
        assert np.array_equal(ours[name], theirs[name]), name
