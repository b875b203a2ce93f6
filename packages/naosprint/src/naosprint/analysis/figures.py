"""Plots of a report, as matplotlib figures without a window."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from naosim.robots.actuation import Actuation
from naosim.simulator import CONTACT_N, STEP_S

from naosprint.analysis.scene import LEFT_COLOUR, RIGHT_COLOUR, Camera, robot_collection, scale

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from naosim.robots import Robot
    from naospec.metrics import Chart, FieldLine, Metric, Reference

    from naosprint.analysis.replay import Replay
    from naosprint.analysis.robustness import Range
    from naosprint.arrays import BoolArray, FloatArray, IntArray

MAX_CHARTS = 4
"""Most charts of learning curves in one figure."""

MAX_JOINT_PANELS = 6
"""Most pairs of joints in one figure."""

_INK = "#22262b"
_FAINT = "#d7dbe0"
_REFERENCE = "#b3402e"
_PALETTE = ("#1b8a6b", "#8a6fb8", "#2c6fbb", "#b58a1e")

_STYLE: dict[str, Any] = {
    "font.size": 10,
    "font.family": "DejaVu Sans",
    "text.color": _INK,
    # text comes from evaluations: no formulas and no TeX, whatever the user's own settings are
    "text.usetex": False,
    "text.parse_math": False,
    "axes.edgecolor": "#7a828c",
    "axes.labelcolor": _INK,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": _FAINT,
    "grid.linewidth": 0.7,
    "xtick.color": "#555c65",
    "ytick.color": "#555c65",
    "legend.frameon": False,
    "svg.fonttype": "path",
    "svg.hashsalt": "naosprint",
    "figure.facecolor": "white",
}


def style() -> dict[Any, Any]:
    """Return the settings to draw and save these figures under, for :func:`matplotlib.rc_context`."""
    return dict(_STYLE)


def has_curves(rows: Sequence[Mapping[str, float]], charts: Sequence[Chart]) -> bool:
    """Return whether a training's metrics contain anything that the charts show."""
    return any(name in row for row in rows for chart in charts for name in chart.metrics)


def learning_curves(
    rows: Sequence[Mapping[str, float]],
    charts: Sequence[Chart],
    metrics: Mapping[str, Metric],
    references: Sequence[Reference] = (),
    evaluated: tuple[float, Mapping[str, float]] | None = None,
) -> Figure:
    """Plot a training's metrics against its steps, one panel for each of the first charts.

    Args:
        rows: metrics of each update; those without a value are left out.
        charts: which metrics belong together.
        metrics: metrics by name.
        references: values to compare with.
        evaluated: steps of the evaluated policy and its results by name, if there is one.
    """
    shown = [chart for chart in charts if has_curves(rows, [chart])][:MAX_CHARTS]
    columns = 2 if len(shown) in (2, 4) else 1
    rows_of_panels = -(-len(shown) // columns)
    figure = Figure(figsize=(9.0, (2.8 if columns == 2 else 2.2) * rows_of_panels), layout="constrained")
    grid = figure.subplots(rows_of_panels, columns, sharex=True, squeeze=False)
    stages = [row.get("stage") for row in rows]
    borders = [rows[i]["step"] / 1e6 for i in range(1, len(rows)) if stages[i] != stages[i - 1]]
    for axes, chart in zip(grid.flat, shown, strict=True):
        known = [metrics[name] for name in chart.metrics if name in metrics]
        for metric, colour in zip(known, _PALETTE, strict=False):
            points = [(row["step"] / 1e6, factor(metric) * row[metric.name]) for row in rows if metric.name in row]
            if not points:
                continue
            axes.plot(*zip(*points, strict=True), color=colour, lw=1.4, label=metric.title)
            value = None if evaluated is None else evaluated[1].get(metric.name)
            if evaluated is not None and value is not None:
                axes.plot([evaluated[0] / 1e6], [factor(metric) * value], "o", ms=5, color=_INK)
            draw_references(axes, metric, references)
        for border in borders:
            axes.axvline(border, color="#9aa3ad", lw=0.8, ls=":")
        axes.set_title(chart.title)
        if known:
            axes.set_ylabel(unit_label(known[0]))
        if len(known) > 1:
            axes.legend(fontsize=8.5)
        _start_at_zero(axes)
    for axes in grid[-1]:
        axes.set_xlabel("steps, millions")
    return figure


def result_table(table: Mapping[str, Any], references: Sequence[Reference] = (), confidence: float = 0.95) -> Figure:
    """Plot one of the tables of an evaluation's document: each column's results against the table's axis."""
    from naosprint.analysis.results import metric_of

    figure, (axes,) = _panels(1, height=3.8)
    metric = None
    for column, colour in zip(table["columns"], _PALETTE, strict=False):
        rows = [(at, result) for at, result in zip(table["at"], column["results"], strict=True)]
        rows = [(at, result) for at, result in rows if result["value"] is not None]
        if not rows:
            continue
        metric = metric_of(rows[0][1])
        by = factor(metric)
        at = [place for place, _ in rows]
        results = [result for _, result in rows]
        banded = [result["interval"] or (result["value"],) * 2 for result in results]
        axes.fill_between(at, [by * a for a, _ in banded], [by * b for _, b in banded], color=colour, alpha=0.25, lw=0)
        axes.plot(
            at, [by * result["value"] for result in results], "o-", ms=4, lw=1.6, color=colour, label=column["title"]
        )
        extreme = {"higher": "high", "lower": "low", None: None}[metric.better]
        if extreme is not None and all(result[extreme] is not None for result in results):
            best = [by * result[extreme] for result in results]
            axes.plot(at, best, "^:", ms=4, lw=1.0, color=colour, label=f"{column['title']}, best episode")
    axes.set_xlabel(_with_unit(table["axis"]["title"], table["axis"]["unit"]))
    axes.set_title(f"bands: {confidence:.0%} confidence interval of the mean", fontsize=8.5)
    if metric is not None:
        draw_references(axes, metric, references)
        axes.set_ylabel(_with_unit(metric.title, metric.unit))
        _start_at_zero(axes)
        axes.legend(loc="lower right", fontsize=8.5, ncols=2)
    return figure


def trajectories(x: FloatArray, y: FloatArray, failed: BoolArray, lines: Sequence[FieldLine] = ()) -> Figure:
    """Plot the paths of (k, T) episodes, seen from above, with a cross where one of them failed."""
    figure, (axes,) = _panels(1, height=3.0)
    for row_x, row_y, down in zip(x, y, failed, strict=True):
        axes.plot(row_x, row_y, color=_PALETTE[0], lw=0.7, alpha=0.45)
        kept = np.flatnonzero(~np.isnan(row_x))
        if down:
            axes.plot(row_x[kept[-1]], row_y[kept[-1]], "x", ms=4, color=_REFERENCE)
    # a straight run is a thin line: give it room to both sides, so that deviations can be seen
    places = [*(line.x_m for line in lines), float(np.nanmin(x)), float(np.nanmax(x))]
    centre_x, centre_y = (min(places) + max(places)) / 2.0, float(np.nanmin(y) + np.nanmax(y)) / 2.0
    half_x = max((max(places) - min(places)) / 2.0 * 1.08, 1.0)
    half_y = max(float(np.nanmax(y) - np.nanmin(y)) / 2.0 * 1.1, half_x / 4.0)
    axes.set_xlim(centre_x - half_x, centre_x + half_x)
    axes.set_ylim(centre_y - half_y, centre_y + half_y)
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    for line in lines:
        axes.axvline(line.x_m, color=_INK, lw=1.0)
        axes.annotate(
            line.title,
            (line.x_m, 1.0),
            (0.0, 3.0),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            fontsize=8.5,
            ha="center",
        )
    axes.set_title("a cross marks a failure", fontsize=8.5)
    return figure


def robustness(ranges: Sequence[Range], most_failures: float) -> Figure:
    """Plot the share of failed episodes over the strength of each disturbance that the simulator can do."""
    shown = [each for each in ranges if each.points]
    columns = min(3, max(1, len(shown)))
    rows = -(-len(shown) // columns) or 1
    figure = Figure(figsize=(3.4 * columns, 2.6 * rows), layout="constrained")
    for number, each in enumerate(shown):
        axes = figure.add_subplot(rows, columns, number + 1)
        x = np.array([point.strength for point in each.points])
        share, low, high = (
            100.0 * np.array([getattr(point, name) for point in each.points]) for name in ("failures", "low", "high")
        )
        reach = np.stack([np.maximum(share - low, 0.0), np.maximum(high - share, 0.0)])
        axes.errorbar(x, share, yerr=reach, color=_PALETTE[0], marker="o", markersize=4, capsize=2, linewidth=1.2)
        axes.axhline(100.0 * most_failures, color=_REFERENCE, linewidth=1.0, linestyle="--")
        axes.set(title=f"{each.disturbance.name}: {each.text()}", ylim=(-3.0, 103.0))
        axes.set_xlabel(_with_unit(each.disturbance.title, each.disturbance.unit))
        axes.set_ylabel(_with_unit("Failed episodes", "%"))
        if each.disturbance.strengths[0] > each.disturbance.strengths[-1]:
            axes.invert_xaxis()
    return figure


def gait_diagram(left_n: FloatArray, right_n: FloatArray, first: int) -> Figure:
    """Plot when each foot is on the ground, and the forces on them, over (T,) samples that begin at step ``first``."""
    time = (first + np.arange(len(left_n))) * STEP_S
    figure, (upper, lower) = _panels(2, height=3.9, sharex=True, ratios=(1, 2))
    for level, forces, colour in ((1, left_n, LEFT_COLOUR), (0, right_n, RIGHT_COLOUR)):
        spans = [(time[a] - STEP_S / 2, (b - a) * STEP_S) for a, b in _spans(np.abs(forces) > CONTACT_N)]
        upper.broken_barh(spans, (level - 0.36, 0.72), facecolors=colour, lw=0)
    for a, b in _spans((np.abs(left_n) <= CONTACT_N) & (np.abs(right_n) <= CONTACT_N)):
        upper.axvspan(time[a] - STEP_S / 2, time[a] + (b - a - 0.5) * STEP_S, color="#f0e6c8", lw=0, zorder=0)
    upper.set_yticks([0, 1], ["right foot", "left foot"])
    upper.set_ylim(-0.6, 1.6)
    upper.grid(visible=False)
    upper.set_title("bars: foot on the ground; shaded: both feet in the air", fontsize=8.5)
    for forces, colour, label in ((left_n, LEFT_COLOUR, "left"), (right_n, RIGHT_COLOUR, "right")):
        lower.step(time, forces, where="mid", color=colour, lw=1.2, label=label)
    lower.set_ylabel("upward force, N")
    lower.set_xlabel("time since the start, s")
    lower.legend(loc="upper right", fontsize=8.5, ncols=2)
    lower.set_xlim(time[0], time[-1])
    return figure


def joint_angles(angles_rad: FloatArray, robot: Robot, first: int) -> Figure:
    """Plot the joints that move most over (T, A) samples in the policy convention, from step ``first`` on.

    Left and right partners share a panel.
    """
    names = Actuation(robot).names
    time = (first + np.arange(len(angles_rad))) * STEP_S
    by_name = {joint.name: joint for joint in robot.joints}
    groups = [tuple(dict.fromkeys((name, by_name[name].mirror))) for name in names if by_name[name].side != "right"]
    columns = {name: np.degrees(angles_rad[:, i]) for i, name in enumerate(names)}
    most = sorted(groups, key=lambda group: -max(float(np.ptp(columns[name])) for name in group if name in columns))
    shown = [group for group in groups if group in most[:MAX_JOINT_PANELS]]
    across = min(3, len(shown))
    figure = Figure(figsize=(9.0, 2.4 * -(-len(shown) // across)), layout="constrained")
    grid = figure.subplots(-(-len(shown) // across), across, sharex=True, squeeze=False)
    for axes in grid.flat[len(shown) :]:
        axes.axis("off")
    colours = {"left": LEFT_COLOUR, "right": RIGHT_COLOUR, "centre": _INK}
    for axes, group in zip(grid.flat, shown, strict=False):
        for name in group:
            if name in columns:
                axes.plot(time, columns[name], color=colours[by_name[name].side], lw=1.3, label=name)
        axes.set_title(", ".join(group))
        axes.set_xlim(time[0], max(time[-1], time[0] + STEP_S))
        axes.set_xlabel("time, s")
    for axes in grid[:, 0]:
        axes.set_ylabel("angle, degrees")
    return figure


def frame_strip(replay: Replay, frames: Sequence[int]) -> Figure:
    """Draw the robot of some steps side by side, with the time below each."""
    size = scale(replay)
    # far enough apart that the widest of them touches no other
    drawn = [robot_collection(replay, frame, Camera()) for frame in frames]
    reach = max(np.abs(np.asarray(path.vertices)[:, 0]).max() for robot in drawn for path in robot.get_paths())
    pitch, bottom, top = max(0.44 * size, 2.0 * reach), -0.15 * size, 0.62 * size
    figure = Figure(figsize=(9.0, 9.0 * (top - bottom) / (pitch * len(frames))))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    for place, frame in enumerate(frames):
        axes.add_collection(robot_collection(replay, frame, Camera(), shift=(place * pitch, 0.0)))
        label = f"{(frame - frames[0]) * STEP_S * 1000:.0f} ms"
        axes.annotate(label, (place * pitch, bottom + 0.02 * size), ha="center", fontsize=8.5)
    axes.set_xlim(-0.5 * pitch, (len(frames) - 0.5) * pitch)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    axes.axis("off")
    return figure


def stride(left_n: FloatArray, right_n: FloatArray, first: int, count: int) -> list[int]:
    """Choose evenly spaced steps of one stride of the left foot that begins after step ``first``.

    Args:
        left_n: (T,) force on the left foot.
        right_n: (T,) force on the right foot.
        first: where to start looking.
        count: most steps to choose; a shorter stride has each of its steps once.

    Returns:
        Steps from one touchdown up to the next, with one of the right foot between them, so that a foot which only
        bounces begins no stride; of the 25 after ``first`` where there is no such stride.
    """
    left, right = (_touchdowns(force[first:]) + first for force in (left_n, right_n))
    begin, end = first, min(first + 25, len(left_n) - 1)
    if len(left):
        between = right[right > left[0]]
        after = left[left > between[0]] if len(between) else between
        if len(after):
            begin, end = int(left[0]), int(after[0])
    return [round(step) for step in np.linspace(begin, end, min(count, max(1, end - begin)), endpoint=False)]


def _touchdowns(force_n: FloatArray) -> IntArray:
    """Return the steps in which a foot without load in the step before has one."""
    loaded = np.abs(force_n) > CONTACT_N
    return np.flatnonzero(loaded[1:] & ~loaded[:-1]) + 1


def factor(metric: Metric) -> float:
    """Return the factor from a metric's values to the numbers on its axis."""
    return 100.0 if metric.unit == "%" else 1.0


def unit_label(metric: Metric) -> str:
    """Return the label of an axis whose chart has a title of its own."""
    return metric.unit or metric.title.lower()


def draw_references(axes: Axes, metric: Metric, references: Sequence[Reference]) -> None:
    """Draw a dashed line at each reference value of a metric."""
    for reference in references:
        if reference.metric != metric.name:
            continue
        level = factor(metric) * reference.value
        axes.axhline(level, color=_REFERENCE, lw=1.0, ls="--")
        axes.annotate(
            reference.title,
            (0.0, level),
            (4, -3),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            fontsize=8.5,
            va="top",
            color=_REFERENCE,
        )


def _with_unit(title: str, unit: str) -> str:
    return f"{title}, {unit}" if unit else title


def _start_at_zero(axes: Axes) -> None:
    """Start the vertical axis at 0 unless a value is below it."""
    if axes.dataLim.ymin >= 0.0:
        axes.set_ylim(0.0, None)


def _panels(
    count: int, *, height: float, sharex: bool = False, ratios: tuple[int, ...] | None = None
) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(9.0, height), layout="constrained")
    grid = figure.subplots(count, 1, sharex=sharex, squeeze=False, height_ratios=ratios)
    return figure, list(grid[:, 0])


def _spans(flags: BoolArray) -> list[tuple[int, int]]:
    """Return the half-open index ranges where (T,) flags are set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
