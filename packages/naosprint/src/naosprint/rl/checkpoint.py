"""Checkpoints: directories of plain arrays and one manifest, never pickles.

    checkpoint.json     format, specification, counters, versions, and SHA-256 and size of every file
    policy.npz          weights and observation statistics: all that acting needs
    learner.npz         optimiser, generators
    environment.npz     episodes, curricula, means; the simulator, if it has snapshots
    process-1.npz       the same, and generators, of the second process of a training in several; and so on

A directory is written under another name and renamed when it is complete, so one that exists is complete.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
from naosim.npz import read_npz
from naospec import TrainingSpec, formats, validation_words
from naospec.files import named_errors, open_regular, partial_of, read_json, sync, write_whole
from naospec.json_text import json_text
from naospec.sections import PlainName
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from naosprint.arrays import AnyArray

MANIFEST = "checkpoint.json"
POLICY = "policy.npz"
LEARNER = "learner.npz"
ENVIRONMENT = "environment.npz"

FORMAT = formats.CURRENT[formats.Kind.CHECKPOINT]
"""Version of the checkpoint format that this code writes; it reads older ones, see `naospec.formats`."""

_IMPLIED = {f"{part}observation_counts": "observation_count" for part in ("", "critic_")}
"""Arrays of a policy that its file lacks if all their numbers are the single one of another array."""

_MAX_MANIFEST_BYTES = 1_000_000
_MAX_FILE_BYTES = 4_000_000_000


class CheckpointError(ValueError):
    """Checkpoint that is damaged or does not fit."""


class FileEntry(BaseModel):
    """Checksum and size of one file of a checkpoint."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    size: int = Field(ge=0, le=_MAX_FILE_BYTES)


_Count = Annotated[int, Field(ge=0, le=2**53)]
_FileName = Annotated[str, Field(pattern="^[a-z][a-z0-9-]{0,63}\\.npz$")]


class Manifest(BaseModel):
    """Content of ``checkpoint.json``; its names enter generated files and paths, so they are plain."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    format: int
    spec: TrainingSpec
    spec_sha256: str
    stage: _Count
    steps: _Count
    updates: _Count
    episodes: _Count
    training_s: float = Field(ge=0.0)
    observations: tuple[PlainName, ...]
    actions: tuple[PlainName, ...]
    critic: tuple[PlainName, ...] = ()
    """What only a critic observes; earlier formats do not say."""
    versions: dict[PlainName, Annotated[str, Field(max_length=100)]]
    files: dict[_FileName, FileEntry]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for field, names in (("observations", self.observations), ("actions", self.actions)):
            if len(set(names)) < len(names):
                raise ValueError(f"{field}: two have the same name")
        stages = len(self.spec.stage_specs)
        if self.stage >= stages:
            raise ValueError(f"stage: {self.stage} is not one of the {stages} of the specification, counted from 0")
        return self

    @property
    def processes(self) -> int:
        """Number of processes that trained it."""
        return 1 + sum(process_file(number) in self.files for number in range(1, len(self.files)))

    @property
    def stage_spec(self) -> TrainingSpec:
        """Specification of the stage that the checkpoint belongs to; of the whole training if it has no stages."""
        return self.spec.stage_specs[self.stage]


@dataclass(frozen=True, slots=True)
class TrainingState:
    """State from which a training can continue, besides its specification.

    Attributes:
        stage: number of the stage that it belongs to, from 0.
        steps: environment steps of all stages so far.
        others: what the other processes of the training need to continue.
        critic: names of what only a critic observes.
    """

    stage: int
    steps: int
    updates: int
    episodes: int
    training_s: float
    observations: tuple[str, ...]
    actions: tuple[str, ...]
    policy: Mapping[str, AnyArray]
    learner: Mapping[str, AnyArray]
    environment: Mapping[str, AnyArray]
    others: Sequence[Mapping[str, AnyArray]] = ()
    critic: tuple[str, ...] = ()


def process_file(number: int) -> str:
    """Return the name of the file of a process; the first one, 0, has the files named above."""
    return f"process-{number}.npz"


def save_checkpoint(directory: Path, spec: TrainingSpec, state: TrainingState) -> Path:
    """Write a checkpoint to ``directory``, which appears only when it is complete.

    An existing directory of that name is replaced. Returns ``directory``.

    Raises:
        OSError: if the files cannot be written.
    """
    directory.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_of(directory)
    partial.mkdir()
    try:
        policy = {name: array for name, array in state.policy.items() if not _is_implied(name, state.policy)}
        contents = {POLICY: policy, LEARNER: state.learner, ENVIRONMENT: state.environment}
        contents |= {process_file(number): arrays for number, arrays in enumerate(state.others, 1)}
        files = {name: _write_arrays(partial / name, arrays) for name, arrays in contents.items()}
        manifest = Manifest(
            format=FORMAT,
            spec=spec,
            spec_sha256=spec.digest(),
            stage=state.stage,
            steps=state.steps,
            updates=state.updates,
            episodes=state.episodes,
            training_s=state.training_s,
            observations=state.observations,
            actions=state.actions,
            critic=state.critic,
            versions=installed_versions(),
            files=files,
        )
        text = json_text(manifest.model_dump(mode="json"))
        write_whole(partial / MANIFEST, text)
        replaced = partial_of(directory)
        if directory.exists():
            directory.rename(replaced)  # removing it takes time in which there would be neither
        partial.rename(directory)
        sync(directory.parent)
        shutil.rmtree(replaced, ignore_errors=True)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return directory


def read_manifest(directory: Path) -> Manifest:
    """Read and check the manifest of the checkpoint in ``directory``.

    Raises:
        CheckpointError: if there is none, or one that this version cannot read.
    """
    path = directory / MANIFEST
    try:
        raw = read_json(path, _MAX_MANIFEST_BYTES)
    except FileNotFoundError:
        inside = sorted(found.parent for found in directory.glob(f"*/{MANIFEST}"))
        use = f"; use its newest one, {inside[-1]}" if inside else ""
        raise CheckpointError(f"{directory}: not a checkpoint ({MANIFEST} is missing){use}") from None
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: unreadable: {error}") from error
    if not isinstance(raw, dict):
        raise CheckpointError(f"{path}: not the manifest of a checkpoint")
    try:
        manifest = Manifest.model_validate(formats.current(formats.Kind.CHECKPOINT, raw))
    except formats.FormatError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except ValidationError as error:
        raise CheckpointError(f"{path}: {validation_words(error.errors())}") from error
    # of what was written, so that fields added since do not count
    written = {name: value for name, value in raw["spec"].items() if name != "runtime"}
    canonical = json.dumps(written, sort_keys=True, separators=(",", ":"))
    if hashlib.sha256(canonical.encode()).hexdigest() != manifest.spec_sha256:
        raise CheckpointError(f"{path}: spec: does not match spec_sha256; the file was edited")
    return manifest


def read_file(directory: Path, manifest: Manifest, name: str) -> dict[str, AnyArray]:
    """Read one file of arrays after checking it against the manifest.

    Raises:
        CheckpointError: if it is missing, changed, or contains anything but plain arrays.
    """
    entry = manifest.files.get(name)
    path = directory / name
    if entry is None:
        raise CheckpointError(f"{directory}: the checkpoint has no {name}")
    try:
        with open_regular(path) as stream:
            size = os.fstat(stream.fileno()).st_size
            if size != entry.size:
                raise CheckpointError(f"{path}: {size} bytes, but the manifest has {entry.size}; the file is damaged")
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise CheckpointError(f"{path}: unreadable: {error}") from error
    if digest != entry.sha256:
        raise CheckpointError(f"{path}: SHA-256 does not match the manifest; the file is damaged")
    return read_arrays(path)


def verify_checkpoint(directory: Path) -> Manifest:
    """Read every file of the checkpoint in ``directory``; return its manifest.

    Raises:
        CheckpointError: if something is missing or damaged.
    """
    manifest = read_manifest(directory)
    for name in manifest.files:
        read_file(directory, manifest, name)
    return manifest


def read_arrays(path: Path) -> dict[str, AnyArray]:
    """Read a ``.npz`` file of plain numbers without trusting its content.

    Raises:
        CheckpointError: if it is not such a file, contains objects, or announces more data than it has.
    """
    try:
        return read_npz(path)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: not a file of arrays: {error}") from error


def require_like(
    path: Path, found: Mapping[str, AnyArray], expected: Mapping[str, AnyArray], *, finite: bool = True
) -> None:
    """Check that ``found`` has the names, shapes and kinds of ``expected``, and nothing but finite numbers if asked.

    What a policy's file lacks because another array implies it may be missing.

    Raises:
        CheckpointError: naming the first array that differs.
    """
    for name in sorted((expected.keys() - (_IMPLIED.keys() - found.keys())) | found.keys()):
        if name not in found:
            raise CheckpointError(f"{path}: array {name!r} is missing")
        if name not in expected:
            raise CheckpointError(f"{path}: array {name!r} is unknown")
        ours, theirs = expected[name], found[name]
        if ours.shape != theirs.shape or ours.dtype != theirs.dtype:
            raise CheckpointError(
                f"{path}: array {name!r} is {theirs.dtype}{list(theirs.shape)}, "
                f"but the specification needs {ours.dtype}{list(ours.shape)}"
            )
        if finite and theirs.dtype.kind == "f" and not np.isfinite(theirs).all():
            raise CheckpointError(f"{path}: array {name!r} contains numbers that are not finite")


def _is_implied(name: str, arrays: Mapping[str, AnyArray]) -> bool:
    return name in _IMPLIED and bool((arrays[name] == arrays[_IMPLIED[name]]).all())


def _write_arrays(path: Path, arrays: Mapping[str, AnyArray]) -> FileEntry:
    with named_errors(path), path.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **{name: np.asarray(value, order="C") for name, value in arrays.items()})
        stream.flush()
        os.fsync(stream.fileno())
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return FileEntry(sha256=digest, size=path.stat().st_size)


def installed_versions() -> dict[str, str]:
    """Return the versions of the packages that decide what a training computes."""
    found: dict[str, Any] = {}
    for name in ("naosprint", "naosim", "naospec", "numpy", "torch", "stable-baselines3"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found
