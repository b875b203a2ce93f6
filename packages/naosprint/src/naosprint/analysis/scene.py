"""Drawing of a replay's robot with matplotlib: flat-shaded solids, back to front, over the ground they stand on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb

if TYPE_CHECKING:
    from naosim.robots import Shape

    from naosprint.analysis.replay import Replay
    from naosprint.arrays import FloatArray

LEFT_COLOUR = "#2c6fbb"
"""Colour of everything on the left side."""

RIGHT_COLOUR = "#d9772b"
"""Colour of everything on the right side."""

BODY_COLOUR = "#c9ced6"
"""Colour of torso, neck and head."""

OBJECT_COLOUR = "#f4f4f0"
"""Colour of what is not part of the robot, for example the ball."""

UNIT_TORSO_M, UNIT_TOP_M = 0.385, 0.53
"""Standing torso height of the robot that sizes in pictures are chosen for, and height of its head, metres."""

_COLOURS = {"left": LEFT_COLOUR, "right": RIGHT_COLOUR, "centre": BODY_COLOUR}
_LIGHT = np.array([0.35, -0.55, 0.76])
_SHADOW = (0.80, 0.82, 0.84, 1.0)
# parts that only connect two joints are smaller than a limb is thick; limbs would come apart if drawn so
_JOINT_RADIUS_M = 0.026
_SIDES = 20


@dataclass(frozen=True)
class Camera:
    """Orthographic camera.

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


def scale(replay: Replay) -> float:
    """Return the size of a replay's robot in pictures, 1 for one of :data:`UNIT_TORSO_M`."""
    top = float(replay.positions[:, : len(replay.robot.shapes), 2].max())
    return max(replay.robot.standing_height_m / UNIT_TORSO_M, top / UNIT_TOP_M)


@dataclass(frozen=True)
class Polygon:
    """Polygon of a drawing.

    Attributes:
        points: (k, 2) corners, metres of the picture.
        fill: red, green, blue, alpha, each 0 to 1.
        edge: colour of the outline.
    """

    points: FloatArray
    fill: tuple[float, float, float, float]
    edge: tuple[float, float, float, float]


def robot_collection(
    replay: Replay, frame: int, camera: Camera, *, shift: tuple[float, float] = (0.0, 0.0)
) -> PolyCollection:
    """Return the polygons of :func:`robot_polygons` for matplotlib."""
    polygons = robot_polygons(replay, frame, camera, shift=shift)
    fills, edges = [polygon.fill for polygon in polygons], [polygon.edge for polygon in polygons]
    points = [polygon.points for polygon in polygons]
    return PolyCollection(points, facecolors=fills, edgecolors=edges, linewidths=0.5, joinstyle="round")


def robot_polygons(
    replay: Replay, frame: int, camera: Camera, *, shift: tuple[float, float] = (0.0, 0.0)
) -> list[Polygon]:
    """Return the polygons of the robot of one frame, and of its shadow, in metres of the picture, back to front.

    Args:
        replay: the episode.
        frame: index of the step.
        camera: where to look from.
        shift: where the point of the ground below the torso appears, metres of the picture.
    """
    view = camera.axes()
    positions = replay.positions[frame].astype(np.float64)
    below = np.array([positions[0, 0], positions[0, 1], 0.0])
    size = scale(replay)
    shadows: list[FloatArray] = []
    faces: list[_Face] = []
    parts = len(replay.robot.shapes)
    for number, (shape, position, quaternion) in enumerate(
        zip(replay.shapes, positions - below, replay.rotations[frame], strict=True)
    ):
        rotation = _rotation(quaternion.astype(np.float64))
        red, green, blue = to_rgb(_COLOURS[shape.side] if number < parts else OBJECT_COLOUR)
        base = np.array([red, green, blue])
        if shape.kind == "sphere":
            radius = shape.size_m[0]
            if number < parts:
                radius = max(radius, _JOINT_RADIUS_M * size)
            else:
                ground = np.column_stack([position[:2] + radius * _circle(), np.zeros(_SIDES)])
                shadows.append((ground @ view.T)[:, :2])
            centre = position @ view.T
            disc = centre[:2] + radius * _circle()
            faces.append(_Face(disc, _shade(base, view[2]), float(centre[2])))
            continue
        outline = _outline(shape) @ rotation.T + position
        shadows.append(_hull((np.column_stack([outline[:, :2], np.zeros(len(outline))]) @ view.T)[:, :2]))
        if shape.kind == "box":
            faces += _box(shape, position, rotation, view, base)
        else:
            faces += _round(shape, outline, position, rotation, view, base)
    faces.sort(key=lambda face: face.depth)
    found = [Polygon(points + shift, _SHADOW, _SHADOW) for points in shadows]
    for face in faces:
        red, green, blue = face.colour
        found.append(Polygon(face.points + shift, (*face.colour, 1.0), (0.55 * red, 0.55 * green, 0.55 * blue, 1.0)))
    return found


def _rotation(quaternion: FloatArray) -> FloatArray:
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _circle() -> FloatArray:
    """Return the (k, 2) points of a unit circle."""
    turn = np.linspace(0.0, 2.0 * np.pi, _SIDES, endpoint=False)
    return np.column_stack([np.cos(turn), np.sin(turn)])


def _outline(shape: Shape) -> FloatArray:
    """Return (k, 3) points in the shape's frame whose convex hull is the shape, or near it for a capsule."""
    if shape.kind == "box":
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        return np.asarray(corners * np.array(shape.size_m))
    radius, length, _ = shape.size_m
    rings = [(radius, length / 2.0)]
    if shape.kind == "capsule":
        rings += [(radius * np.cos(angle), length / 2.0 + radius * np.sin(angle)) for angle in (0.5, 1.0, np.pi / 2)]
    ring = _circle()
    return np.concatenate(
        [
            np.column_stack([width * ring, np.full(_SIDES, end * height)])
            for width, height in rings
            for end in (-1.0, 1.0)
        ]
    )


def _hull(points: FloatArray) -> FloatArray:
    """Return the convex hull of (k, 2) points, counter-clockwise (Andrew's monotone chain)."""
    ordered = points[np.lexsort((points[:, 1], points[:, 0]))].tolist()

    def chain(line: list[list[float]]) -> list[list[float]]:
        kept: list[list[float]] = []
        for x, y in line:
            while len(kept) > 1:
                (ax, ay), (bx, by) = kept[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0.0:
                    break
                kept.pop()
            kept.append([x, y])
        return kept[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]))


def _box(shape: Shape, position: FloatArray, rotation: FloatArray, view: FloatArray, base: FloatArray) -> list[_Face]:
    half = np.array(shape.size_m) / 2.0
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


def _round(
    shape: Shape, outline: FloatArray, position: FloatArray, rotation: FloatArray, view: FloatArray, base: FloatArray
) -> list[_Face]:
    """Return the outline of a capsule or cylinder, and the end of a cylinder that faces the camera."""
    depth = float(position @ view[2])
    axis = rotation[:, 2]
    across = view[2] - (view[2] @ axis) * axis
    facing = across / max(float(np.linalg.norm(across)), 1e-9)
    faces = [_Face(_hull((outline @ view.T)[:, :2]), _shade(base, facing), depth)]
    if shape.kind == "cylinder":
        end = 1.0 if axis @ view[2] > 0.0 else -1.0
        radius, length, _ = shape.size_m
        ring = np.column_stack([radius * _circle(), np.full(_SIDES, end * length / 2.0)])
        points = ((ring @ rotation.T + position) @ view.T)[:, :2]
        faces.append(_Face(points, _shade(base, end * axis), depth + 1e-4))
    return faces


def _shade(base: FloatArray, normal: FloatArray) -> tuple[float, float, float]:
    bright = 0.62 + 0.38 * max(float(normal @ _LIGHT), 0.0)
    red, green, blue = np.clip(base * bright, 0.0, 1.0).tolist()
    return red, green, blue
