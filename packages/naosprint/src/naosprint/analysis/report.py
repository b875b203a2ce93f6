"""Write a report: what was trained, how it learnt, how it runs.

The page is one HTML file that needs nothing else. Beside it lie the pictures as SVG and PNG, their figures as CSV and
JSON, and the film as MP4 and GIF.
"""

from __future__ import annotations

import base64
import csv
import io
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from naosim.robots import nao_model
from naospec import TrainingSpec, task

from naosprint import figures
from naosprint.actuation import CYCLE_S, Actuation
from naosprint.film import write_gif, write_mp4
from naosprint.replay import Replay, load_replay

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure

    from naosprint.arrays import FloatArray

WINDOW_CYCLES = 100
"""Cycles that gait and joint pictures show: two seconds."""

FILM_CYCLES = 1000
"""Longest film, cycles."""

GIF_CYCLES = 150
"""Length of the GIF, cycles."""


class ReportError(ValueError):
    """Say which input of a report is missing or damaged."""


@dataclass(frozen=True)
class _Picture:
    name: str
    title: str
    caption: str
    figure: Figure


def read_metrics(path: Path) -> list[dict[str, float]]:
    """Read a training's ``metrics.jsonl``; of rows with equal steps, which a resumed training leaves, the last counts.

    Raises:
        ReportError: naming the line that is not a row of numbers.
    """
    rows: dict[float, dict[str, float]] = {}
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise ReportError(f"{path}: unreadable: {error}") from error
    for number, line in enumerate(lines, start=1):
        try:
            row = {str(name): float(value) for name, value in json.loads(line).items()}
            rows[row["step"]] = row
        except (ValueError, TypeError, AttributeError, KeyError) as error:
            raise ReportError(f"{path}: line {number}: not a row of metrics: {error!r}") from error
    return [rows[step] for step in sorted(rows)]


def write_report(
    directory: Path, *, evaluation: Path, metrics: Path | None = None, title: str = "Sprint", film: bool = True
) -> Path:
    """Write a report to ``directory`` and return the path of its page.

    Args:
        directory: made if it is missing; files of the same names are replaced.
        evaluation: directory that :meth:`naosprint.evaluation.Evaluation.save` wrote.
        metrics: the training's ``metrics.jsonl``; without it there is no learning curve.
        title: headline of the page.
        film: whether to film the replay, which takes most of the time.

    Raises:
        ReportError: if an input is missing or damaged.
        ReplayError: if the replay is.
    """
    summary, paths = _read_evaluation(evaluation)
    replay = load_replay(evaluation / "replay.json")
    rows = read_metrics(metrics) if metrics is not None else []
    directory.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(figures.style()):
        pictures = _pictures(summary, paths, replay, rows)
        drawings = {picture.name: _save(picture.figure, directory / picture.name) for picture in pictures}
    _write_tables(directory, summary, paths, rows)
    if film:
        begin = _window(len(replay.positions))[0]
        write_mp4(replay, directory / "run.mp4", frames=range(min(len(replay.positions), FILM_CYCLES)))
        write_gif(replay, directory / "run.gif", frames=range(begin, min(begin + GIF_CYCLES, len(replay.positions))))
    (directory / "report.json").write_text(json.dumps({"title": title, "evaluation": summary}, indent=2) + "\n")
    environment = Environment(
        loader=PackageLoader("naosprint"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    page = directory / "report.html"
    page.write_text(
        environment.get_template("report.html").render(
            title=title,
            summary=summary,
            headline=_headline(summary),
            details=_details(summary, rows),
            pictures=[(picture, drawings[picture.name]) for picture in pictures],
            film=_data_url(directory / "run.mp4", "video/mp4") if film else None,
            replay=replay,
            speeds=figures.SPEEDS_TO_BEAT_MPS,
        )
    )
    return page


def _read_evaluation(directory: Path) -> tuple[dict[str, Any], dict[str, FloatArray]]:
    figures_file, paths_file = directory / "evaluation.json", directory / "trajectories.npz"
    try:
        summary: dict[str, Any] = json.loads(figures_file.read_bytes())
        for name in ("training", "evaluation", "speed_by_line", "paper", "distance_m", "falls"):
            if name not in summary:
                raise ReportError(f"{figures_file}: {name}: missing")
        with np.load(paths_file, allow_pickle=False) as archive:
            paths = {name: np.array(archive[name], dtype=np.float64) for name in archive.files}
    except ReportError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ReportError(f"{directory}: no complete evaluation: {error}") from error
    return summary, paths


def _window(samples: int) -> tuple[int, int]:
    """Return the half-open range of cycles that shows the gait: the middle of the run."""
    begin = max(0, (samples - WINDOW_CYCLES) // 2)
    return begin, min(begin + WINDOW_CYCLES, samples)


def _pictures(
    summary: Mapping[str, Any], paths: Mapping[str, FloatArray], replay: Replay, rows: Sequence[Mapping[str, float]]
) -> list[_Picture]:
    spec = TrainingSpec.model_validate(summary["training"])
    finish = task(summary["evaluation"]["task"]).finish_x_m
    steps = summary["checkpoint"]["step"]
    top = summary["paper"]["top_speed_mps"]
    begin, end = _window(len(replay.positions))
    left, right = replay.foot_forces[:, 0].astype(np.float64), replay.foot_forces[:, 1].astype(np.float64)
    names = Actuation(nao_model.model(spec.robot_type)).names
    first, last = _window(len(paths["joint_angles"]))
    found = []
    if any("speed_mps" in row for row in rows):
        found.append(
            _Picture(
                "learning-curve",
                "Learning curve",
                "Means of the latest 100 episodes of training, in which the policy explores and falls more than it "
                "would. Dashed: the speeds to beat.",
                figures.learning_curve(rows, (steps, top) if top is not None else None),
            )
        )
    found += [
        _Picture(
            "speed-profile",
            "Speed by start line",
            "Speed from a line behind the start to the last sample. The paper's measure leaves out episodes with fewer "
            "than 200 samples beyond the line.",
            figures.speed_profile(summary["speed_by_line"], summary["evaluation"]["confidence"]),
        ),
        _Picture(
            "trajectories",
            "Trajectories",
            f"Paths of the first {len(paths['x'])} episodes.",
            figures.trajectories(paths["x"], paths["y"], finish),
        ),
        _Picture(
            "frames",
            "One stride",
            "From one touchdown of the left foot to the next. Blue: left, orange: right.",
            figures.frame_strip(replay, figures.stride(left, begin, 8)),
        ),
        _Picture(
            "gait",
            "Gait",
            "Foot contacts by the force perceptors, two seconds in the middle of the run.",
            figures.gait_diagram(left[begin:end], right[begin:end], begin),
        ),
        _Picture(
            "joints",
            "Joint angles",
            "As policies see them: hips forward negative, knees bent positive, the right side mirrored.",
            figures.joint_angles(paths["joint_angles"][first:last], names, first),
        ),
    ]
    return found


def _save(figure: Figure, stem: Path) -> str:
    """Write a figure as SVG and PNG and return the SVG as text to put into a page."""
    figure.savefig(stem.with_suffix(".png"), dpi=150)
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata={"Date": None})
    text = stream.getvalue()
    stem.with_suffix(".svg").write_text(text)
    return text[text.index("<svg") :]


def _write_tables(
    directory: Path,
    summary: Mapping[str, Any],
    paths: Mapping[str, FloatArray],
    rows: Sequence[Mapping[str, float]],
) -> None:
    def table(name: str, header: Sequence[str], lines: Sequence[Sequence[Any]]) -> None:
        with (directory / name).open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(header)
            writer.writerows(lines)

    if rows:
        columns = sorted({name for row in rows for name in row}, key=lambda name: (name != "step", name))
        table("learning-curve.csv", columns, [[row.get(name, "") for name in columns] for row in rows])
    header = ["line_m", "measure", "episodes", "mean", "sd", "min", "max", "ci_low", "ci_high"]
    lines = []
    for line in summary["speed_by_line"]:
        for measure in ("paper", "all"):
            entry = line[measure]
            low, high = entry["ci"] or ("", "")
            lines.append([line["line_m"], measure, *(entry[name] for name in header[2:7]), low, high])
    table("speed-profile.csv", header, lines)
    samples = [
        [episode, cycle, round(cycle * CYCLE_S, 2), *(f"{paths[name][episode, cycle]:.4f}" for name in _PATH_COLUMNS)]
        for episode in range(len(paths["x"]))
        for cycle in range(int((~np.isnan(paths["x"][episode])).sum()))
    ]
    table("trajectories.csv", ["episode", "cycle", "time_s", *_PATH_COLUMNS], samples)


_PATH_COLUMNS = ("x", "y", "height", "left_foot_force", "right_foot_force")


def _headline(summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return what to know first: label, value, and what it means."""
    paper, falls = summary["paper"], summary["falls"]
    top = paper["top_speed_mps"]
    low, high = falls["ci"]
    level = summary["evaluation"]["confidence"]
    return [
        (
            "top speed",
            "none" if top is None else f"{top:.2f} m/s",
            "the paper's measure; no episode is long enough" if top is None else "the paper's measure",
        ),
        ("mean speed", f"{summary['speed_mps']['mean']:.2f} m/s", "all episodes, start included"),
        ("distance", f"{summary['distance_m']['mean']:.2f} m", f"mean of {summary['episodes']} episodes"),
        ("falls", f"{falls['rate']:.1%}", f"{level:.0%} interval {low:.1%} to {high:.1%}"),
        ("deviation", f"{paper['deviation_deg']['mean']:.2f}°", f"sd {paper['deviation_deg']['sd']:.2f}°"),
    ]


def _details(summary: Mapping[str, Any], rows: Sequence[Mapping[str, float]]) -> list[tuple[str, str]]:
    spec = TrainingSpec.model_validate(summary["training"])
    challenge = summary["run_challenge"]
    details = [
        ("task", f"{spec.task}, minimum height {spec.fall_height_m:g} m"),
        ("robot type", str(spec.robot_type)),
        ("preset", spec.preset),
        *[(f"  {name}", f"{value}") for name, value in spec.departures().items()],
        ("seed", str(spec.seed)),
        ("training steps", f"{summary['checkpoint']['step']:,}"),
        ("simulator", summary["evaluation"]["simulator"] or spec.simulator),
        ("evaluated on", f"{summary['evaluation']['task']}, {summary['episodes']} episodes"),
        ("both feet off the ground", f"{summary['both_feet_off_ground']['mean']:.1%} of the time"),
        ("run challenge score", f"{challenge['score']['mean']:.3f}"),
        ("low at the end (below 0.33 m)", f"{summary['paper']['low_at_end']['rate']:.1%}"),
        ("specification", summary["checkpoint"]["spec_sha256"][:16]),
    ]
    if rows and "time_s" in rows[-1]:
        details.insert(6, ("training time", f"{rows[-1]['time_s'] / 60.0:.1f} min"))
    return details


def _data_url(path: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"
