"""Segments of trainings, trained again: the same bits, or what differs by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from naospec import TrainingSpec
from naosprint import CheckpointError, train
from naosprint.__main__ import main
from naosprint.rl.checkpoint import (
    ENVIRONMENT,
    LEARNER,
    POLICY,
    TrainingState,
    read_file,
    read_manifest,
    save_checkpoint,
)
from naosprint.rl.reporter import NullReporter
from naosprint.rl.verification import last_two, verify

Make = Callable[..., TrainingSpec]


def test_a_segment_has_the_same_bits_again(make_spec: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Between two checkpoints of a training, over the border of a stage, and up to where it was stopped."""
    stages = [{"steps": 512}, {"steps": 512, "seed": 9, "algorithm": {"learning_rate": 2e-4}}]
    spec = make_spec(stages=stages, checkpoint_interval_steps=256)
    steps = iter(range(10**6))
    stopped = train(spec, workdir=tmp_path, reporter=NullReporter(), stop=lambda: next(steps) > 3 * 32 + 5)
    assert (stopped.status, stopped.steps) == ("stopped", 768)
    found = verify(tmp_path / "step-000000000256", stopped.checkpoint)
    assert found.differing == () and found.versions == () and found.steps == (256, 768)
    assert set(found.arrays) == {POLICY, LEARNER, ENVIRONMENT} and min(found.arrays.values()) > 5
    assert last_two(tmp_path) == (tmp_path / "step-000000000512", stopped.checkpoint)
    assert main(["verify", str(tmp_path)]) == 0
    assert "is exactly what 256 steps" in capsys.readouterr().out


def test_one_bit_and_another_version_are_named(
    make_spec: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = make_spec(checkpoint_interval_steps=256)
    end = train(spec, workdir=tmp_path, reporter=NullReporter()).checkpoint
    manifest = read_manifest(end)
    policy, learner, environment = (read_file(end, manifest, name) for name in (POLICY, LEARNER, ENVIRONMENT))
    changed = next(name for name, array in policy.items() if array.dtype.kind == "f" and array.size > 1)
    policy[changed] = policy[changed].copy()
    policy[changed].flat[1] = np.nextafter(policy[changed].flat[1], np.inf, dtype=policy[changed].dtype)
    monkeypatch.setattr("naosprint.rl.checkpoint.installed_versions", lambda: {"torch": "0.1"})
    fields = {name: getattr(manifest, name) for name in TrainingState.__slots__ if hasattr(manifest, name)}
    state = TrainingState(**fields, policy=policy, learner=learner, environment=environment)
    forged = save_checkpoint(tmp_path / "forged", spec, replace(state))
    assert main(["verify", str(tmp_path / "step-000000000256"), str(forged)]) == 1
    printed = capsys.readouterr()
    assert f"DIFFERENT: {changed}\n" in printed.out and "is not what" in printed.out
    assert "warning: another version: torch: 0.1, now 2" in printed.err


def test_what_is_no_segment_is_refused(make_spec: Make, tmp_path: Path) -> None:
    spec = make_spec(checkpoint_interval_steps=256)
    end = train(spec, workdir=tmp_path / "a", reporter=NullReporter()).checkpoint
    middle = end.parent / "step-000000000256"
    other = train(make_spec(seed=2), workdir=tmp_path / "b", reporter=NullReporter()).checkpoint
    for earlier, later, message in (
        (end, middle, "has 256 steps, not more than"),
        (middle, other, "seed"),
        (middle, tmp_path, "not a checkpoint"),
    ):
        with pytest.raises(CheckpointError, match=message):
            verify(earlier, later)
    with pytest.raises(CheckpointError, match="not a folder with two checkpoints"):
        last_two(end)
    manifest = read_manifest(end)
    policy, learner, environment = (read_file(end, manifest, name) for name in (POLICY, LEARNER, ENVIRONMENT))
    fields = {name: getattr(manifest, name) for name in TrainingState.__slots__ if hasattr(manifest, name)}
    state = TrainingState(**fields, policy=policy, learner=learner, environment=environment, others=(learner,))
    shared = save_checkpoint(tmp_path / "shared", spec, state)
    with pytest.raises(CheckpointError, match="shared: trained by 2 processes; only one is verified"):
        verify(middle, shared)
