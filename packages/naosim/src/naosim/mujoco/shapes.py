"""Poses of the shapes that stand for a robot when it is drawn: its colliding geoms, meshes as their bounding boxes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from naosim.mujoco.world import FEET, PREFIX, Floats, compiled, library
from naosim.robots.description import Shape, ShapeKind, Side
from naosim.simulator import PLAIN

if TYPE_CHECKING:
    from naosim.mujoco.world import MujocoWorld


def shapes_of(robot: str) -> tuple[Shape, ...]:
    """Return the shapes of a robot, ``T1`` or ``K1``, lengths rounded to 0.1 mm.

    Raises:
        naosim.mujoco.world.MujocoUnavailableError: if MuJoCo is missing or has another version.
    """
    kind = library().mjtGeom
    world = compiled(robot, "mujoco", PLAIN)
    found: dict[str, int] = {}
    shapes = []
    for geom in world.geoms:
        body = world.model.body(world.model.geom_bodyid[geom]).name.split("-", 1)[1]
        found[body] = found.get(body, 0) + 1
        name = body.lower() if found[body] == 1 else f"{body.lower()}_{found[body]}"
        a, b, c = world.model.geom_size[geom].tolist()
        drawn: ShapeKind = "box"
        size = (2 * a, 2 * b, 2 * c)
        match world.model.geom_type[geom]:
            case kind.mjGEOM_SPHERE.value:
                size, drawn = (a, 0.0, 0.0), "sphere"
            case kind.mjGEOM_CAPSULE.value:
                size, drawn = (a, 2 * b, 0.0), "capsule"
            case kind.mjGEOM_CYLINDER.value:
                size, drawn = (a, 2 * b, 0.0), "cylinder"
            case kind.mjGEOM_MESH.value:
                a, b, c = (2 * world.model.geom_aabb[geom, 3:]).tolist()
                size = (a, b, c)
        rounded = [round(length, 4) for length in size]
        shapes.append(Shape(name, drawn, (rounded[0], rounded[1], rounded[2]), _side(body)))
    return tuple(shapes)


def _side(body: str) -> Side:
    """Return the side of a body by its name in the model files: ``AL1``, ``Hip_Roll_Left``, ``left_hand_link``."""
    word = body.lower()
    if "left" in word or word.startswith("al"):
        return "left"
    return "right" if "right" in word or word.startswith("ar") else "centre"


def body_poses(world: MujocoWorld, coordinates: Floats) -> Floats:
    """Return (n, B, 7) poses of a robot's shapes, position and quaternion w, x, y, z.

    Args:
        world: the robot's world.
        coordinates: (n, 7 + J) torso position and quaternion, joint angles in radians.
    """
    mujoco = library()
    model, data, geoms = world.model, world.new_data(), world.geoms
    out = np.empty((len(coordinates), len(geoms), 7))
    # the bounding box of a mesh has its centre elsewhere than the mesh's own frame; that of the others is at its origin
    centres = model.geom_aabb[geoms, :3]
    for row, qpos in zip(out, coordinates, strict=True):
        data.qpos[world.torso :] = qpos
        mujoco.mj_kinematics(model, data)
        rotations = data.geom_xmat[geoms].reshape(-1, 3, 3)
        row[:, :3] = data.geom_xpos[geoms] + np.einsum("gij,gj->gi", rotations, centres)
        for pose, matrix in zip(row, data.geom_xmat[geoms], strict=True):
            mujoco.mju_mat2Quat(pose[3:], matrix)
    return out


def sole_heights(world: MujocoWorld, coordinates: Floats) -> Floats:
    """Return (n, 2) heights of the lowest point of left and right foot above the ground, metres.

    Args:
        world: the robot's world.
        coordinates: (n, 7 + J) torso position and quaternion, joint angles in radians.
    """
    mujoco = library()
    model, data = world.model, world.new_data()
    names = [model.body(body).name.removeprefix(PREFIX) for body in model.geom_bodyid]
    feet = [names.index(foot) for foot in FEET]  # a box each
    out = np.empty((len(coordinates), len(feet)))
    for row, qpos in zip(out, coordinates, strict=True):
        data.qpos[world.torso :] = qpos
        mujoco.mj_kinematics(model, data)
        down = data.geom_xmat[feet].reshape(-1, 3, 3)[:, 2]
        row[:] = data.geom_xpos[feet, 2] - np.einsum("gi,gi->g", np.abs(down), model.geom_size[feet])
    return out
