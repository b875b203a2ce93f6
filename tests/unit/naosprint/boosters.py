"""Booster robots whose left and right sides are mirror images, for tests of symmetry.

Real ones are not exactly symmetric: the inertia of their sides differs, and MuJoCo's iterative search for contacts
between two limbs gives mirrored limbs contacts that differ by 1e-5. Contacts with the ground are exact.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from naosim.mujoco.embedded import MujocoSimulator
from naosim.mujoco.settings import BoosterEmbeddedParameters
from naosim.mujoco.world import library
from naosim.robots import Robot
from naosim.simulator import Starts
from naosprint.mirror import Mirror
from naosprint.tasks.base import Task
from naosprint.tasks.environment import Environment

_ACROSS = np.array([1.0, -1.0, 1.0])


def symmetric_environment(robot: Robot, task: type[Task], n: int = 2, **settings: Any) -> Environment:
    """Return n robots with full-precision perceptors, whose right sides are the mirror images of their left ones.

    The exact world steps the model itself, so the changes count; the engine of trainings has read its numbers before.
    """
    simulator = MujocoSimulator(robot, n, BoosterEmbeddedParameters(truncate=False, engine="mujoco"))
    make_symmetric(simulator.world.model)
    model, geoms = simulator.world.model, simulator.world.geoms
    model.geom_contype[geoms], model.geom_conaffinity[geoms] = 2, 1  # no contacts between limbs
    parameters = task.resolve(task.Parameters(name=task.name, **settings), robot)
    return Environment(simulator, task, parameters)


def make_symmetric(model: Any) -> None:
    """Mirror the inertia of left bodies to the right, and make that of central ones symmetric, in place."""
    mujoco = library()
    names = [model.body(body).name for body in range(model.nbody)]
    for body, name in enumerate(names):
        other = _mirrored(name)
        if name != other:
            source = names.index(other)
            if body < source:  # the left side comes first
                continue
            model.body_mass[body] = model.body_mass[source]
            model.body_inertia[body] = model.body_inertia[source]
            model.body_ipos[body] = model.body_ipos[source] * _ACROSS
            model.body_iquat[body] = model.body_iquat[source] * [1, -1, 1, -1]
            continue
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.body_iquat[body])
        axes = rotation.reshape(3, 3)
        inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
        inertia[1, [0, 2]] = inertia[[0, 2], 1] = 0.0
        # about y, and about two axes in the plane of symmetry
        half = 0.5 * np.arctan2(2.0 * inertia[0, 2], inertia[0, 0] - inertia[2, 2])
        x, z = np.array([np.cos(half), 0.0, np.sin(half)]), np.array([-np.sin(half), 0.0, np.cos(half)])
        frame = np.stack([x, [0.0, 1.0, 0.0], z], axis=1)
        model.body_inertia[body] = np.diag(frame.T @ inertia @ frame)
        mujoco.mju_mat2Quat(model.body_iquat[body], frame.ravel())
        model.body_ipos[body] = model.body_ipos[body] * [1.0, 0.0, 1.0]
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _mirrored(name: str) -> str:
    for left, right in (("left", "right"), ("Left", "Right"), ("AL", "AR")):
        if left in name:
            return name.replace(left, right)
        if right in name:
            return name.replace(right, left)
    return name


def joint_mirror(robot: Robot) -> Mirror:
    """Return the mirror of angles of all joints, simulator signs."""
    partner = [robot.joint_names.index(joint.mirror) for joint in robot.joints]
    signs = [
        joint.mirror_sign * joint.sign * robot.joints[k].sign for joint, k in zip(robot.joints, partner, strict=True)
    ]
    return Mirror(np.array(partner, dtype=np.int64), np.array(signs))


def mirrored_pair(robot: Robot, pose_rad: np.ndarray, orientation: np.ndarray | None = None) -> Starts:
    """Return a start on the line y = 0 and its mirror image."""
    poses = np.stack([pose_rad, joint_mirror(robot).apply(pose_rad)])
    if orientation is None:
        return Starts(poses)
    return Starts(poses, orientations=np.stack([orientation, orientation * [1, -1, 1, -1]]))


def action_mirror(environment: Environment) -> Mirror:
    """Return the mirror of actions."""
    return Mirror.of_names(environment.actuation.names, *environment.actuation.mirror)
