"""Films of games: all robots and the ball in three dimensions, from a game's log, by a camera that follows the ball."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.font_manager import findfont
from naosim import robots
from naosim.fields import RCSSSERVERMJ as FIELD
from naosim.mujoco.shapes import body_poses, shapes_of
from naosim.mujoco.world import world_of
from naosim.robots import Shape
from PIL import Image, ImageDraw, ImageFont

from naosprint.analysis.film import write_film
from naosprint.matches.results import FRAME_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from naosprint.arrays import ByteArray, FloatArray
    from naosprint.matches.log import GameLog

WIDTH_PX, HEIGHT_PX = 960, 540
"""Size of a picture."""

_SAMPLES = 2
"""Factor of supersampling, which smooths edges."""
_TEAM_COLOURS = ((0.20, 0.47, 0.78), (0.87, 0.45, 0.13))
_BODY_COLOUR = (0.80, 0.82, 0.85)
_BALL_COLOUR = (0.98, 0.98, 0.96)
_TURF, _STRIPE, _LINE, _SHADOW, _POST = (84, 128, 74), (90, 136, 79), (226, 234, 222), (66, 103, 58), (248, 248, 246)
_LIGHT = np.array([0.35, -0.55, 0.76])
_BACK_M, _UP_M, _FOCUS = 15.0, 8.0, 2.3
"""Distance of the camera from what it looks at, to the side and up; focal length in widths of half a picture."""
_SLOW_S = 1.2
"""Time over which the way of the camera is averaged."""
_NEAR_M = 0.3
_LOOK_M = 13.0
"""Most distance of what the camera looks at from the middle of the field, across."""
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
_NORMALS = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], float)


@dataclass(frozen=True)
class _Solids:
    """Shapes of one frame, all robots' together.

    Attributes:
        shapes: what they are.
        centre: (N, 3) positions.
        rotation: (N, 3, 3) orientations.
        colour: (N, 3) red, green, blue, 0 to 1.
    """

    shapes: Sequence[Shape]
    centre: FloatArray
    rotation: FloatArray
    colour: FloatArray


class _Lens:
    """A camera in one frame: projects points of the field to pixels."""

    def __init__(self, look_at: FloatArray) -> None:
        self._eye = np.array([0.85 * look_at[0], look_at[1] - _BACK_M, _UP_M])
        ahead = np.array([look_at[0], look_at[1], 0.3]) - self._eye
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self.axes = np.stack([right, np.cross(right, ahead), ahead])
        self.scale = _FOCUS * _SAMPLES * WIDTH_PX / 2.0

    def towards(self, points: FloatArray) -> FloatArray:
        """Return the vectors from points to the camera."""
        return self._eye - points

    def seen(self, points: FloatArray) -> FloatArray:
        """Return (..., 3) coordinates of points to the right, up, and ahead of the camera, metres."""
        return np.asarray((points - self._eye) @ self.axes.T)

    def pixels(self, seen: FloatArray) -> FloatArray:
        """Return (..., 2) pixels of what is in front of the camera."""
        depth = np.maximum(seen[..., 2:], _NEAR_M)
        middle = _SAMPLES * np.array([WIDTH_PX, HEIGHT_PX]) / 2.0
        return np.asarray(middle + self.scale * seen[..., :2] / depth * [1.0, -1.0])


class GameFilm:
    """Pictures of a game.

    Args:
        log: the game.
    """

    def __init__(self, log: GameLog) -> None:
        self._log = log
        self._look_at = _camera_way(log)
        self._worlds = {}
        for model, count in (("t1", 23), ("k1", 22)):
            if log.joints_rad.shape[2] == count:
                self._worlds[model] = world_of(robots.get(model))
        self._shapes = {model: shapes_of(model.upper()) for model in self._worlds}
        font, mono = findfont("DejaVu Sans"), findfont("DejaVu Sans Mono")
        self._board = ImageFont.truetype(mono, 18 * _SAMPLES)
        self._label = ImageFont.truetype(font, 11 * _SAMPLES)

    def picture(self, frame: int) -> ByteArray:
        """Return the (HEIGHT_PX, WIDTH_PX, 3) picture of a frame."""
        image = Image.new("RGB", (WIDTH_PX * _SAMPLES, HEIGHT_PX * _SAMPLES), _TURF)
        draw = ImageDraw.Draw(image)
        lens = _Lens(self._look_at[frame])
        _draw_turf(draw, lens)
        _draw_field(draw, lens)
        solids = self._solids(frame)
        _draw_shadows(draw, lens, solids)
        _draw_solids(draw, lens, solids)
        self._draw_numbers(draw, lens, frame)
        self._draw_board(draw, frame)
        return np.asarray(image.reduce(_SAMPLES))

    def _solids(self, frame: int) -> _Solids:
        """Return the shapes of all robots on the field, and the ball."""
        log = self._log
        shapes: list[Shape] = [Shape("ball", "sphere", (FIELD.ball_radius_m, 0.0, 0.0))]
        centres, quaternions = [log.ball_m[frame, None].astype(float)], [np.array([[1.0, 0.0, 0.0, 0.0]])]
        colours: list[tuple[float, float, float]] = [_BALL_COLOUR]
        here = np.flatnonzero(log.present[frame])
        for model, world in self._worlds.items():
            rows = np.concatenate(
                [log.torso_m[frame, here], log.quaternion[frame, here], log.joints_rad[frame, here]], axis=1
            ).astype(float)
            poses = body_poses(world, rows)
            for robot, pose in zip(here, poses, strict=True):
                team = _TEAM_COLOURS[log.robots[robot][0]]
                shapes += self._shapes[model]
                colours += [team if each.side == "centre" else _BODY_COLOUR for each in self._shapes[model]]
                centres.append(pose[:, :3])
                quaternions.append(pose[:, 3:])
        return _Solids(shapes, np.concatenate(centres), _rotations(np.concatenate(quaternions)), np.array(colours))

    def _draw_numbers(self, draw: ImageDraw.ImageDraw, lens: _Lens, frame: int) -> None:
        """Write the uniform numbers above the robots."""
        log = self._log
        for robot in np.flatnonzero(log.present[frame]):
            team, number = log.robots[robot]
            seen = lens.seen(log.torso_m[frame, robot] + np.array([0.0, 0.0, 0.75]))
            if seen[2] > _NEAR_M:
                x, y = lens.pixels(seen).tolist()
                colour = tuple(round(255 * value) for value in _TEAM_COLOURS[team])
                draw.text((x, y), str(number), fill=colour, font=self._label, anchor="ms", stroke_width=3)
                draw.text((x, y), str(number), fill="#ffffff", font=self._label, anchor="ms")

    def _draw_board(self, draw: ImageDraw.ImageDraw, frame: int) -> None:
        """Write teams, score and clock into the upper left corner."""
        log, unit = self._log, _SAMPLES
        clock = int(log.clock_s[frame])
        goals = f"{log.score[frame, 0]} : {log.score[frame, 1]}"
        x = 16 * unit
        names = [name if len(name) <= 28 else name[:27] + "…" for name in log.teams]
        for text, colour in (
            (names[0], _TEAM_COLOURS[0]),
            (goals, (0.1, 0.1, 0.1)),
            (names[1], _TEAM_COLOURS[1]),
            (f"{log.half[frame] + 1}. {clock // 60}:{clock % 60:02}", (0.35, 0.35, 0.35)),
        ):
            width = draw.textlength(text, font=self._board)
            fill = tuple(round(255 * value) for value in colour)
            draw.rectangle((x, 14 * unit, x + width + 20 * unit, 42 * unit), fill=fill)
            draw.text((x + 10 * unit, 28 * unit), text, fill="#ffffff", font=self._board, anchor="lm")
            x += int(width) + 20 * unit


def write_game_film(
    log: GameLog, path: Path, *, frames: Sequence[int] | None = None, stop: Callable[[], None] = lambda: None
) -> None:
    """Write a game as an H.264 film in real time, 25 pictures a second.

    Args:
        log: the game.
        path: file to write.
        frames: indices of the frames to show; all of them without any.
        stop: called before each picture; what it raises ends the film.

    Raises:
        OSError: if imageio-ffmpeg is not installed.
        ValueError: if ``frames`` is empty.
    """
    chosen = range(len(log.mode)) if frames is None else frames
    if not len(chosen):
        raise ValueError("a film needs a frame")
    film = GameFilm(log)

    def pictures() -> Iterator[ByteArray]:
        for frame in chosen:
            stop()
            yield film.picture(frame)

    write_film(path, pictures(), size=(WIDTH_PX, HEIGHT_PX), rate=round(1.0 / FRAME_S))


def film_name(game: int) -> str:
    """Return the name of a game's film; games are counted from 1."""
    return f"game-{game:03}.mp4"


def goal_frames(log: GameLog, before_s: float = 8.0, after_s: float = 2.0) -> list[int]:
    """Return the frames around all goals, in order and each once."""
    scored = np.flatnonzero((np.diff(log.score.astype(int), axis=0) > 0).any(axis=1)) + 1
    chosen = np.zeros(len(log.mode), bool)
    for frame in scored:
        first, last = frame - round(before_s / FRAME_S), frame + round(after_s / FRAME_S)
        near = slice(max(0, first), last)
        chosen[near] |= log.half[near] == log.half[frame]
    return [int(frame) for frame in np.flatnonzero(chosen)]


def _camera_way(log: GameLog) -> FloatArray:
    """Return (T, 2) what the camera looks at: the ball on a smoothed way, which starts again in each half."""
    ball = np.clip(log.ball_m[:, :2], -FIELD.length_m / 2, FIELD.length_m / 2).astype(float)
    ball[:, 1] = np.clip(ball[:, 1], -_LOOK_M, _LOOK_M)
    reach = round(_SLOW_S / FRAME_S)
    kernel = np.hanning(2 * reach + 1)
    kernel /= kernel.sum()
    way = np.empty_like(ball)
    for half in np.unique(log.half):
        here = log.half == half
        padded = np.pad(ball[here], ((reach, reach), (0, 0)), mode="edge")
        way[here] = np.stack([np.convolve(column, kernel, mode="valid") for column in padded.T], axis=1)
    return way


def _rotations(quaternions: FloatArray) -> FloatArray:
    """Return (N, 3, 3) matrices of (N, 4) quaternions w, x, y, z."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


# --- drawing ----------------------------------------------------------------------------------------------------------


def _draw_turf(draw: ImageDraw.ImageDraw, lens: _Lens) -> None:
    """Draw the mown strips, which show how the camera moves."""
    reach, width = FIELD.width_m, FIELD.length_m / 10
    for strip in range(-7, 7):
        left, right = (2 * strip) * width / 2, (2 * strip + 1) * width / 2
        corners = np.array([[left, -reach, 0.0], [right, -reach, 0.0], [right, reach, 0.0], [left, reach, 0.0]])
        seen = lens.seen(corners)
        seen[:, 2] = np.maximum(seen[:, 2], _NEAR_M)
        draw.polygon(lens.pixels(seen).ravel().tolist(), fill=_STRIPE)


def _draw_field(draw: ImageDraw.ImageDraw, lens: _Lens) -> None:
    """Draw lines, circle and goals."""
    turn = np.linspace(0.0, 2.0 * math.pi, 49)
    ring = FIELD.circle_radius_m * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    lines = np.array([[[x0, y0, 0.0], [x1, y1, 0.0]] for x0, y0, x1, y1 in FIELD.lines()])
    for begin, end in [*lines, *itertools.pairwise(ring)]:
        _draw_line(draw, lens, begin, end, FIELD.line_width_m, _LINE)
    post, bar, deep = FIELD.goal.width_m / 2, FIELD.goal.height_m, FIELD.goal.depth_m
    for side in (-1.0, 1.0):
        x = side * FIELD.length_m / 2
        back = x + side * deep
        for y in (-post, post):  # what the net hangs from
            _draw_line(draw, lens, np.array([x, y, bar]), np.array([back, y, 0.0]), 0.03, _LINE)
        _draw_line(draw, lens, np.array([back, -post, 0.0]), np.array([back, post, 0.0]), 0.03, _LINE)
        frame = np.array([[x, -post, 0.0], [x, -post, bar], [x, post, bar], [x, post, 0.0]])
        for begin, end in itertools.pairwise(frame):
            _draw_line(draw, lens, begin, end, 2.0 * FIELD.goal.post_radius_m, _POST)


def _draw_line(
    draw: ImageDraw.ImageDraw,
    lens: _Lens,
    begin: FloatArray,
    end: FloatArray,
    width_m: float,
    colour: tuple[int, int, int],
) -> None:
    """Draw the part of a straight line that is in front of the camera."""
    ends = lens.seen(np.stack([begin, end]))
    depth = ends[:, 2]
    if depth.max() <= _NEAR_M:
        return
    if depth.min() < _NEAR_M:  # cut it off at the nearest depth
        share = (_NEAR_M - depth[0]) / (depth[1] - depth[0])
        ends[int(depth.argmin())] = ends[0] + share * (ends[1] - ends[0])
    width = max(1, round(width_m * lens.scale / max(float(ends[:, 2].mean()), _NEAR_M)))
    (x0, y0), (x1, y1) = lens.pixels(ends).tolist()
    draw.line((x0, y0, x1, y1), fill=colour, width=width)


def _draw_shadows(draw: ImageDraw.ImageDraw, lens: _Lens, solids: _Solids) -> None:
    """Draw a disc on the ground below each shape."""
    turn = np.linspace(0.0, 2.0 * math.pi, 10, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    radius = np.array([_girth(shape) for shape in solids.shapes])
    ground = solids.centre * [1.0, 1.0, 0.0]
    seen = lens.seen(ground[:, None] + radius[:, None, None] * ring)
    for points, depth in zip(lens.pixels(seen), seen[..., 2].min(axis=1), strict=True):
        if depth > _NEAR_M:
            draw.polygon(points.ravel().tolist(), fill=_SHADOW)


def _girth(shape: Shape) -> float:
    """Return the radius of a shape across its longest axis."""
    return 0.5 * sorted(shape.size_m)[1] if shape.kind == "box" else shape.size_m[0]


def _draw_solids(draw: ImageDraw.ImageDraw, lens: _Lens, solids: _Solids) -> None:
    """Draw all shapes, the farthest first."""
    seen = lens.seen(solids.centre)
    for i in np.argsort(-seen[:, 2]):
        if seen[i, 2] <= 2.0 * _NEAR_M:
            continue
        shape, rotation, colour = solids.shapes[i], solids.rotation[i], solids.colour[i]
        if shape.kind == "box":
            _draw_box(draw, lens, shape, solids.centre[i], rotation, colour)
        else:
            _draw_round(draw, lens, shape, solids.centre[i], rotation, colour)


def _draw_box(
    draw: ImageDraw.ImageDraw,
    lens: _Lens,
    shape: Shape,
    centre: FloatArray,
    rotation: FloatArray,
    colour: FloatArray,
) -> None:
    corners = (_CORNERS * shape.size_m) @ rotation.T + centre
    normals = _NORMALS @ rotation.T
    middles = corners[_FACES].mean(axis=1)
    facing = np.einsum("fi,fi->f", normals, lens.towards(middles)) > 0.0
    pixels = lens.pixels(lens.seen(corners))
    for face in np.flatnonzero(facing):
        draw.polygon(pixels[_FACES[face]].ravel().tolist(), fill=_shade(colour, normals[face]))


def _draw_round(
    draw: ImageDraw.ImageDraw,
    lens: _Lens,
    shape: Shape,
    centre: FloatArray,
    rotation: FloatArray,
    colour: FloatArray,
) -> None:
    """Draw a sphere, or a capsule or cylinder as a thick line with round ends."""
    radius, length, _ = shape.size_m
    axis = rotation[:, 2] * (length / 2.0 if shape.kind != "sphere" else 0.0)
    ends = lens.seen(np.stack([centre - axis, centre + axis]))
    (x0, y0), (x1, y1) = lens.pixels(ends).tolist()
    reach = radius * lens.scale / max(float(ends[:, 2].mean()), _NEAR_M)
    towards = lens.towards(centre)
    across = towards - (towards @ rotation[:, 2]) * rotation[:, 2] if shape.kind != "sphere" else towards
    fill = _shade(colour, across / max(float(np.linalg.norm(across)), 1e-9))
    if shape.kind != "sphere":
        draw.line((x0, y0, x1, y1), fill=fill, width=max(1, round(2.0 * reach)))
    for x, y in ((x0, y0), (x1, y1)):
        draw.ellipse((x - reach, y - reach, x + reach, y + reach), fill=fill)


def _shade(colour: FloatArray, normal: FloatArray) -> tuple[int, int, int]:
    bright = 0.62 + 0.38 * max(float(normal @ _LIGHT), 0.0)
    red, green, blue = (round(255.0 * value) for value in np.clip(colour * bright, 0.0, 1.0).tolist())
    return red, green, blue
