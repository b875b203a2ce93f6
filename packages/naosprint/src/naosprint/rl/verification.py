"""Proof that a checkpoint came from another one: the training between them again, compared bit by bit."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import naopolicies
import numpy as np

from naosprint.rl.checkpoint import CheckpointError, installed_versions, read_file, read_manifest
from naosprint.rl.reporter import NullReporter
from naosprint.rl.runner import train

if TYPE_CHECKING:
    from collections.abc import Callable

    from naosprint.arrays import AnyArray


@dataclass(frozen=True)
class Verification:
    """What was found.

    Attributes:
        steps: environment steps of the earlier and of the later checkpoint.
        arrays: number of arrays that were compared, by file.
        differing: arrays that are not the same bits, as `file: name`.
        versions: packages that had another version then, as `package: then, now`.
    """

    steps: tuple[int, int]
    arrays: dict[str, int]
    differing: tuple[str, ...]
    versions: tuple[str, ...]


def last_two(folder: Path) -> tuple[Path, Path]:
    """Return the last two checkpoints of a training by its folder, or those of a bundled policy that has two.

    Raises:
        CheckpointError: if there are fewer.
    """
    if (folder / naopolicies.EARLIER).is_dir():
        return folder / naopolicies.EARLIER, folder
    found = sorted(path for path in folder.glob("step-*") if path.is_dir())
    if len(found) < 2:
        raise CheckpointError(f"{folder}: not a folder with two checkpoints; name two, an earlier and a later one")
    return found[-2], found[-1]


def verify(earlier: Path, later: Path, progress: Callable[[int], None] = lambda step: None) -> Verification:
    """Train again from a checkpoint to a later one of the same training, and compare all that the later one holds.

    Args:
        earlier: checkpoint to train from.
        later: checkpoint to arrive at.
        progress: called with the environment steps so far.

    Raises:
        CheckpointError: if one is damaged, they are not of the same training, or several processes trained them: the
            bits depend on their number, which is not a setting of the specification but recorded in every checkpoint.
    """
    start, end = read_manifest(earlier), read_manifest(later)
    for folder, manifest in ((earlier, start), (later, end)):
        if manifest.processes > 1:
            raise CheckpointError(f"{folder}: trained by {manifest.processes} processes; only one is verified")
    if start.steps >= end.steps:
        raise CheckpointError(f"{later}: has {end.steps:,} steps, not more than {earlier}, which has {start.steps:,}")
    reporter = _Steps(progress)
    with tempfile.TemporaryDirectory() as scratch:
        again = train(
            end.spec,
            workdir=Path(scratch),
            reporter=reporter,
            resume=earlier,
            # the rollout after the last update is discarded, and what is saved is the state after that update
            stop=lambda: reporter.step >= end.steps,
        )
        found = read_manifest(again.checkpoint)
        if found.steps != end.steps:
            raise CheckpointError(f"{later}: no update of a training from {earlier} ends at its {end.steps:,} steps")
        differing: list[str] = []
        arrays = {}
        for file in end.files:
            theirs, ours = read_file(later, end, file), read_file(again.checkpoint, found, file)
            # an earlier version may have saved fewer arrays
            arrays[file] = len(theirs)
            differing += [f"{file}: {name}" for name in sorted(theirs) if not _same_bits(theirs[name], ours.get(name))]
    now = installed_versions()
    versions = [f"{name}: {then}, now {now.get(name)}" for name, then in end.versions.items() if now.get(name) != then]
    return Verification((start.steps, end.steps), arrays, tuple(differing), tuple(versions))


def _same_bits(a: AnyArray | None, b: AnyArray | None) -> bool:
    if a is None or b is None:
        return False
    return a.dtype == b.dtype and a.shape == b.shape and np.ascontiguousarray(a).tobytes() == b.tobytes()


class _Steps(NullReporter):
    """Reporter that keeps the steps of the last update."""

    def __init__(self, progress: Callable[[int], None]) -> None:
        self.step = -1
        self._progress = progress

    def metrics(self, row: dict[str, float]) -> None:
        """Keep the step."""
        self.step = int(row["step"])
        self._progress(self.step)
