"""Reports of trainings: specification, learning curves, evaluation, film.

The page is one HTML file that needs nothing else. Beside it are the plots as SVG and PNG, their data as CSV and JSON,
and the film as MP4 and GIF. Everything shown comes from the evaluation's document and the task's presentation.
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
from naosim import robots
from naosim.npz import read_npz
from naosim.simulator import CONTACT_N, STEP_S
from naospec import TrainingSpec, formats, validation_words
from naospec.files import drop, read_bounded, read_json, replacing, together, write_whole
from naospec.json_text import json_text
from naospec.metrics import Chart, for_family
from naospec.sections import require_plain_names
from pydantic import ValidationError

from naosprint import tasks
from naosprint.analysis import figures
from naosprint.analysis.film import write_gif, write_mp4
from naosprint.analysis.replay import Replay, load_replay
from naosprint.analysis.results import by_name, headline, interval_text, value_text
from naosprint.rl.columns import columns

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure
    from naospec.metrics import Reference

    from naosprint.arrays import FloatArray

REPORT_FORMAT = 1
"""Version of ``report.json``."""

WINDOW_STEPS = 100
"""Steps that plots of gait and joints show: two seconds."""

FILM_STEPS = 1250
"""Longest film, steps: 25 s, in which a robot at 1.2 m/s reaches the finish line."""

GIF_STEPS = 150
"""Length of the GIF, steps."""

_MAX_BYTES = 500_000_000
_REWARD = Chart("Reward", ("reward",))

_REQUIRED = ("training", "evaluation", "checkpoint", "task", "episodes", "results", "headline", "tables")
_PLOTS = frozenset({"learning-curve", "trajectories", "frames", "gait", "joints"})
"""Plots that not every report has."""
_PATH_COLUMNS = ("x", "y", "height", "left_foot_force", "right_foot_force")


class ReportError(ValueError):
    """Input of a report that is missing or damaged."""


@dataclass(frozen=True)
class _Plot:
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
        whole, _, torn = read_bounded(path, _MAX_BYTES).decode().rpartition("\n")
    except (OSError, ValueError) as error:
        raise ReportError(f"{path}: unreadable: {error}") from error
    # a disk that was full, or a training that still writes, cuts the last line
    lines = [*whole.splitlines(), *([torn] if torn.endswith("}") else [])]
    for number, line in enumerate(lines, start=1):
        try:
            row = {str(name): float(value) for name, value in json.loads(line).items()}
            rows[row["step"]] = row
        except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
            raise ReportError(f"{path}: line {number}: not a row of metrics: {error!r}") from error
    return [rows[step] for step in sorted(rows)]


@together()
def write_report(
    directory: Path, *, evaluation: Path, metrics: Path | None = None, title: str | None = None, film: bool = True
) -> Path:
    """Write a report to ``directory`` and return the path of its page.

    Args:
        directory: made if it is missing; the files of a report from before are replaced, or deleted if this one lacks
            them.
        evaluation: directory that :meth:`naosprint.analysis.evaluation.EvaluationRun.save` wrote.
        metrics: the training's ``metrics.jsonl``; without it there are no learning curves.
        title: headline of the page; the task's name if None.
        film: whether to film the replay, which takes most of the time.

    Raises:
        ReportError: if an input is missing or damaged.
        ReplayError: if the replay is.
    """
    summary, spec, paths = _read_evaluation(evaluation)
    replay = load_replay(evaluation / "replay.json")
    rows = read_metrics(metrics) if metrics is not None else []
    title = title or str(summary["task"]["name"])
    film = film and bool(replay.robot.shapes)
    directory.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(figures.style()):
        plots = _plots(summary, spec, paths, replay, rows)
        drawings = {plot.name: _save(plot.figure, directory / plot.name) for plot in plots}
    for name in _PLOTS - drawings.keys():
        drop(directory / f"{name}.png")
        drop(directory / f"{name}.svg")
    _write_tables(directory, summary, paths, rows)
    steps = len(replay.positions)
    if film:
        begin = _window(steps, spec)[0]
        mp4 = write_mp4(replay, directory / "run.mp4", frames=film_frames(replay))
        write_gif(replay, directory / "run.gif", frames=range(begin, min(begin + GIF_STEPS, steps)))
    else:
        drop(directory / "run.mp4")
        drop(directory / "run.gif")
    document = {"format": REPORT_FORMAT, "title": title, "evaluation": summary}
    write_whole(directory / "report.json", json_text(document))
    environment = Environment(
        loader=PackageLoader("naosprint.analysis"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    page = directory / "report.html"
    write_whole(
        page,
        environment.get_template("report.html").render(
            title=title,
            summary=summary,
            headline=_headline(summary),
            details=_details(summary, spec, rows),
            plots=[(plot, drawings[plot.name]) for plot in plots],
            film=_data_url(mp4, "video/mp4") if film else None,
            film_caption=film_caption(replay, repeats=tasks.get(spec.task.name).presentation.repeats),
            references=[reference.title for reference in _references(spec)],
        ),
    )
    return page


def film_frames(replay: Replay) -> range:
    """Return the steps of an episode that its film shows."""
    return range(min(len(replay.positions), FILM_STEPS))


def film_caption(replay: Replay, *, repeats: bool = True) -> str:
    """Return the caption of the film of an episode: the numbers of its last picture, and how the episode ended."""
    rank = "distance" if repeats else "final height"
    moved = f"{replay.moved_m():.2f} m from the start in {replay.duration_s:.2f} s"
    caption = f"The median of the first episodes by {rank}: {moved}, {(replay.end or 'time limit').lower()}."
    last = film_frames(replay)[-1]
    if last < len(replay.positions) - 1:
        caption += f" The film shows the first {last * STEP_S:.2f} s, {replay.moved_m(0, last):.2f} m."
    return f"{caption} Lines on the ground are half a metre apart; the speed is that of the last half second."


def _read_evaluation(directory: Path) -> tuple[dict[str, Any], TrainingSpec, dict[str, FloatArray]]:
    results, paths_file = directory / "evaluation.json", directory / "trajectories.npz"
    try:
        summary: dict[str, Any] = read_json(results, _MAX_BYTES)
        if not isinstance(summary, dict):
            raise ReportError(f"{results}: not an evaluation")
        summary = formats.current(formats.Kind.RESULT, summary)
        for name in _REQUIRED:
            if name not in summary:
                raise ReportError(f"{results}: {name}: missing")
        require_plain_names("tables", [table["name"] for table in summary["tables"]])
        spec = _episodes_spec(summary)
        summary["results"] = _of_robot(spec, summary["results"])
        arrays = read_npz(paths_file, max_bytes=_MAX_BYTES)
        paths = {name: np.array(values, dtype=np.float64) for name, values in arrays.items()}
    except ReportError:
        raise
    except formats.FormatError as error:
        raise ReportError(f"{results}: {error}") from error
    except ValidationError as error:
        raise ReportError(f"{results}: {validation_words(error.errors())}") from error
    except FileNotFoundError as error:
        missing = f"no complete evaluation ({error.filename} is missing)"
        raise ReportError(f"{directory}: {missing}; name a folder that `naosprint evaluate --output` wrote") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ReportError(f"{directory}: no complete evaluation: {error}") from error
    return summary, spec, paths


def _of_robot(spec: TrainingSpec, results: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the results that the task has for this robot; earlier versions reported those of a NAO for all robots."""
    known = tasks.get(spec.task.name).results
    shown = {metric.name for metric in for_family(robots.configured(spec.robot).family, known)}
    others = {metric.name for metric in known} - shown
    return [result for result in results if result["name"] not in others]


def _episodes_spec(summary: Mapping[str, Any]) -> TrainingSpec:
    """Return the specification of the episodes: the training's with the evaluation's task, and its stage's robot."""
    training = summary["training"]
    robot = training["robot"] if training["robot"]["name"] == summary["robot"] else summary["robot"]
    return TrainingSpec.model_validate({**training, "stages": [], "task": summary["task"]["settings"], "robot": robot})


def _window(samples: int, spec: TrainingSpec) -> tuple[int, int]:
    """Return the half-open range of steps that shows the motion: the middle of a run, the beginning of others."""
    if not tasks.get(spec.task.name).presentation.repeats:
        return 0, min(GIF_STEPS, samples)
    begin = max(0, (samples - WINDOW_STEPS) // 2)
    return begin, min(begin + WINDOW_STEPS, samples)


def _references(spec: TrainingSpec) -> tuple[Reference, ...]:
    """Return the values that the task gives to compare this robot's with."""
    return for_family(robots.configured(spec.robot).family, tasks.get(spec.task.name).presentation.references)


def _plots(
    summary: Mapping[str, Any],
    spec: TrainingSpec,
    paths: Mapping[str, FloatArray],
    replay: Replay,
    rows: Sequence[Mapping[str, float]],
) -> list[_Plot]:
    presentation = tasks.get(spec.task.name).presentation
    references, confidence = _references(spec), summary["evaluation"]["confidence"]
    found = []
    charts = (*presentation.charts[: figures.MAX_CHARTS - 1], _REWARD)
    if figures.has_curves(rows, charts):
        values = {name: result["value"] for name, result in by_name(summary).items() if result["value"] is not None}
        curves = figures.learning_curves(
            rows,
            charts,
            {metric.name: metric for metric in columns(spec)},
            references,
            (summary["checkpoint"]["step"], values),
        )
        caption = "Means of the latest 100 episodes of training, with exploration. Dots: the evaluated policy, without."
        found.append(_Plot("learning-curve", "Learning curves", caption, curves))
    for table in summary["tables"]:
        figure = figures.result_table(table, references, confidence)
        found.append(_Plot(table["name"].replace("_", "-"), table["title"], table["description"], figure))
    if len(paths["x"]):
        figure = figures.trajectories(paths["x"], paths["y"], paths["failed"] > 0.0, presentation.lines)
        caption = f"Paths of the first {len(paths['x'])} episodes, from above."
        found.append(_Plot("trajectories", "Trajectories", caption, figure))
    begin, end = _window(len(replay.positions), spec)
    left, right = replay.foot_forces[:, 0].astype(np.float64), replay.foot_forces[:, 1].astype(np.float64)
    if replay.robot.shapes and presentation.repeats:
        figure = figures.frame_strip(replay, figures.stride(left, right, begin, 8))
        caption = "From one touchdown of the left foot to the next. Blue: left, orange: right."
        found.append(_Plot("frames", "One stride", caption, figure))
    elif replay.robot.shapes:
        figure = figures.frame_strip(replay, [round(step) for step in np.linspace(begin, end - 1, 8)])
        found.append(_Plot("frames", "The motion", "From the beginning. Blue: left, orange: right.", figure))
    if (np.abs(replay.foot_forces) > CONTACT_N).any():
        figure = figures.gait_diagram(left[begin:end], right[begin:end], begin)
        where = "two seconds in the middle of the run" if presentation.repeats else "three seconds from the beginning"
        caption = f"Foot contacts by the force perceptors, at most {where}."
        if replay.failed:
            caption += f" The episode ended after {replay.duration_s:.2f} s: {replay.end.lower()}."
        found.append(_Plot("gait", "Gait", caption, figure))
    if paths["joint_angles"].size:
        first, last = _window(len(paths["joint_angles"]), spec)
        figure = figures.joint_angles(paths["joint_angles"][first:last], robots.configured(spec.robot), first)
        caption = "The joints that move most, as policies see them: equal angles on both sides are a symmetric posture."
        found.append(_Plot("joints", "Joint angles", caption, figure))
    return found


def _save(figure: Figure, stem: Path) -> str:
    """Write a figure as SVG and PNG and return the SVG as text to put into a page."""
    with replacing(stem.with_suffix(".png")) as file:
        figure.savefig(file, dpi=150)
    figure.set_layout_engine("none")  # the layout, a third of the time, is that of the PNG
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata={"Date": None})
    text = stream.getvalue()
    write_whole(stem.with_suffix(".svg"), text)
    return text[text.index("<svg") :]


def _cell(value: Any) -> Any:
    """Return `value`, with an apostrophe before text that a spreadsheet would take for a formula."""
    if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")):
        try:
            float(value)
        except ValueError:
            return f"'{value}"
    return value


def _write_tables(
    directory: Path,
    summary: Mapping[str, Any],
    paths: Mapping[str, FloatArray],
    rows: Sequence[Mapping[str, float]],
) -> None:
    """Write everything that the plots show as CSV files."""

    def write(name: str, header: Sequence[str], lines: Sequence[Sequence[Any]]) -> None:
        stream = io.StringIO()
        csv.writer(stream).writerows([_cell(value) for value in line] for line in (header, *lines))
        write_whole(directory / f"{name}.csv", stream.getvalue())

    if rows:
        names = sorted({name for row in rows for name in row}, key=lambda name: (name != "step", name))
        write("learning-curve", names, [[row.get(name, "") for name in names] for row in rows])
    else:
        drop(directory / "learning-curve.csv")
    numbers = ("value", "sd", "low", "high", "count", "episodes")

    def cells(result: Mapping[str, Any]) -> list[Any]:
        values = [result[name] for name in numbers] + list(result["interval"] or (None, None))
        return [result["name"], result["unit"], *("" if value is None else value for value in values)]

    header = ["name", "unit", *numbers, "interval_low", "interval_high"]
    write("results", header, [cells(result) for result in summary["results"]])
    for table in summary["tables"]:
        lines = [
            [at, column["title"], *cells(result)]
            for column in table["columns"]
            for at, result in zip(table["at"], column["results"], strict=True)
        ]
        write(table["name"].replace("_", "-"), ["at", "column", *header], lines)
    samples = [
        [episode, step, round(step * STEP_S, 2), *(f"{paths[name][episode, step]:.4f}" for name in _PATH_COLUMNS)]
        for episode in range(len(paths["x"]))
        for step in range(int((~np.isnan(paths["x"][episode])).sum()))
    ]
    write("trajectories", ["episode", "step", "time_s", *_PATH_COLUMNS], samples)


def _headline(summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return the task's headline results: title, value, and the interval or what it means."""
    confidence = summary["evaluation"]["confidence"]
    return [
        (result["title"], value_text(result), interval_text(result, confidence) or result["description"])
        for result in headline(summary)
    ]


def _details(
    summary: Mapping[str, Any], spec: TrainingSpec, rows: Sequence[Mapping[str, float]]
) -> list[tuple[str, str, str]]:
    """Return name, value and meaning of the other results, and the settings of training and evaluation."""
    first = set(summary["headline"])
    training, evaluation, checkpoint = summary["training"], summary["evaluation"], summary["checkpoint"]
    task = [
        f"{name} {value}"
        for name, value in summary["task"]["settings"].items()
        if name not in ("name", "version") and value is not None
    ]
    trained = TrainingSpec.model_validate(training)
    settings = [
        ("Task", f"{summary['task']['name']}, version {summary['task']['version']}: {', '.join(task)}"),
        ("Robot", spec.robot.name),
        ("Simulator", " ".join(filter(None, (summary["simulator"], summary.get("engine"))))),
        ("Preset", spec.algorithm.preset),
        *[(f"  {name}", f"{value}") for name, value in trained.overrides().items()],
        *[
            (f"  stage {number}", f"{stage.steps:,} steps, {json.dumps({**stage.algorithm, **stage.task})}")
            for number, stage in enumerate(trained.stages, start=1)
        ],
        ("Seed", str(spec.seed)),
        ("Training steps", f"{checkpoint['step']:,}"),
        *([("Training time", _duration(rows[-1]["time_s"]))] if rows and "time_s" in rows[-1] else []),
        ("Evaluation", f"{summary['episodes']:,} episodes, seed {evaluation['seed']}"),
        ("Specification", checkpoint["spec_sha256"][:16]),
    ]
    others = [
        (result["title"], value_text(result), result["description"])
        for result in summary["results"]
        if result["name"] not in first
    ]
    return [*others, *((name, value, "") for name, value in settings)]


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _data_url(path: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"
