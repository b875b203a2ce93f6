"""Checkpoints and arrays that somebody made to do harm: an error of ours, soon, in little memory.

`make fuzz` runs the mutations for longer: FUZZ_S is how long, FUZZ_SEED where they begin.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import random
import shutil
import struct
import time
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naosim.mujoco.traces import MujocoTraceError as MujocoTraceError
from naosim.mujoco.traces import is_recording
from naosim.mujoco.traces import load as load_mujoco_trace
from naosim.npz import read_npz
from naosim.simspark.traces import NaoTraceError
from naosim.simspark.traces import load as load_trace
from naosprint.analysis.report import ReportError, read_metrics
from naosprint.export import build_header
from naosprint.rl.checkpoint import MANIFEST, POLICY, CheckpointError, read_arrays, read_manifest, verify_checkpoint
from naosprint.rl.policy import load_policy

FUZZ_S = float(os.environ.get("FUZZ_S", "2"))
FUZZ_SEED = int(os.environ.get("FUZZ_SEED", "0"))


@pytest.fixture
def copy(checkpoint: Path, tmp_path: Path) -> Path:
    """Return a checkpoint to damage."""
    return Path(shutil.copytree(checkpoint, tmp_path / "copy"))


def sign(directory: Path, manifest: Any = None) -> None:
    """Make sizes and sums of a manifest right, as an attacker would."""
    manifest = manifest if manifest is not None else json.loads((directory / MANIFEST).read_text(encoding="utf-8"))
    if isinstance(manifest, dict):
        data = (directory / POLICY).read_bytes()
        if isinstance(manifest.get("files"), dict):
            manifest["files"][POLICY] = {"sha256": hashlib.sha256(data).hexdigest(), "size": len(data)}
        if isinstance(manifest.get("spec"), dict):
            spec = {name: value for name, value in manifest["spec"].items() if name != "runtime"}
            text = json.dumps(spec, sort_keys=True, separators=(",", ":"))
            manifest["spec_sha256"] = hashlib.sha256(text.encode()).hexdigest()
    (directory / MANIFEST).write_text(json.dumps(manifest), encoding="utf-8")


def array_file(path: Path, header: str, data: bytes = b"\0" * 64) -> None:
    """Write a file with one array whose header is any text."""
    text = header.encode("latin1")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data)


def nested_file(path: Path, entries: int, size: int = 1_000_000, method: int = zipfile.ZIP_STORED) -> None:
    """Write a file whose directory names the same bytes many times."""
    body = io.BytesIO()
    np.lib.format.write_array(body, np.zeros(size, np.uint8), version=(1, 0))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        archive.writestr("a0000.npy", body.getvalue())
    data = stream.getvalue()
    start = data.index(b"PK\x01\x02")
    entry = data[start : data.index(b"PK\x05\x06", start)]
    directory = b"".join(entry.replace(b"a0000", f"a{i:04}".encode()) for i in range(entries))
    end = struct.pack("<4s4H2IH", b"PK\x05\x06", 0, 0, entries, entries, len(directory), start, 0)
    path.write_bytes(data[:start] + directory + end)


def peak_of(call: Callable[[], object]) -> int:
    """Return the most memory that a call has used, bytes."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("entries", [2, 300, 1001, 60_000])
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_members_that_share_their_bytes_are_refused(entries: int, method: int, tmp_path: Path) -> None:
    """A small file does not become a large one in memory."""
    path = tmp_path / "x.npz"
    nested_file(path, entries, method=method)

    def read() -> None:
        with pytest.raises(CheckpointError):
            read_arrays(path)
        with pytest.raises(ValueError, match=r"too many|more than|not a|Overlapped|differ"):
            read_npz(path, max_bytes=1_500_000)

    assert peak_of(read) < 8_000_000
    assert not is_recording(path)
    for load, error in ((load_trace, NaoTraceError), (load_mujoco_trace, MujocoTraceError)):
        with pytest.raises(error):
            load(path)


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (True, 3)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 3)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (0, 99999999999999999999)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': 3}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1.0,)}",
        "{'descr': '<U0', 'fortran_order': False, 'shape': (9999999999,)}",
        "{'descr': [('a', 'O')], 'fortran_order': False, 'shape': ()}",
        "{'descr': '<f8,<f8', 'fortran_order': False, 'shape': ()}",
        "{'descr': None, 'fortran_order': False, 'shape': ()}",
        "(" * 5000,
        "[" * 100 + "]" * 100,
        "{'descr': ",
        "\0",
        "__import__('os').abort()",
    ],
)
def test_headers_of_arrays_are_checked(header: str, tmp_path: Path) -> None:
    """Shapes are tuples of numbers, and whatever the parsers raise is an error of ours."""
    array_file(tmp_path / "x.npz", header)
    with pytest.raises(CheckpointError, match="not a file of arrays"):
        read_arrays(tmp_path / "x.npz")


@pytest.mark.parametrize("place", ["directory", "member", "header"])
def test_what_a_file_says_makes_no_long_error(place: str, tmp_path: Path) -> None:
    """The parsers' errors repeat names and headers of the file, which may have 64 KB each."""
    path, name = tmp_path / "policy.npz", "n" * 60_000
    if place == "header":
        array_file(path, "{" + "'x'" * 20_000 + "}")
    else:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(name + (".npy" if place == "directory" else ""), b"")
    if place == "directory":
        data = path.read_bytes()
        path.write_bytes(data.replace(b"n", b"m", 1))
    with pytest.raises(CheckpointError, match="not a file of arrays") as caught:
        read_arrays(path)
    assert len(str(caught.value)) < 1_000


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"a":' * 100_000, "9" * 10_000, '"\\ud800"', "NaN", "1e999", "\ufeff{}"]
)
def test_manifests_that_are_hard_to_parse_are_refused(text: str, copy: Path) -> None:
    """Deep, long and odd JSON."""
    (copy / MANIFEST).write_text(text, encoding="utf-8")
    with pytest.raises(CheckpointError, match=MANIFEST):
        read_manifest(copy)
    (copy / "metrics.jsonl").write_text(f'{{"step": 1}}\n{text}\n', encoding="utf-8")
    with pytest.raises(ReportError, match="line 2"):
        read_metrics(copy / "metrics.jsonl")


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
@pytest.mark.parametrize("name", [MANIFEST, POLICY])
def test_what_is_no_regular_file_is_not_read(kind: str, name: str, copy: Path) -> None:
    """A pipe would wait for ever, a device never end."""
    (copy / name).unlink()
    if kind == "pipe":
        os.mkfifo(copy / name)
    elif kind == "device":
        (copy / name).symlink_to("/dev/zero")
    else:
        (copy / name).mkdir()
    with pytest.raises(CheckpointError, match="not a regular file"):
        load_policy(copy)
    for read, error in ((read_metrics, ReportError), (load_trace, NaoTraceError)):
        with pytest.raises(error, match="not a regular file"):
            read(copy / name)


ODD: tuple[Any, ...] = (
    *(
        None,
        True,
        -1,
        0,
        7,
        2**63,
        10**400,
        1e308,
        "",
        "x",
        "\ud800",
        "\x00",
        "a" * 70,
        '";int x;//',
        "../x",
        "9" * 5000,
    ),
    *([], {}, [[]], {"": ""}, [None] * 3, {"name": []}, [True], [{"steps": 1}] * 40),
)


def mutate_document(rng: random.Random, value: Any) -> Any:
    """Return a document with one value replaced, repeated or removed."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        name = rng.choice(sorted(value))
        if rng.random() < 0.1:
            return {key: entry for key, entry in value.items() if key != name}
        if rng.random() < 0.05:
            return {**value, str(rng.choice(ODD)): rng.choice(ODD)}
        return {**value, name: mutate_document(rng, value[name])}
    if isinstance(value, list) and value and rng.random() < 0.8:
        at = rng.randrange(len(value))
        return [*value[:at], mutate_document(rng, value[at]), *value[at + rng.randint(0, 1) :]]
    return rng.choice(ODD)


def mutate_bytes(rng: random.Random, data: bytes) -> bytes:
    """Return data with some bytes changed, mostly where the structure of the file is."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        # heads of members, and the directory at the end
        near = rng.choice(
            [0, len(data) - 1, data.rfind(b"PK\x01\x02"), data.find(b"PK\x03\x04", rng.randrange(len(data)))]
        )
        at = min(len(changed) - 1, max(0, near + rng.randint(-80, 200)))
        changed[at] = rng.choice([0, 1, 0x7F, 0xFF, rng.randrange(256)])
    if rng.random() < 0.1:
        del changed[rng.randrange(len(changed)) :]
    return bytes(changed)


@pytest.mark.parametrize("of", ["manifest", "arrays"])
def test_mutated_checkpoints_load_or_are_refused(of: str, copy: Path) -> None:
    """Nothing but a CheckpointError, and what loads is exported as a header."""
    manifest = json.loads((copy / MANIFEST).read_text(encoding="utf-8"))
    weights = (copy / POLICY).read_bytes()
    end, seed, refused, loaded = time.monotonic() + FUZZ_S / 2, FUZZ_SEED, 0, 0
    while time.monotonic() < end or refused < 20:
        rng = random.Random(seed)
        document = manifest
        if of == "manifest":
            for _ in range(rng.randint(1, 3)):
                document = mutate_document(rng, document)
        else:
            (copy / POLICY).write_bytes(mutate_bytes(rng, weights))
        sign(copy, json.loads(json.dumps(document)))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                policy, read = load_policy(copy)
                verify_checkpoint(copy)
            build_header(policy, read)
            loaded += 1
        except CheckpointError as error:
            assert len(str(error)) < 20_000, f"seed {seed}"
            refused += 1
        except Exception as error:
            raise AssertionError(f"seed {seed}: {error!r}") from error
        seed += 1
    assert loaded, "every mutation was refused: the mutations are too coarse"
