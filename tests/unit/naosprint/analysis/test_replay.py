"""Replays contain the recorded poses."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naosim import robots
from naosprint.analysis.replay import Replay, ReplayError, load_replay


def some_replay(frames: int = 4) -> Replay:
    """Return a replay of random poses."""
    rng = np.random.default_rng(0)
    robot = robots.get("nao-0")
    poses = rng.normal(size=(frames, len(robot.shapes), 7)).astype(np.float32)
    poses[:, :, 3:7] /= np.linalg.norm(poses[:, :, 3:7], axis=2, keepdims=True)
    forces = rng.uniform(0, 100, (frames, 2)).astype(np.float32)
    return Replay(robot, poses[:, :, :3], poses[:, :, 3:], forces, end="Arrival", failed=False)


def test_round_trip(tmp_path: Path) -> None:
    """Both files contain the episode, to a tenth of a millimetre."""
    replay = some_replay()
    text, arrays = replay.save(tmp_path)
    again = load_replay(text)
    np.testing.assert_allclose(again.positions, replay.positions, atol=6e-5)
    np.testing.assert_allclose(again.rotations, replay.rotations, atol=6e-5)
    np.testing.assert_allclose(again.foot_forces, replay.foot_forces, atol=0.06)
    assert (again.robot, again.end, again.failed) == (replay.robot, "Arrival", False)
    assert again.moved_m() == pytest.approx(np.hypot(*replay.displacement_m), abs=2e-4)
    with np.load(arrays, allow_pickle=False) as saved:
        np.testing.assert_array_equal(saved["positions"], replay.positions)
        assert tuple(saved["body_names"]) == tuple(shape.name for shape in replay.robot.shapes)


def test_document_explains_itself(tmp_path: Path) -> None:
    """A player needs no other table: names, shapes, sizes and times are in it."""
    document = json.loads(some_replay(3).to_json())
    assert document["frames"] == len(document["position_m"]) == len(document["rotation_wxyz"]) == 3
    assert document["dt_s"] == 0.02
    assert document["bodies"][0] == {"name": "torso", "shape": "box", "size_m": [0.1, 0.1, 0.18], "side": "centre"}
    assert len(document["position_m"][0]) == 3 * len(document["bodies"])
    assert len(document["rotation_wxyz"][0]) == 4 * len(document["bodies"])


def _drop(name: str) -> Callable[[dict[str, Any]], object]:
    return lambda document: document.pop(name)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_drop("position_m"), "position_m: missing"),
        (lambda d: d.update(format=99), "format 2"),
        (lambda d: d.update(robot="nao-4"), "bodies: not those of robot nao-4"),
        (lambda d: d.update(frames=1000), "unreadable"),
        (lambda d: d["position_m"][0].__setitem__(0, float("nan")), "positions: .*not finite"),
        (lambda d: d.update(robot="nao-77"), "unknown robot 'nao-77'"),
    ],
)
def test_damaged_replay_is_explained(tmp_path: Path, spoil: Callable[[dict[str, Any]], object], words: str) -> None:
    """The message names the file and the field."""
    document = json.loads(some_replay().to_json())
    spoil(document)
    path = tmp_path / "replay.json"
    path.write_text(json.dumps(document))
    with pytest.raises(ReplayError, match=words) as caught:
        load_replay(path)
    assert str(path) in str(caught.value)


def test_missing_replay_is_explained(tmp_path: Path) -> None:
    """So is a file that is not JSON."""
    with pytest.raises(ReplayError, match="unreadable"):
        load_replay(tmp_path / "replay.json")
    (tmp_path / "replay.json").write_text("[")
    with pytest.raises(ReplayError, match="unreadable"):
        load_replay(tmp_path / "replay.json")
