"""Films of replays."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from naosim.simulator import STEP_S

from naosprint.analysis.scene import Camera, robot_collection, scale

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from naosprint.analysis.replay import Replay
    from naosprint.arrays import ByteArray, FloatArray

WIDTH_PX, HEIGHT_PX = 960, 400
"""Size of a picture; both even, as H.264 requires."""

SPEED_STEPS = 25
"""Steps over which the displayed speed is averaged: half a second."""

_DPI = 100
_SPAN_M = 2.6  # width of the picture for a robot of unit size
_GROUND = "#eef1ea"
_LINE = "#c3cab9"


class Film:
    """Pictures of a replay, taken by a camera that follows the robot.

    Args:
        replay: the episode.
        camera: where it is seen from.
    """

    def __init__(self, replay: Replay, camera: Camera | None = None) -> None:
        self._replay = replay
        self._span = _SPAN_M * scale(replay)
        self._camera = camera or Camera(azimuth_deg=-14.0, elevation_deg=9.0)
        self._figure = Figure(figsize=(WIDTH_PX / _DPI, HEIGHT_PX / _DPI), dpi=_DPI)
        self._canvas = FigureCanvasAgg(self._figure)
        self._axes: Axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0))

    def picture(self, frame: int) -> ByteArray:
        """Return the (HEIGHT_PX, WIDTH_PX, 3) picture of one step.

        It shows the time, the distance from the start, and the speed of the last half second.
        """
        replay, axes = self._replay, self._axes
        axes.clear()
        axes.axis("off")
        height = self._span * HEIGHT_PX / WIDTH_PX
        axes.set_xlim(-0.5 * self._span, 0.5 * self._span)
        axes.set_ylim(-0.28 * height, 0.72 * height)
        self._ground(frame)
        axes.add_collection(robot_collection(replay, frame, self._camera))
        recent = max(0, frame - SPEED_STEPS)
        speed = replay.moved_m(recent, frame) / max(frame - recent, 1) / STEP_S
        text = f"{frame * STEP_S:5.2f} s    {replay.moved_m(0, frame):5.2f} m    {speed:4.2f} m/s"
        axes.text(0.02, 0.93, text, transform=axes.transAxes, fontsize=13, family="DejaVu Sans Mono", va="top")
        self._canvas.draw()  # type: ignore[no-untyped-call]
        return np.asarray(self._canvas.buffer_rgba())[:, :, :3].copy()  # type: ignore[no-untyped-call]

    def _ground(self, frame: int) -> None:
        """Draw the ground below the robot: cross lines every half metre, with their distance in x every metre."""
        axes, view = self._axes, self._camera.axes()
        torso = self._replay.positions[frame, 0]
        begin_x = float(self._replay.positions[0, 0, 0])

        def seen(x: float, y: float) -> FloatArray:
            return np.asarray((view @ np.array([x - float(torso[0]), y - float(torso[1]), 0.0]))[:2])

        size = self._span / _SPAN_M
        lane, reach = 1.6 * size, 4.0 * size
        # the lane stays in place while the robot drifts within it
        begin_y = float(self._replay.positions[0, 0, 1])
        middle = begin_y + lane * round((float(torso[1]) - begin_y) / lane)
        near, far = middle - lane, middle + lane
        corners = [seen(torso[0] + dx, y) for dx, y in ((-reach, near), (reach, near), (reach, far), (-reach, far))]
        axes.fill(*np.transpose(corners), color=_GROUND, lw=0, zorder=0)
        first = math.floor((float(torso[0]) - begin_x - 3.0 * size) * 2.0)
        for half in range(first, first + math.ceil(13 * size)):
            x = begin_x + half / 2.0
            axes.plot(
                *np.transpose([seen(x, near), seen(x, far)]),
                color=_LINE,
                lw=2.0 if half % 2 == 0 else 0.8,
                zorder=0.5,
            )
            if half % 2 == 0:
                right, up = seen(x + 0.06, middle - 0.75 * size)
                axes.text(right, up, f"{half // 2} m", fontsize=9, color="#7c8573", zorder=0.6, clip_on=True)


def write_mp4(replay: Replay, path: Path, *, frames: Sequence[int] | None = None) -> None:
    """Write a replay as an H.264 film in real time, 50 pictures a second.

    Raises:
        OSError: if imageio-ffmpeg is not installed.
    """
    try:
        import imageio_ffmpeg  # type: ignore[import-untyped]
    except ImportError as error:
        raise OSError("a film needs imageio-ffmpeg: pip install naosprint[film], or omit the film") from error

    chosen = range(len(replay.positions)) if frames is None else frames
    writer = imageio_ffmpeg.write_frames(
        str(path),
        (WIDTH_PX, HEIGHT_PX),
        fps=round(1.0 / STEP_S),
        codec="libx264",
        quality=None,
        macro_block_size=2,
        output_params=["-crf", "24", "-preset", "medium", "-movflags", "+faststart"],
        ffmpeg_log_level="error",
    )
    writer.send(None)
    try:
        for picture in _pictures(replay, chosen):
            writer.send(np.ascontiguousarray(picture))
    finally:
        writer.close()


def write_gif(replay: Replay, path: Path, *, frames: Sequence[int]) -> None:
    """Write every other of the chosen steps as an endless GIF of half the size, in real time."""
    from PIL import Image

    images = [
        Image.fromarray(picture).resize((WIDTH_PX // 2, HEIGHT_PX // 2), Image.Resampling.LANCZOS)
        for picture in _pictures(replay, list(frames)[::2])
    ]
    # one palette for all pictures, so that flat areas do not flicker
    palette = images[0].quantize(96)
    flat = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    flat[0].save(path, save_all=True, append_images=flat[1:], duration=round(2000 * STEP_S), loop=0, optimize=True)


def _pictures(replay: Replay, frames: Sequence[int]) -> Iterator[ByteArray]:
    film = Film(replay)
    for frame in frames:
        yield film.picture(frame)
