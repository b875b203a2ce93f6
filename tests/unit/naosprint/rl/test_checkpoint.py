"""Checkpoints are complete, checked and never unpickled."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naospec import TrainingSpec
from naosprint import train
from naosprint.rl.checkpoint import (
    ENVIRONMENT,
    LEARNER,
    MANIFEST,
    POLICY,
    CheckpointError,
    TrainingState,
    read_arrays,
    read_file,
    read_manifest,
    require_like,
    save_checkpoint,
)
from naosprint.rl.policy import load_policy


@pytest.fixture
def copy(checkpoint: Path, tmp_path: Path) -> Path:
    """Return a checkpoint to damage."""
    return Path(shutil.copytree(checkpoint, tmp_path / "copy"))


def edit(directory: Path, **fields: Any) -> None:
    """Change fields of a manifest."""
    path = directory / MANIFEST
    path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))


def replace_file(directory: Path, name: str, data: bytes) -> None:
    """Replace a file and adapt the manifest, as an attacker would."""
    (directory / name).write_bytes(data)
    files = json.loads((directory / MANIFEST).read_text())["files"]
    files[name] = {"sha256": hashlib.sha256(data).hexdigest(), "size": len(data)}
    edit(directory, files=files)


def npz(**arrays: Any) -> bytes:
    """Return the bytes of an .npz file."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def test_manifest_says_what_the_checkpoint_is(checkpoint: Path, make_spec: Callable[..., TrainingSpec]) -> None:
    """Specification, counters, names, versions and every file with its digest."""
    manifest = read_manifest(checkpoint)
    assert manifest.spec == make_spec()
    assert manifest.spec_sha256 == make_spec().digest()
    assert (manifest.steps, manifest.updates) == (512, 2)
    assert len(manifest.observations) == 89
    assert len(manifest.actions) == 20
    assert set(manifest.versions) >= {"naosprint", "naosim", "torch", "numpy"}
    assert set(manifest.files) == {POLICY, LEARNER, ENVIRONMENT}
    assert {path.name for path in checkpoint.iterdir()} == {MANIFEST, *manifest.files}
    for name, entry in manifest.files.items():
        data = (checkpoint / name).read_bytes()
        assert (len(data), hashlib.sha256(data).hexdigest()) == (entry.size, entry.sha256)


def test_arrays_come_back_as_they_were(tmp_path: Path) -> None:
    """Kinds and shapes survive, scalars and empty arrays too."""
    arrays = {
        "a.b": np.arange(6, dtype=np.float32).reshape(2, 3),
        "scalar": np.array(3.5),
        "bytes": np.arange(5, dtype=np.uint8),
        "flags": np.array([True, False]),
        "none": np.zeros((0, 4), dtype=np.int64),
    }
    state = TrainingState(0, 7, 1, 2, 0.5, ("o",), ("a",), arrays, {}, {})
    directory = save_checkpoint(tmp_path / "c", TrainingSpec(), state)
    manifest = read_manifest(directory)
    found = read_file(directory, manifest, POLICY)
    require_like(directory, found, arrays)
    assert all(np.array_equal(found[name], arrays[name]) for name in arrays)
    assert read_file(directory, manifest, ENVIRONMENT) == {}


def test_a_failed_save_leaves_nothing(tmp_path: Path) -> None:
    """An error leaves neither a directory nor a partial one."""
    hostile = {"objects": np.array([object()])}
    with pytest.raises(ValueError, match=r"pickle|Object"):
        save_checkpoint(tmp_path / "c", TrainingSpec(), TrainingState(0, 0, 0, 0, 0.0, (), (), hostile, {}, {}))
    assert list(tmp_path.iterdir()) == []


def test_saving_again_replaces(tmp_path: Path) -> None:
    """A later checkpoint of the same name replaces the earlier one."""
    for value in (1.0, 2.0):
        state = TrainingState(0, 0, 0, 0, 0.0, (), (), {"x": np.array([value])}, {}, {})
        save_checkpoint(tmp_path / "c", TrainingSpec(), state)
    assert read_file(tmp_path / "c", read_manifest(tmp_path / "c"), POLICY)["x"][0] == 2.0


def test_missing_checkpoint_is_named(tmp_path: Path) -> None:
    """The message has the path and what is missing."""
    with pytest.raises(CheckpointError, match=r"nowhere: not a checkpoint \(checkpoint.json is missing\)$"):
        read_manifest(tmp_path / "nowhere")


def test_the_folder_of_a_training_names_its_newest_checkpoint(tmp_path: Path) -> None:
    for steps in (64, 128):
        state = TrainingState(0, steps, 0, 0, 0.0, (), (), {}, {}, {})
        save_checkpoint(tmp_path / f"step-{steps:012}", TrainingSpec(), state)
    with pytest.raises(CheckpointError, match=r"; use its newest one, .*/step-000000000128$"):
        read_manifest(tmp_path)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"format": 99}, "format 99 of this checkpoint is of a newer version"),
        ({"steps": -1}, "steps"),
        ({"extra": 1}, "extra"),
        ({"spec_sha256": "0" * 64}, "does not match"),
        ({"spec": {"task": "swim"}}, "spec.task"),
        ({"files": {POLICY: {"sha256": "x", "size": 1}}}, "sha256"),
        ({"files": {"../policy.npz": {"sha256": "0" * 64, "size": 1}}}, "files"),
        ({"files": {"/etc/passwd": {"sha256": "0" * 64, "size": 1}}}, "files"),
        ({"stage": 7}, "stage: 7 is not one of the 1"),
        ({"observations": ["a", "a"]}, "observations: two have the same name"),
        ({"observations": ['a"};int x = system("touch x");char*y[]={"']}, "observations.0"),
        ({"observations": ["a\n"]}, "observations.0"),
        ({"observations": ["??/"]}, "observations.0"),
        ({"actions": ["a */ int x;"]}, "actions.0"),
        ({"steps": 10**400}, "steps"),
    ],
)
def test_bad_manifest_is_refused(copy: Path, fields: dict[str, Any], words: str) -> None:
    """The message names the field."""
    edit(copy, **fields)
    with pytest.raises(CheckpointError, match=words):
        read_manifest(copy)


@pytest.mark.parametrize("text", ["", "[]", "null", "{", "\x00"])
def test_manifest_that_is_no_manifest_is_refused(copy: Path, text: str) -> None:
    """The message names the damaged file."""
    (copy / MANIFEST).write_text(text)
    with pytest.raises(CheckpointError, match=MANIFEST):
        read_manifest(copy)


def test_huge_manifest_is_not_read(copy: Path) -> None:
    """A manifest that is too large is refused."""
    (copy / MANIFEST).write_text(" " * 2_000_000)
    with pytest.raises(CheckpointError, match="too many"):
        read_manifest(copy)


def test_changed_and_cut_files_are_noticed(copy: Path) -> None:
    """A single changed bit is detected."""
    path = copy / POLICY
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(CheckpointError, match="SHA-256"):
        load_policy(copy)
    path.write_bytes(bytes(data[:-10]))
    with pytest.raises(CheckpointError, match="damaged"):
        load_policy(copy)
    path.unlink()
    with pytest.raises(CheckpointError, match=POLICY):
        load_policy(copy)


class Bomb:
    """Run something when unpickled."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        """Fail when unpickled."""
        return (_detonate, ("boom",))


def _detonate(word: str) -> None:
    raise AssertionError(word)


def test_pickles_are_never_loaded(copy: Path, tmp_path: Path) -> None:
    """Pickles are refused as files and as arrays of objects."""
    replace_file(copy, POLICY, pickle.dumps(Bomb()))
    with pytest.raises(CheckpointError, match="not a file of arrays"):
        load_policy(copy)
    objects = np.empty(1, dtype=object)
    objects[0] = Bomb()
    replace_file(copy, POLICY, npz(log_std=objects))
    with pytest.raises(CheckpointError, match="not a type of plain numbers"):
        load_policy(copy)
    del tmp_path


def test_array_that_announces_more_than_it_has_is_refused(tmp_path: Path) -> None:
    """No memory is reserved for announced but missing data."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("x.npy", header.getvalue() + b"\0" * 8)
    with pytest.raises(CheckpointError, match="announces 8000000000000 bytes"):
        read_arrays(tmp_path / "x.npz")


def test_compressed_arrays_are_refused(tmp_path: Path) -> None:
    """Compressed arrays are refused."""
    np.savez_compressed(tmp_path / "x.npz", x=np.zeros(10**6))
    with pytest.raises(CheckpointError, match="uncompressed"):
        read_arrays(tmp_path / "x.npz")


def test_arrays_that_do_not_fit_are_named() -> None:
    """Arrays that are missing, unknown, of another shape or kind, or not finite are refused."""
    expected = {"x": np.zeros(3), "y": np.zeros(2, dtype=np.int64)}
    for found, words in (
        ({"x": np.zeros(3)}, "'y' is missing"),
        ({**expected, "z": np.zeros(1)}, "'z' is unknown"),
        ({**expected, "x": np.zeros(4)}, r"'x' is float64\[4\]"),
        ({**expected, "y": np.zeros(2)}, "'y' is float64"),
        ({**expected, "x": np.array([0.0, np.nan, 0.0])}, "'x' contains numbers that are not finite"),
    ):
        with pytest.raises(CheckpointError, match=words):
            require_like(Path("here"), found, expected)


def test_policy_of_the_wrong_shape_is_refused(copy: Path) -> None:
    """A policy file that agrees with the manifest but not with the specification."""
    arrays = read_arrays(copy / POLICY)
    arrays["log_std"] = np.zeros(3, dtype=np.float32)
    replace_file(copy, POLICY, npz(**arrays))
    with pytest.raises(CheckpointError, match="log_std"):
        load_policy(copy)
    del arrays["log_std"]
    replace_file(copy, POLICY, npz(**arrays))
    with pytest.raises(CheckpointError, match="'log_std' is missing"):
        load_policy(copy)


def test_resuming_from_damage_is_refused(
    copy: Path, tmp_path: Path, make_spec: Callable[..., TrainingSpec], recorder: Any
) -> None:
    """Every file is checked before training resumes."""
    arrays = read_arrays(copy / ENVIRONMENT)
    arrays["environment.simulator"] = arrays["environment.simulator"][:, :-8]
    replace_file(copy, ENVIRONMENT, npz(**arrays))
    with pytest.raises(CheckpointError, match=r"environment\.simulator"):
        train(make_spec(total_steps=1024), workdir=tmp_path / "w", reporter=recorder, resume=copy)
