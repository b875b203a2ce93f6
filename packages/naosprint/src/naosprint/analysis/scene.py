"""Draw a robot of a replay with matplotlib: flat-shaded solids, back to front, over the ground they stand on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.collections import PolyCollection
from naosim.robots import nao_model

if TYPE_CHECKING:
    from naosim.robots.nao_model import Body

    from naosprint.arrays import FloatArray
    from naosprint.replay import Replay

LEFT_COLOUR = "#2c6fbb"
"""Colour of whatever belongs to the left side."""

RIGHT_COLOUR = "#d9772b"
"""Colour of whatever belongs to the right side."""

BODY_COLOUR = "#c9ced6"
"""Colour of torso, neck and head."""

_LIGHT = np.array([0.35, -0.55, 0.76])
_SHADOW = (0.80, 0.82, 0.84, 1.0)
# bodies that only carry a joint are smaller than a limb is thick; drawn so, limbs would come apart
_JOINT_RADIUS_M = 0.026
_DISC_SIDES = 20


@dataclass(frozen=True)
class Camera:
    """Look at the scene from afar, without perspective.

    Attributes:
        azimuth_deg: direction the camera stands in, counter-clockwise from the world's -y, so that 0 shows a robot that
            runs to +x from its right side, running to the right of the picture.
        elevation_deg: height above the horizon.
    """

    azimuth_deg: float = -22.0
    elevation_deg: float = 10.0

    def axes(self) -> FloatArray:
        """Return the (3, 3) rows: to the right of the picture, up in it, and towards the camera."""
        azimuth, elevation = np.radians([self.azimuth_deg, self.elevation_deg])
        right = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        level = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        towards = np.cos(elevation) * level + np.array([0.0, 0.0, np.sin(elevation)])
        up = np.cross(towards, right)
        return np.stack([right, up, towards])


@dataclass(frozen=True)
class _Face:
    points: FloatArray
    colour: tuple[float, float, float]
    depth: float


def robot_collection(
    replay: Replay, frame: int, camera: Camera, *, shift: tuple[float, float] = (0.0, 0.0)
) -> PolyCollection:
    """Return the polygons of the robot of one frame, and of its shadow, in metres of the picture.

    Args:
        replay: the episode.
        frame: index of the cycle.
        camera: where to look from.
        shift: where the point of the ground below the torso comes to lie, metres of the picture.
    """
    view = camera.axes()
    positions = replay.positions[frame].astype(np.float64)
    below = np.array([positions[0, 0], positions[0, 1], 0.0])
    shadows: list[FloatArray] = []
    faces: list[_Face] = []
    for body, position, quaternion in zip(
        nao_model.model(replay.robot_type).bodies, positions - below, replay.rotations[frame], strict=True
    ):
        rotation = _rotation(quaternion.astype(np.float64))
        base = np.array(_rgb(body))
        if body.shape.kind == "box":
            faces += _box(body, position, rotation, view, base)
            shadows += _shadows(_corners(body) @ rotation.T + position, view)
        else:
            faces.append(_disc(body, position, view, base))
    faces.sort(key=lambda face: face.depth)
    polygons = [points + shift for points in [*shadows, *(face.points for face in faces)]]
    colours = [_SHADOW] * len(shadows) + [(*face.colour, 1.0) for face in faces]
    edges = [(0.0, 0.0, 0.0, 0.0)] * len(shadows) + [(*(0.55 * np.array(face.colour)), 1.0) for face in faces]
    return PolyCollection(polygons, facecolors=colours, edgecolors=edges, linewidths=0.5, joinstyle="round")


def _rgb(body: Body) -> tuple[float, float, float]:
    from matplotlib.colors import to_rgb

    side = (body.limb or " ")[0]
    red, green, blue = to_rgb({"l": LEFT_COLOUR, "r": RIGHT_COLOUR}.get(side, BODY_COLOUR))
    return red, green, blue


def _rotation(quaternion: FloatArray) -> FloatArray:
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


_UNIT_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])

# corners of each face in turn, by their index in _UNIT_CORNERS
_BOX_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))


def _corners(body: Body) -> FloatArray:
    return np.asarray(_UNIT_CORNERS * np.array(body.shape.size))


def _box(body: Body, position: FloatArray, rotation: FloatArray, view: FloatArray, base: FloatArray) -> list[_Face]:
    half = np.array(body.shape.size) / 2.0
    faces = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            normal = rotation[:, axis] * side
            if normal @ view[2] <= 0.0:
                continue
            first, second = (axis + 1) % 3, (axis + 2) % 3
            local = np.zeros((4, 3))
            local[:, axis] = side * half[axis]
            local[:, first] = np.array([-1, 1, 1, -1]) * half[first]
            local[:, second] = np.array([-1, -1, 1, 1]) * half[second]
            points = local @ rotation.T + position
            seen = points @ view.T
            # a limb is sorted as a whole, by its centre, so that its own faces stay together
            depth = float(position @ view[2]) + 1e-4 * float(normal @ view[2])
            faces.append(_Face(seen[:, :2], _shade(base, normal), depth))
    return faces


def _disc(body: Body, position: FloatArray, view: FloatArray, base: FloatArray) -> _Face:
    radius = body.shape.size[0] if body.shape.collides else _JOINT_RADIUS_M
    turn = np.linspace(0.0, 2.0 * np.pi, _DISC_SIDES, endpoint=False)
    centre = position @ view.T
    points = centre[:2] + radius * np.column_stack([np.cos(turn), np.sin(turn)])
    return _Face(points, _shade(base, view[2]), float(centre[2]))


def _shade(base: FloatArray, normal: FloatArray) -> tuple[float, float, float]:
    bright = 0.62 + 0.38 * max(float(normal @ _LIGHT), 0.0)
    red, green, blue = np.clip(base * bright, 0.0, 1.0).tolist()
    return red, green, blue


def _shadows(corners: FloatArray, view: FloatArray) -> list[FloatArray]:
    """Return the picture of a box's six faces dropped straight down onto the ground; together they are its shadow."""
    flat = np.column_stack([corners[:, :2], np.zeros(len(corners))])
    seen = (flat @ view.T)[:, :2]
    return [seen[list(face)] for face in _BOX_FACES]
