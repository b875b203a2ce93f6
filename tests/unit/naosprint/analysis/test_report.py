"""Test that a report holds what it should and needs nothing else."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import imageio_ffmpeg  # type: ignore[import-untyped]
import numpy as np
import pytest
from matplotlib.figure import Figure
from naospec import EvaluationSpec
from naosprint import evaluate, figures
from naosprint.film import HEIGHT_PX, WIDTH_PX, Film, write_gif, write_mp4
from naosprint.replay import ReplayError, load_replay
from naosprint.report import ReportError, read_metrics, write_report
from naosprint.scene import Camera, robot_collection
from PIL import Image


@pytest.fixture(scope="module")
def evaluation(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with an evaluation of a policy that falls at once."""
    folder = tmp_path_factory.mktemp("evaluation")
    evaluate(checkpoint, EvaluationSpec(episodes=6, n_envs=6)).save(folder)
    return folder


@pytest.fixture
def metrics(tmp_path: Path) -> Path:
    """Return metrics of two updates, the second of which was repeated after a resume."""
    rows = [
        {"step": 256, "time_s": 1.0, "policy_loss": 0.1},
        {"step": 512, "time_s": 2.0, "speed_mps": 0.1, "distance_m": 0.3, "fall_rate": 1.0},
        {"step": 512, "time_s": 3.0, "speed_mps": 0.2, "distance_m": 0.4, "fall_rate": 1.0},
    ]
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def test_report_is_complete_and_self_contained(evaluation: Path, metrics: Path, tmp_path: Path) -> None:
    """Every picture as SVG and PNG, every table, and a page that loads nothing."""
    out = tmp_path / "out"
    page = write_report(out, evaluation=evaluation, metrics=metrics, title="A <first> run", film=False)
    for name in ("learning-curve", "speed-profile", "trajectories", "frames", "gait", "joints"):
        assert (out / f"{name}.svg").read_text().startswith("<?xml")
        with Image.open(out / f"{name}.png") as picture:
            pixels = np.asarray(picture.convert("L"))
            assert pixels.shape[1] > 1000
            assert pixels.std() > 5, f"{name} is empty"
    html = page.read_text()
    assert html.count("<svg") == 6
    assert "A &lt;first&gt; run" in html
    # no address but the names of XML namespaces and data within the page
    outside = re.findall(r"(?:src|href)=\"(?!#|data:)[^\"]*\"", html)
    assert not outside
    summary = json.loads((evaluation / "evaluation.json").read_text())
    assert f"{summary['distance_m']['mean']:.2f} m" in html
    assert "100.0%" in html
    with (out / "trajectories.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert {row["episode"] for row in rows} == {str(i) for i in range(6)}
    with (out / "learning-curve.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["step"] for row in rows] == ["256.0", "512.0"]
    assert rows[1]["speed_mps"] == "0.2"
    assert json.loads((out / "report.json").read_text())["evaluation"] == summary


def test_same_input_gives_the_same_pictures(evaluation: Path, tmp_path: Path) -> None:
    """No dates and no random identifiers, so that a record can be compared with an older one."""
    for name in ("first", "second"):
        write_report(tmp_path / name, evaluation=evaluation, film=False)
    assert (tmp_path / "first/gait.svg").read_bytes() == (tmp_path / "second/gait.svg").read_bytes()
    assert not (tmp_path / "first/learning-curve.svg").exists()


def test_films_play(evaluation: Path, tmp_path: Path) -> None:
    """An MP4 in real time and a GIF of half its size."""
    replay = load_replay(evaluation / "replay.json")
    write_mp4(replay, tmp_path / "run.mp4", frames=range(10))
    pictures, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "run.mp4"))
    assert (pictures, seconds) == (10, pytest.approx(0.2, abs=0.02))
    write_gif(replay, tmp_path / "run.gif", frames=range(10))
    with Image.open(tmp_path / "run.gif") as film:
        assert film.size == (WIDTH_PX // 2, HEIGHT_PX // 2)
        assert film.info["duration"] == 40
        assert 1 < film.n_frames <= 5  # type: ignore[attr-defined]


def test_film_follows_the_robot(evaluation: Path) -> None:
    """The picture changes from cycle to cycle, and the robot stays in it."""
    replay = load_replay(evaluation / "replay.json")
    film = Film(replay)
    first, later = film.picture(0), film.picture(8)
    assert first.shape == (HEIGHT_PX, WIDTH_PX, 3)
    assert not np.array_equal(first, later)
    middle = first[60:, WIDTH_PX // 3 : 2 * WIDTH_PX // 3]
    assert (middle.std(axis=2) > 30).sum() > 500, "no coloured limb in the middle"


def test_robot_stands_on_the_ground_seen_from_the_side(evaluation: Path) -> None:
    """Seen from its right, level, a robot that faces +x reaches from the ground to its head and looks to the right."""
    replay = load_replay(evaluation / "replay.json")
    drawing = robot_collection(replay, 0, Camera(azimuth_deg=0.0, elevation_deg=0.0))
    points = np.concatenate([path.vertices for path in drawing.get_paths()])
    assert points[:, 1].min() == pytest.approx(0.0, abs=0.02)
    assert 0.5 < points[:, 1].max() < 0.62
    # feet are longer to the front
    low = points[points[:, 1] < 0.03]
    assert low[:, 0].max() > -low[:, 0].min()


def test_stride_reaches_from_touchdown_to_touchdown() -> None:
    """Of the foot asked for, after the time asked for."""
    force = np.where(np.arange(200) % 20 < 8, 40.0, 0.0)
    assert figures.stride(force, 50, 4) == [60, 65, 70, 75]
    assert figures.stride(np.zeros(200), 50, 5) == [50, 55, 60, 65, 70]


def test_figures_bear_what_no_episode_supports() -> None:
    """A line without a mean is left out, not drawn."""
    nothing = {"mean": None, "ci": None, "max": None}
    figure = figures.speed_profile([{"line_m": 0.0, "paper": nothing, "all": nothing}], 0.95)
    assert isinstance(figure, Figure)


@pytest.mark.parametrize("text", ["{", '{"step": "many"}', '{"time_s": 1}', "[1]"])
def test_damaged_metrics_are_explained(tmp_path: Path, text: str) -> None:
    """The message names file and line."""
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1}\n' + text + "\n")
    with pytest.raises(ReportError, match=r"metrics.jsonl: line 2: not a row of metrics"):
        read_metrics(path)


def test_missing_evaluation_is_explained(evaluation: Path, tmp_path: Path) -> None:
    """Whichever file is not there."""
    with pytest.raises(ReportError, match="no complete evaluation"):
        write_report(tmp_path / "out", evaluation=tmp_path)
    for name in ("evaluation.json", "trajectories.npz"):
        (tmp_path / name).write_bytes((evaluation / name).read_bytes())
    with pytest.raises(ReplayError, match=r"replay.json: unreadable"):
        write_report(tmp_path / "out", evaluation=tmp_path)
    (tmp_path / "evaluation.json").write_text("{}")
    with pytest.raises(ReportError, match=r"evaluation.json: training: missing"):
        write_report(tmp_path / "out", evaluation=tmp_path)
