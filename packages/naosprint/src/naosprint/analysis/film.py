"""Films of replays."""

from __future__ import annotations

import contextlib
import itertools
import math
import subprocess
import tempfile
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.font_manager import findfont
from naosim.simulator import STEP_S
from naospec.files import partial_of, publish, replacing
from PIL import Image, ImageDraw, ImageFont

from naosprint.analysis.scene import Camera, robot_polygons, scale

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from naosprint.analysis.replay import Replay
    from naosprint.arrays import ByteArray, FloatArray

WIDTH_PX, HEIGHT_PX = 960, 400
"""Size of a picture; both even, as H.264 requires."""

SPEED_STEPS = 25
"""Steps over which the displayed speed is averaged: half a second."""

_SAMPLES = 2  # factor of supersampling, which smooths edges
_SPAN_M = 2.6  # width of the picture for a robot of unit size
_GROUND = "#eef1ea"
_LINE = "#c3cab9"
_LABEL = "#7c8573"
_CHALK = "#ffffff"


class Film:
    """Pictures of a replay, taken by a camera that follows the robot."""

    def __init__(self, replay: Replay) -> None:
        self._replay = replay
        self._span = _SPAN_M * scale(replay)
        self._camera = Camera(azimuth_deg=-14.0, elevation_deg=9.0)
        self._pixels_per_m = _SAMPLES * WIDTH_PX / self._span
        mono, sans = findfont("DejaVu Sans Mono"), findfont("DejaVu Sans")
        self._caption_font = ImageFont.truetype(mono, 18 * _SAMPLES)
        self._label_font = ImageFont.truetype(sans, 12 * _SAMPLES)

    def caption(self, frame: int) -> str:
        """Return what a picture shows: time, distance from the start, speed of the last half second."""
        recent = max(0, frame - SPEED_STEPS)
        speed = self._replay.moved_m(recent, frame) / max(frame - recent, 1) / STEP_S
        return f"{frame * STEP_S:5.2f} s    {self._replay.moved_m(0, frame):5.2f} m    {speed:4.2f} m/s"

    def picture(self, frame: int) -> ByteArray:
        """Return the (HEIGHT_PX, WIDTH_PX, 3) picture of one step, with its caption."""
        image = Image.new("RGB", (WIDTH_PX * _SAMPLES, HEIGHT_PX * _SAMPLES), "white")
        draw = ImageDraw.Draw(image)
        self._ground(draw, frame)
        for polygon in robot_polygons(self._replay, frame, self._camera):
            draw.polygon(self._places(polygon.points), _rgb(polygon.fill), _rgb(polygon.edge))
        at = (0.02 * image.width, 0.07 * image.height)
        draw.text(at, self.caption(frame), fill="#22262b", font=self._caption_font)
        return np.asarray(image.reduce(_SAMPLES))

    def _places(self, points: FloatArray) -> list[tuple[float, float]]:
        """Return pixels of (k, 2) points in metres: the origin is in the middle, 28 % of the height from the bottom."""
        x = _SAMPLES * WIDTH_PX / 2.0 + points[:, 0] * self._pixels_per_m
        y = 0.72 * _SAMPLES * HEIGHT_PX - points[:, 1] * self._pixels_per_m
        return list(zip(x.tolist(), y.tolist(), strict=True))

    def _ground(self, draw: ImageDraw.ImageDraw, frame: int) -> None:
        """Draw the ground below the robot: cross lines every half metre, with their distance in x every metre."""
        view = self._camera.axes()
        torso = self._replay.positions[frame, 0]
        begin_x, begin_y = (float(value) for value in self._replay.positions[0, 0, :2])

        def seen(*points: tuple[float, ...]) -> list[tuple[float, float]]:
            ground = np.array([[x - float(torso[0]), y - float(torso[1]), sum(z)] for x, y, *z in points])
            return self._places((ground @ view.T)[:, :2])

        size = self._span / _SPAN_M
        lane, reach = 1.6 * size, 4.0 * size
        # it stays where it is while the robot drifts, unless it drifts out of it
        middle = begin_y + lane * round((float(torso[1]) - begin_y) / lane)
        near, far = middle - lane, middle + lane
        left, right = float(torso[0]) - reach, float(torso[0]) + reach
        draw.polygon(seen((left, near), (right, near), (right, far), (left, far)), fill=_GROUND)
        self._field(draw, seen, (left, near, right, far))
        first = math.floor((float(torso[0]) - begin_x - 3.0 * size) * 2.0)
        for half in range(first, first + math.ceil(13 * size)):
            x = begin_x + half / 2.0
            whole = half % 2 == 0
            draw.line(seen((x, near), (x, far)), fill=_LINE, width=_SAMPLES * (3 if whole else 1))
            if whole:
                (place,) = seen((x + 0.06, middle - 0.75 * size))
                draw.text(place, f"{half // 2} m", fill=_LABEL, font=self._label_font, anchor="ls")

    def _field(
        self,
        draw: ImageDraw.ImageDraw,
        seen: Callable[..., list[tuple[float, float]]],
        patch: tuple[float, float, float, float],
    ) -> None:
        """Draw what is in a patch of the ground of the field's lines and goals."""
        field = self._replay.robot.field
        left, near, right, far = patch
        width = max(1, round(field.line_width_m * self._pixels_per_m / 3.0))  # the ground is seen from a low angle
        for x0, y0, x1, y1 in field.lines():
            if x0 <= right and x1 >= left and y0 <= far and y1 >= near:
                ends = (max(x0, left), max(y0, near)), (min(x1, right), min(y1, far))
                draw.line(seen(*ends), fill=_CHALK, width=width)
        turn = np.linspace(0.0, 2.0 * math.pi, 73)
        ring = np.column_stack([np.cos(turn), np.sin(turn)]) * field.circle_radius_m
        for start, end in itertools.pairwise(ring.tolist()):
            if all(left <= x <= right and near <= y <= far for x, y in (start, end)):
                draw.line(seen(start, end), fill=_CHALK, width=width)
        post, bar = field.goal.width_m / 2, field.goal.height_m
        width = max(1, round(2.0 * field.goal.post_radius_m * self._pixels_per_m))
        for x in (-field.length_m / 2, field.length_m / 2):
            if left <= x <= right and near <= -post and post <= far:
                frame = seen((x, -post, 0.0), (x, -post, bar), (x, post, bar), (x, post, 0.0))
                draw.line(frame, fill=_CHALK, width=width, joint="curve")


def _rgb(colour: tuple[float, float, float, float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * value) for value in colour[:3])
    return red, green, blue


def write_mp4(replay: Replay, path: Path, *, frames: Sequence[int] | None = None) -> Path:
    """Write a replay as an H.264 film in real time, 50 pictures a second; return the path as `write_film` does.

    Raises:
        OSError: if imageio-ffmpeg is not installed.
    """
    chosen = range(len(replay.positions)) if frames is None else frames
    return write_film(path, _pictures(replay, chosen), size=(WIDTH_PX, HEIGHT_PX), rate=round(1.0 / STEP_S))


def write_film(path: Path, pictures: Iterable[ByteArray], *, size: tuple[int, int], rate: int) -> Path:
    """Write pictures as an H.264 film and return the path of the file, which is another one within ``together``.

    Args:
        path: file to write.
        pictures: (height, width, 3) each.
        size: width and height, both even.
        rate: pictures a second.

    Raises:
        OSError: if imageio-ffmpeg is not installed, or the file cannot be written whole.
    """
    try:
        from imageio_ffmpeg import get_ffmpeg_exe  # type: ignore[import-untyped]
    except ImportError as error:
        raise OSError("a film needs imageio-ffmpeg: pip install naosprint[film], or omit the film") from error

    partial = partial_of(path)
    pixels = f"-f rawvideo -pix_fmt rgb24 -s {size[0]}x{size[1]} -r {rate}"
    coded = "-an -c:v libx264 -pix_fmt yuv420p -crf 24 -preset medium -movflags +faststart -f mp4"
    command = [get_ffmpeg_exe(), "-y", "-v", "error", *pixels.split(), "-i", "-", *coded.split(), str(partial)]
    try:
        with tempfile.TemporaryFile() as errors:
            with (
                contextlib.suppress(BrokenPipeError),  # it has ended; its status says so
                subprocess.Popen(command, stdin=subprocess.PIPE, stderr=errors) as ffmpeg,
            ):
                assert ffmpeg.stdin is not None
                for picture in pictures:
                    ffmpeg.stdin.write(np.ascontiguousarray(picture).data)
            errors.seek(0)
            if ffmpeg.returncode != 0:
                reason = errors.read().decode(errors="replace").strip().rpartition("] ")[2]
                raise OSError(f"{path}: {reason or f'ffmpeg ended with status {ffmpeg.returncode}'}")
        return publish(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def write_gif(replay: Replay, path: Path, *, frames: Sequence[int]) -> None:
    """Write every other of the chosen steps as an endless GIF of half the size, in real time."""
    images = [
        Image.fromarray(picture).resize((WIDTH_PX // 2, HEIGHT_PX // 2), Image.Resampling.LANCZOS)
        for picture in _pictures(replay, list(frames)[::2])
    ]
    # one palette for all pictures, so that flat areas do not flicker
    palette = images[0].quantize(96)
    flat = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    duration = round(2000 * STEP_S)
    with replacing(path) as file:
        flat[0].save(file, "GIF", save_all=True, append_images=flat[1:], duration=duration, loop=0, optimize=True)


def _pictures(replay: Replay, frames: Sequence[int]) -> Iterator[ByteArray]:
    film = Film(replay)
    for frame in frames:
        yield film.picture(frame)
