"""The embedded world reproduces recordings of the real server bit for bit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from naosim import cli
from naosim.mujoco import traces

HERE = Path(__file__).parent / "traces"
RECORDINGS = sorted(HERE.glob("*.npz"))


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_recordings_are_repeated_exactly(path: Path) -> None:
    result = traces.check(path)
    assert result["exact"] and result["first_difference"] is None
    assert set(result["differences"].values()) == {0.0}
    assert len(result["differences"]) == 11


def test_recordings_cover_falls_beams_moves_and_both_robots() -> None:
    loaded = [traces.load(path) for path in RECORDINGS]
    assert {trace.robot.name for trace in loaded} == {"t1", "k1"}
    assert any(np.isfinite(trace.beam).all(axis=1).any() for trace in loaded)
    assert any(np.isfinite(trace.move).all(axis=1).any() for trace in loaded)
    assert any((trace.perceptors["torso_pos"][:, 2] < 0.3).any() for trace in loaded)


def test_a_cold_solver_is_noticed(tmp_path: Path) -> None:
    with np.load(HERE / "t1-flail.npz") as archive:
        data = dict(archive)
    data["qacc_warmstart"][0] = 0.0
    np.savez(tmp_path / "cold.npz", **data)
    result = traces.check(tmp_path / "cold.npz")
    assert not result["exact"] and result["first_difference"] == 0
    assert 0.0 < result["differences"]["qpos"] < 1e-3


def test_the_command_line_reports_differences(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", "--json", str(HERE / "t1-beam.npz")]) == 0
    assert json.loads(capsys.readouterr().out)[0]["exact"]
    nao = Path(__file__).parents[1] / "traces" / "pose-0.npz"
    assert cli.main(["check", str(HERE / "t1-beam.npz"), str(nao)]) == 0
    printed = capsys.readouterr().out
    assert "t1-beam" in printed and "pose-0" in printed
    (tmp_path / "bad.npz").write_bytes(b"no")
    assert cli.main(["check", str(tmp_path / "bad.npz")]) == 2
    assert "bad.npz" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data.pop("qvel"), "field 'qvel' is missing"),
        (lambda data: data.update(qpos=data["qpos"][:-1]), "field 'qpos' must be float64 of shape"),
        (lambda data: data.update(meta=np.array("{}")), "field 'meta' is not usable"),
        (lambda data: data["command"].fill(np.nan), "not finite"),
    ],
)
def test_unusable_recordings_are_named(tmp_path: Path, change: object, message: str) -> None:
    with np.load(HERE / "t1-beam.npz") as archive:
        data = dict(archive)
    change(data)  # type: ignore[operator]
    np.savez(tmp_path / "broken.npz", **data)
    with pytest.raises(traces.TraceError, match=message):
        traces.check(tmp_path / "broken.npz")
