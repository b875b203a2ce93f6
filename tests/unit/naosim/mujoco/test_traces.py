"""The embedded world reproduces recordings of the real server bit for bit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from naosim import cli
from naosim.mujoco import traces
from naosim.mujoco.world import world_of
from naosim.simulator import Scene

HERE = Path(__file__).parent / "traces"
RECORDINGS = sorted(HERE.glob("*.npz"))


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_recordings_are_repeated_exactly(path: Path) -> None:
    result = traces.check(path)
    assert result["exact"] and result["first_difference"] is None
    assert set(result["differences"].values()) == {0.0}
    assert len(result["differences"]) == (12 if "ball" in traces.load(path).perceptors else 11)


@pytest.mark.parametrize("name", ["t1-flail", "k1-smooth"])
def test_a_world_with_ball_and_goals_repeats_the_others_too(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Scene(ball=True, goals=True)
    monkeypatch.setattr(traces, "world_of", lambda robot, scene: world_of(robot, scene=whole))
    assert traces.check(HERE / f"{name}.npz")["exact"]


def test_recordings_cover_falls_beams_moves_and_both_robots() -> None:
    loaded = [traces.load(path) for path in RECORDINGS]
    assert {trace.robot.name for trace in loaded} == {"t1", "k1"}
    assert any(np.isfinite(trace.beam).all(axis=1).any() for trace in loaded)
    assert any(np.isfinite(trace.move).all(axis=1).any() for trace in loaded)
    assert any((trace.perceptors["torso_pos"][:, 2] < 0.3).any() for trace in loaded)


def test_recordings_cover_balls_that_are_walked_into_at_several_speeds() -> None:
    kicks = [trace for trace in map(traces.load, RECORDINGS) if trace.name.startswith("t1-kick")]
    ball = [np.hypot(*trace.states["qvel"][:, :2].T).max() for trace in kicks]
    robot = [np.hypot(*trace.states["qvel"][:, 6:8].T).max() for trace in kicks]
    assert len(kicks) == 3
    assert (np.diff(sorted(ball)) > 1.0).all() and (np.diff(sorted(robot)) > 0.5).all()
    for trace in kicks:
        seen = np.isfinite(trace.perceptors["ball"]).all(axis=1)
        assert 0.4 < seen.mean() < 0.6, "in every other cycle"


def test_a_ball_bounces_off_a_goal_post(monkeypatch: pytest.MonkeyPatch) -> None:
    trace = traces.load(HERE / "t1-post.npz")
    assert np.isfinite(trace.ball).all(axis=1).sum() == 1
    assert trace.states["qvel"][:, 0].max() > 3.9 and trace.states["qvel"][-1, 0] < 0.0
    monkeypatch.setattr(traces, "world_of", lambda robot, scene: world_of(robot, scene=replace(scene, goals=False)))
    without = traces.check(HERE / "t1-post.npz")
    assert not without["exact"] and without["first_difference"] > 5, "the ball rolls through where there is no goal"


@pytest.mark.parametrize("kept", [True, False])
def test_a_missing_or_an_invented_ball_is_noticed(tmp_path: Path, kept: bool) -> None:
    with np.load(HERE / "t1-kick-05.npz") as archive:
        data = dict(archive)
    row = np.flatnonzero(np.isfinite(data["p_ball"][1:, 0]) == kept)[0]
    data["p_ball"][row + 1] = np.nan if kept else 1.0
    np.savez(tmp_path / "blind.npz", **data)
    result = traces.check(tmp_path / "blind.npz")
    assert result["first_difference"] == row and result["differences"]["ball"] == np.inf


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
    with pytest.raises(traces.MujocoTraceError, match=message):
        traces.check(tmp_path / "broken.npz")
