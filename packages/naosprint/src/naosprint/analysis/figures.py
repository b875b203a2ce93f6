"""Draw the pictures of a report, as matplotlib figures that belong to no window."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from naosprint.actuation import CYCLE_S
from naosprint.scene import LEFT_COLOUR, RIGHT_COLOUR, Camera, robot_collection

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes

    from naosprint.arrays import BoolArray, FloatArray
    from naosprint.replay import Replay

SPEEDS_TO_BEAT_MPS = ((2.60, "2.60 m/s, best before the paper"), (3.91, "3.91 m/s, the paper"))
"""Top speeds that the paper reports, in metres per second, and what they are."""

CONTACT_N = 0.01
"""Force from which a foot counts as on the ground, newtons."""

_INK = "#22262b"
_FAINT = "#d7dbe0"
_ACCENT = "#1b8a6b"
_SECOND = "#8a6fb8"

_STYLE: dict[str, Any] = {
    "font.size": 10,
    "font.family": "DejaVu Sans",
    "text.color": _INK,
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


def learning_curve(rows: Sequence[Mapping[str, float]], evaluated: tuple[float, float] | None = None) -> Figure:
    """Draw speed and distance of the latest episodes of training against its steps.

    Args:
        rows: metrics of each update; rows without episodes are left out.
        evaluated: steps and top speed in m/s of the evaluated policy, if there is one.
    """
    kept = [row for row in rows if "speed_mps" in row]
    steps = np.array([row["step"] for row in kept]) / 1e6
    figure, (upper, lower) = _panels(2, height=5.6, sharex=True)
    upper.plot(steps, [row["speed_mps"] for row in kept], color=_ACCENT, lw=1.6, label="training, exploring")
    for speed, label in SPEEDS_TO_BEAT_MPS:
        upper.axhline(speed, color="#b3402e", lw=1.0, ls="--")
        upper.annotate(
            label,
            (0.0, speed),
            (4, 3),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            fontsize=8.5,
            color="#b3402e",
        )
    if evaluated is not None:
        upper.plot(
            [evaluated[0] / 1e6], [evaluated[1]], "o", ms=6, color=_INK, label="top speed of the evaluated policy"
        )
    upper.set_ylim(0.0, 4.4)
    upper.set_ylabel("mean speed, m/s")
    upper.legend(loc="lower right", fontsize=8.5)
    lower.plot(steps, [row["distance_m"] for row in kept], color=_ACCENT, lw=1.6, label="distance")
    lower.set_ylabel("distance, m")
    lower.set_ylim(0.0, None)
    falls = lower.twinx()
    falls.plot(steps, [100.0 * row["fall_rate"] for row in kept], color=_SECOND, lw=1.0, label="falls")
    falls.set_ylabel("episodes that end in a fall, %", color=_SECOND)
    falls.set_ylim(0.0, 105.0)
    falls.grid(visible=False)
    lower.set_xlabel("environment steps, millions")
    return figure


def speed_profile(lines: Sequence[Mapping[str, Any]], confidence: float) -> Figure:
    """Draw mean and fastest speed against the start line, by the paper's measure and over all episodes."""
    figure, (axes,) = _panels(1, height=3.8)
    for key, colour, label in (("paper", _ACCENT, "paper's measure"), ("all", _SECOND, "all episodes")):
        rows = [(line["line_m"], line[key]) for line in lines if line[key]["mean"] is not None]
        if not rows:
            continue
        at = [line for line, _ in rows]
        axes.fill_between(
            at, [r["ci"][0] for _, r in rows], [r["ci"][1] for _, r in rows], color=colour, alpha=0.25, lw=0
        )
        axes.plot(at, [r["mean"] for _, r in rows], "o-", ms=4, lw=1.6, color=colour, label=f"mean, {label}")
        axes.plot(at, [r["max"] for _, r in rows], "^:", ms=4, lw=1.0, color=colour, label=f"fastest, {label}")
    for speed, label in SPEEDS_TO_BEAT_MPS:
        axes.axhline(speed, color="#b3402e", lw=1.0, ls="--")
        axes.annotate(
            label,
            (1.0, speed),
            (-2, 3),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            fontsize=8.5,
            color="#b3402e",
            ha="right",
        )
    axes.set_ylim(0.0, None)
    axes.set_xlabel("start line, m after the start")
    axes.set_ylabel("forward speed, m/s")
    axes.set_title(f"bands: {confidence:.0%} bootstrap interval of the mean", fontsize=8.5)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="lower right", fontsize=8.5, ncols=2)
    return figure


def trajectories(x: FloatArray, y: FloatArray, finish_x_m: float | None) -> Figure:
    """Draw the paths of (k, T) episodes on the field."""
    figure, (axes,) = _panels(1, height=3.4)
    for row_x, row_y in zip(x, y, strict=True):
        axes.plot(row_x, row_y, color=_ACCENT, lw=0.7, alpha=0.45)
        kept = np.flatnonzero(~np.isnan(row_x))
        if finish_x_m is not None and row_x[kept[-1]] < finish_x_m:
            axes.plot(row_x[kept[-1]], row_y[kept[-1]], "x", ms=4, color="#b3402e")
    if finish_x_m is not None:
        axes.axvline(finish_x_m, color=_INK, lw=1.0)
    # the field's own lines: 30 m by 20 m
    axes.plot([-15, 15, 15, -15, -15], [-10, -10, 10, 10, -10], color="#9aa3ad", lw=1.0)
    axes.axvline(0.0, color="#9aa3ad", lw=0.8)
    widest = float(np.nanmax(np.abs(y), initial=0.0))
    axes.set_xlim(-15.3, 15.3)
    axes.set_ylim(*((-10.3, 10.3) if widest > 5.0 else (-5.2, 5.2)))
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.set_title("a cross marks a fall", fontsize=8.5)
    return figure


def gait_diagram(left_n: FloatArray, right_n: FloatArray, first: int) -> Figure:
    """Draw when each foot is on the ground, and the forces on them, over (T,) samples that begin at cycle ``first``."""
    time = (first + np.arange(len(left_n))) * CYCLE_S
    figure, (upper, lower) = _panels(2, height=3.9, sharex=True, ratios=(1, 2))
    for level, forces, colour in ((1, left_n, LEFT_COLOUR), (0, right_n, RIGHT_COLOUR)):
        spans = [(time[a] - CYCLE_S / 2, (b - a) * CYCLE_S) for a, b in _spans(np.abs(forces) > CONTACT_N)]
        upper.broken_barh(spans, (level - 0.36, 0.72), facecolors=colour, lw=0)
    for a, b in _spans((np.abs(left_n) <= CONTACT_N) & (np.abs(right_n) <= CONTACT_N)):
        upper.axvspan(time[a] - CYCLE_S / 2, time[a] + (b - a - 0.5) * CYCLE_S, color="#f0e6c8", lw=0, zorder=0)
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


_JOINT_PANELS = (
    ("hip pitch", "lj3"),
    ("knee", "lj4"),
    ("ankle pitch", "lj5"),
    ("hip roll", "lj2"),
    ("ankle roll", "lj6"),
    ("shoulder pitch", "aj1"),
)


def joint_angles(angles_rad: FloatArray, names: Sequence[str], first: int) -> Figure:
    """Draw the main joints of both sides over (T, A) samples in the policies' convention, from cycle ``first`` on."""
    time = (first + np.arange(len(angles_rad))) * CYCLE_S
    figure = Figure(figsize=(9.0, 4.8), layout="constrained")
    grid = figure.subplots(2, 3, sharex=True)
    for axes, (title, joint) in zip(grid.flat, _JOINT_PANELS, strict=True):
        for side, colour, label in (("l", LEFT_COLOUR, "left"), ("r", RIGHT_COLOUR, "right")):
            if side + joint in names:
                column = list(names).index(side + joint)
                axes.plot(time, np.degrees(angles_rad[:, column]), color=colour, lw=1.3, label=label)
        axes.set_title(title)
        axes.set_xlim(time[0], time[-1])
    for axes in grid[:, 0]:
        axes.set_ylabel("angle, degrees")
    for axes in grid[1]:
        axes.set_xlabel("time, s")
    grid[0, 2].legend(loc="upper right", fontsize=8.5)
    return figure


def frame_strip(replay: Replay, frames: Sequence[int], camera: Camera | None = None) -> Figure:
    """Draw the robot of some cycles side by side, with the time below each."""
    camera = camera or Camera()
    pitch = 0.44
    bottom, top = -0.15, 0.62
    figure = Figure(figsize=(9.0, 9.0 * (top - bottom) / (pitch * len(frames))))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    for place, frame in enumerate(frames):
        axes.add_collection(robot_collection(replay, frame, camera, shift=(place * pitch, 0.0)))
        axes.annotate(
            f"{(frame - frames[0]) * CYCLE_S * 1000:.0f} ms", (place * pitch, bottom + 0.02), ha="center", fontsize=8.5
        )
    axes.set_xlim(-0.5 * pitch, (len(frames) - 0.5) * pitch)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    axes.axis("off")
    return figure


def stride(left_n: FloatArray, first: int, count: int) -> list[int]:
    """Choose ``count`` evenly spaced cycles of one stride of the left foot that begins after cycle ``first``.

    Args:
        left_n: (T,) force on the left foot.
        first: where to start looking.
        count: number of cycles.

    Returns:
        Cycles from one touchdown up to the next; of the 25 cycles after ``first`` where there is no such stride.
    """
    loaded = np.abs(left_n) > CONTACT_N
    touchdowns = np.flatnonzero(loaded[1:] & ~loaded[:-1]) + 1
    later = touchdowns[touchdowns >= first]
    begin, end = first, min(first + 25, len(left_n) - 1)
    for a, b in pairwise(later.tolist()):
        if b - a >= count // 2:
            begin, end = a, b
            break
    return [round(frame) for frame in np.linspace(begin, end, count, endpoint=False)]


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
