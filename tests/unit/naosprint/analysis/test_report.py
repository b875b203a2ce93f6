"""A report is complete and self-contained."""

from __future__ import annotations

import csv
import json
import re
import resource
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg  # type: ignore[import-untyped]
import naopolicies
import numpy as np
import pytest
from matplotlib.figure import Figure
from naosim.fields import RCSSSERVER3D, RCSSSERVERMJ, Field
from naospec import EvaluationSpec, TrainingSpec
from naospec.metrics import Chart, Metric, Reference
from naosprint import evaluate
from naosprint.analysis import figures
from naosprint.analysis.film import HEIGHT_PX, WIDTH_PX, Film, write_gif, write_mp4
from naosprint.analysis.replay import ReplayError, load_replay
from naosprint.analysis.report import (
    FILM_STEPS,
    ReportError,
    _cell,
    film_caption,
    film_frames,
    read_metrics,
    write_report,
)
from naosprint.analysis.results import by_name, interval_text, value_text
from naosprint.analysis.scene import Camera, robot_collection
from naosprint.console import ConsoleReporter
from naosprint.tasks.sprint import Sprint1
from PIL import Image


@pytest.fixture(scope="module")
def evaluation(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with an evaluation of a policy that stands."""
    folder = tmp_path_factory.mktemp("evaluation")
    evaluate(checkpoint, EvaluationSpec(episodes=6, n_envs=6)).save(folder)
    return folder


@pytest.fixture
def metrics(tmp_path: Path) -> Path:
    """Return metrics of two updates, the second of which was repeated after a resume."""
    rows = [
        {"step": 256, "time_s": 1.0, "policy_loss": 0.1, "reward": 1.0},
        {"step": 512, "time_s": 2.0, "speed_mps": 0.1, "distance_m": 0.3, "fall_rate": 1.0},
        {"step": 512, "time_s": 3.0, "speed_mps": 0.2, "distance_m": 0.4, "fall_rate": 1.0, "reward": 2.0},
    ]
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def test_report_is_complete_and_self_contained(evaluation: Path, metrics: Path, tmp_path: Path) -> None:
    """Every picture as SVG and PNG, every table, and a page that loads nothing."""
    out = tmp_path / "out"
    page = write_report(out, evaluation=evaluation, metrics=metrics, title="A <first> run", film=False)
    for name in ("learning-curve", "speed-by-line", "trajectories", "frames", "gait", "joints"):
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
    assert f"{by_name(summary)['distance_m']['value']:.2f} m" in html
    assert "100.0 %" in html
    assert "Run challenge score" in html
    with (out / "results.csv").open() as stream:
        found = {row["name"]: row["value"] for row in csv.DictReader(stream)}
    assert float(found["distance_m"]) == by_name(summary)["distance_m"]["value"]
    with (out / "speed-by-line.csv").open() as stream:
        assert [row["at"] for row in csv.DictReader(stream)] == ["0.0", "0.5", "1.0", "1.5", "2.0", "2.5"] * 2
    with (out / "trajectories.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert {row["episode"] for row in rows} == {str(i) for i in range(6)}
    with (out / "learning-curve.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["step"] for row in rows] == ["256.0", "512.0"]
    assert rows[1]["speed_mps"] == "0.2"
    assert json.loads((out / "report.json").read_text())["evaluation"] == summary


def test_a_report_has_nothing_of_the_one_before_in_its_folder(evaluation: Path, metrics: Path, tmp_path: Path) -> None:
    out, fresh = tmp_path / "out", tmp_path / "fresh"
    write_report(out, evaluation=evaluation, metrics=metrics)
    (out / "notes.txt").touch()
    names = {path.name for path in out.iterdir()}
    for folder in (out, fresh):
        write_report(folder, evaluation=evaluation, film=False)
    left = {path.name for path in fresh.iterdir()}
    assert names - left == {
        *("run.mp4", "run.gif", "notes.txt"),
        *(f"learning-curve.{kind}" for kind in ("csv", "png", "svg")),
    }
    assert {path.name for path in out.iterdir()} == left | {"notes.txt"}


def test_same_input_gives_the_same_pictures(evaluation: Path, tmp_path: Path) -> None:
    """No dates and no random identifiers, so that a record can be compared with an older one."""
    for name in ("first", "second"):
        write_report(tmp_path / name, evaluation=evaluation, film=False)
    assert (tmp_path / "first/gait.svg").read_bytes() == (tmp_path / "second/gait.svg").read_bytes()
    assert not (tmp_path / "first/learning-curve.svg").exists()


def test_a_film_that_does_not_fit_is_an_error(evaluation: Path, tmp_path: Path) -> None:
    replay = load_replay(evaluation / "replay.json")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
    try:
        with pytest.raises(OSError, match=r"run\.mp4: "):
            write_mp4(replay, tmp_path / "run.mp4", frames=range(10))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


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


def test_a_film_of_25_seconds_is_drawn_in_less(evaluation: Path) -> None:
    """A picture takes few milliseconds of processor time, so that a report takes less than 30 s."""
    film = Film(load_replay(evaluation / "replay.json"))
    film.picture(0)

    def took(frame: int) -> float:
        began = time.process_time()
        film.picture(frame)
        return time.process_time() - began

    # The fastest ones: other tests, which share a core's caches, slow down the others.
    assert sum(sorted(took(frame) for frame in range(40))[:5]) / 5 * FILM_STEPS < 25.0


def test_the_page_shows_the_reward_and_fits_dark_and_narrow_screens(
    evaluation: Path, metrics: Path, tmp_path: Path
) -> None:
    page = write_report(tmp_path / "out", evaluation=evaluation, metrics=metrics, film=False).read_text()
    learning = page[page.index("Learning curves") : page.index("Means of the latest")]
    assert "<!-- Reward -->" in learning, "the axes have no such title"
    assert "prefers-color-scheme: dark" in page
    assert "max-width: 40rem" in page
    assert "color-scheme: light dark" in page


def test_film_follows_the_robot(evaluation: Path) -> None:
    """The picture changes from cycle to cycle, and the robot stays in it."""
    replay = load_replay(evaluation / "replay.json")
    film = Film(replay)
    first, later = film.picture(0), film.picture(8)
    assert first.shape == (HEIGHT_PX, WIDTH_PX, 3)
    assert not np.array_equal(first, later)
    middle = first[60:, WIDTH_PX // 3 : 2 * WIDTH_PX // 3]
    assert (middle.std(axis=2) > 30).sum() > 500, "no coloured limb in the middle"


@pytest.mark.parametrize("x", [0.0, RCSSSERVER3D.length_m / 2, RCSSSERVERMJ.length_m / 2])
def test_film_draws_the_field_of_the_league(evaluation: Path, x: float) -> None:
    """Near a goal line one of the two fields has lines, in the middle both have."""
    replay = load_replay(evaluation / "replay.json")
    moved = replay.positions + np.array([x - replay.positions[0, 0, 0], -replay.positions[0, 0, 1], 0.0], np.float32)

    def chalk(field: Field) -> int:
        there = replace(replay, robot=replace(replay.robot, field=field), positions=moved)
        return int((Film(there).picture(0)[HEIGHT_PX // 2 :] == 255).all(axis=2).sum())

    nothing = replace(RCSSSERVER3D, length_m=500.0, width_m=500.0, areas_m=(), circle_radius_m=200.0)
    assert chalk(RCSSSERVER3D) != chalk(RCSSSERVERMJ)
    for field in (RCSSSERVER3D, RCSSSERVERMJ):
        assert (chalk(field) > chalk(nothing)) == (x in (0.0, field.length_m / 2))


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
    """The stride is of the requested foot, after the requested time."""
    force = np.where(np.arange(200) % 20 < 8, 40.0, 0.0)
    other = np.roll(force, 10)
    assert figures.stride(force, other, 50, 4) == [60, 65, 70, 75]
    assert figures.stride(np.zeros(200), np.zeros(200), 50, 5) == [50, 55, 60, 65, 70]
    force[63] = 0.0  # it bounces
    assert figures.stride(force, other, 50, 4) == [60, 65, 70, 75]
    assert figures.stride(force, other, 50, 30) == list(range(60, 80)), "a step is drawn twice"


def test_plots_leave_out_what_no_episode_supports() -> None:
    """A value of None is left out, not drawn."""
    nothing = {"value": None, "interval": None, "high": None, "low": None}
    table = {
        "axis": {"title": "Line", "unit": "m", "digits": 1},
        "at": [0.0],
        "columns": [{"title": "All", "results": [nothing]}],
    }
    assert isinstance(figures.result_table(table), Figure)


def test_learning_curves_are_those_of_the_tasks_charts() -> None:
    """A panel per chart that has data, percent as such, the references and the evaluated policy in it."""
    rows = [
        {"step": 1e6, "stage": 1.0, "hops": 2.0, "miss_rate": 0.5},
        {"step": 2e6, "stage": 2.0, "hops": 3.0, "miss_rate": 0.25},
    ]
    metrics = {
        "hops": Metric("hops", "Hops", "1/s"),
        "miss_rate": Metric("miss_rate", "Misses", "%", kind="rate"),
        "never": Metric("never", "Never"),
    }
    charts = [Chart("Hopping", ("hops",)), Chart("Nothing", ("never",)), Chart("Misses", ("miss_rate",))]
    figure = figures.learning_curves(
        rows, charts, metrics, [Reference("hops", 4.0, "a hare")], (2e6, {"hops": 3.5, "miss_rate": 0.2})
    )
    hopping, misses = figure.axes
    assert (hopping.get_title(), misses.get_title()) == ("Hopping", "Misses")
    curves = [list(line.get_ydata()) for line in hopping.lines]  # type: ignore[union-attr]
    assert curves[:3] == [[2.0, 3.0], [3.5], [4.0, 4.0]]
    assert [text.get_text() for text in hopping.texts] == ["a hare"]
    assert list(misses.lines[0].get_ydata()) == [50.0, 25.0]  # type: ignore[union-attr]
    # the border between the stages
    assert list(hopping.lines[-1].get_xdata()) == [2.0, 2.0]
    assert misses.get_ylabel() == "%"


def test_film_and_caption_agree(evaluation: Path) -> None:
    """The numbers below the film are those of its last picture; the caption states if the episode is longer."""
    replay = load_replay(evaluation / "replay.json")
    short = replace(replay, positions=replay.positions[:80], rotations=replay.rotations[:80], end="Fall", failed=True)
    text = Film(short).caption(79)
    seconds, distance = text.split()[0], text.split()[2]
    assert f"{distance} m from the start in {seconds} s, fall. Lines" in film_caption(short)
    assert "episodes by distance:" in film_caption(short)
    assert "episodes by final height:" in film_caption(short, repeats=False)
    assert len(replay.positions) > FILM_STEPS
    assert "in 60.00 s, time limit. The film shows the first 24.98 s" in film_caption(replay)
    assert replay.moved_m(0, FILM_STEPS - 1) == pytest.approx(_shown_distance(Film(replay), FILM_STEPS - 1), abs=0.01)


def test_a_run_over_the_whole_course_is_filmed_to_its_end(evaluation: Path, tmp_path: Path) -> None:
    """The film has as many pictures as the caption has time: 21.28 s at 50 pictures a second."""
    replay = load_replay(evaluation / "replay.json")
    steps = 1065
    run = replace(replay, positions=replay.positions[:steps], rotations=replay.rotations[:steps], end="Arrival")
    assert "in 21.28 s, arrival. Lines" in film_caption(run)
    assert len(film_frames(run)) == steps


def test_the_gait_of_a_fallen_episode_says_so(evaluation: Path, metrics: Path, tmp_path: Path) -> None:
    replay = load_replay(evaluation / "replay.json")
    folder = tmp_path / "fallen"
    shutil.copytree(evaluation, folder)
    (folder / "replay.json").write_text(replace(replay, end="Fall", failed=True).to_json())
    page = write_report(tmp_path / "out", evaluation=folder, metrics=metrics, film=False).read_text()
    assert f"The episode ended after {replay.duration_s:.2f} s: fall." in page
    assert "The episode ended" not in write_report(tmp_path / "up", evaluation=evaluation, film=False).read_text()


def test_a_report_of_another_robot_has_nothing_of_the_paper(evaluation: Path, metrics: Path, tmp_path: Path) -> None:
    """A NAO's results, lines and rules are no measure of a T1, not even in documents that an earlier version wrote."""
    folder = tmp_path / "t1"
    limits = EvaluationSpec(episodes=2, trajectories=2, bootstrap_resamples=100, engine="fast")
    evaluate(naopolicies.folder("t1-sprint"), limits).save(folder)
    path = folder / "evaluation.json"
    summary = json.loads(path.read_text())
    own = {metric.name for metric in Sprint1.results if metric.families == ("nao",)}
    assert (
        own
        and not own & set(by_name(summary))
        and own <= set(by_name(json.loads((evaluation / path.name).read_text())))
    )
    earlier = by_name(json.loads((evaluation / path.name).read_text()))
    path.write_text(json.dumps({**summary, "results": [*summary["results"], earlier["low_at_end"]]}))
    page = write_report(tmp_path / "out", evaluation=folder, metrics=metrics, film=False).read_text()
    assert "28 m, finish" in page and not re.search(r"paper|3\.91 m|low at the end|challenge", page, re.IGNORECASE)
    nao = write_report(tmp_path / "nao", evaluation=evaluation, metrics=metrics, film=False).read_text()
    assert "3.91 m/s, the paper" in nao and "Low at the end" in nao


def _shown_distance(film: Film, frame: int) -> float:
    return float(film.caption(frame).split()[2])


def test_values_and_intervals_have_units(evaluation: Path) -> None:
    results = by_name(json.loads((evaluation / "evaluation.json").read_text()))
    assert value_text(results["low_at_end"]) == "100.0 %"
    assert interval_text(results["low_at_end"], 0.95) == "95 % interval 61.0 to 100.0 %"
    assert value_text({**results["top_speed_mps"], "value": None}) == "-"


@pytest.mark.parametrize("text", ["{", '{"step": "many"}', '{"time_s": 1}', "[1]"])
def test_damaged_metrics_are_explained(tmp_path: Path, text: str) -> None:
    """The message names file and line."""
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1}\n' + text + "\n")
    with pytest.raises(ReportError, match=r"metrics.jsonl: line 2: not a row of metrics"):
        read_metrics(path)


def test_missing_evaluation_is_explained(evaluation: Path, tmp_path: Path) -> None:
    """For each missing file."""
    with pytest.raises(ReportError, match=r"no complete evaluation \(.* is missing\); name a folder"):
        write_report(tmp_path / "out", evaluation=tmp_path)
    for name in ("evaluation.json", "trajectories.npz"):
        (tmp_path / name).write_bytes((evaluation / name).read_bytes())
    with pytest.raises(ReplayError, match=r"replay.json: unreadable"):
        write_report(tmp_path / "out", evaluation=tmp_path)
    (tmp_path / "evaluation.json").write_text("{}")
    with pytest.raises(ReportError, match=r"evaluation.json: format: expected the number of the evaluation"):
        write_report(tmp_path / "out", evaluation=tmp_path)
    (tmp_path / "evaluation.json").write_text('{"format": 2}')
    with pytest.raises(ReportError, match=r"evaluation.json: training: missing"):
        write_report(tmp_path / "out", evaluation=tmp_path)


def test_text_in_csv_is_no_formula() -> None:
    cells = ["=1+1", "+a", "-a", "@a", "\ta", "-1.5", -1.5, "a", ""]
    assert [_cell(cell) for cell in cells] == ["'=1+1", "'+a", "'-a", "'@a", "'\ta", "-1.5", -1.5, "a", ""]


@pytest.mark.parametrize("name", ["../../x", "/tmp/x", "a/b", "a\x00", "", ".x"])
def test_a_table_writes_nothing_outside_the_report(name: str, evaluation: Path, tmp_path: Path) -> None:
    """A table's name becomes the name of files."""
    copy = Path(shutil.copytree(evaluation, tmp_path / "deep" / "evaluation"))
    edit_tables(copy, name=name)
    with pytest.raises(ReportError, match="tables"):
        write_report(tmp_path / "deep" / "out", evaluation=copy, film=False)
    assert not (tmp_path / "deep" / "out").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["deep"]


def test_text_of_an_evaluation_stays_text(evaluation: Path, tmp_path: Path) -> None:
    """In the page and its pictures it is neither markup nor a formula."""
    copy = Path(shutil.copytree(evaluation, tmp_path / "evaluation"))
    hostile = "$\\frac{</svg><script>alert(1)</script> -->"
    edit_tables(copy, title=hostile, description=hostile)
    page = write_report(tmp_path / "out", evaluation=copy, film=False).read_text(encoding="utf-8")
    assert "<script" not in page
    assert "&lt;script&gt;alert(1)" in page


def edit_tables(evaluation: Path, **fields: str) -> None:
    """Change fields of an evaluation's tables, and the titles of their columns with them."""
    path = evaluation / "evaluation.json"
    summary = json.loads(path.read_text(encoding="utf-8"))
    assert summary["tables"]
    for table in summary["tables"]:
        table.update(fields)
        for column in table["columns"]:
            column["title"] = fields.get("title", column["title"])
    path.write_text(json.dumps(summary), encoding="utf-8")


def test_a_torn_last_line_of_metrics_is_left_out(metrics: Path) -> None:
    """As a disk that was full leaves it."""
    rows = read_metrics(metrics)
    with metrics.open("a", encoding="utf-8") as stream:
        stream.write('{"step": 768, "spe')
    assert read_metrics(metrics) == rows


@pytest.mark.parametrize("torn", ["", '{"step": 768, "spe', '{"step": 768}'])
def test_a_resumed_training_repairs_metrics_that_were_cut(
    metrics: Path, torn: str, make_spec: Callable[..., TrainingSpec]
) -> None:
    """The next row begins a line of its own."""
    rows = read_metrics(metrics)
    with metrics.open("a", encoding="utf-8") as stream:
        stream.write(torn)
    with ConsoleReporter(metrics.parent, make_spec()) as reporter:
        reporter.metrics({"step": 1024.0, "steps_per_s": 1.0})
    assert read_metrics(metrics) == [*rows, {"step": 1024.0, "steps_per_s": 1.0}]
