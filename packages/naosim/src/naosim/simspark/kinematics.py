"""Poses of a NAO's bodies from its torso's pose and its joint angles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from naosim.robots.nao_model import RobotModel
    from naosim.simulator import Floats


def body_poses(model: RobotModel, torso_position: Floats, torso_rotation: Floats, joint_angles_deg: Floats) -> Floats:
    """Return the poses of all bodies by forward kinematics.

    Args:
        model: the robot.
        torso_position: (n, 3) metres, world frame.
        torso_rotation: (n, 3, 3) from the torso's frame into the world's.
        joint_angles_deg: (n, J) degrees, in the robot's joint order.

    Returns:
        (n, B, 7): position in metres and quaternion w, x, y, z, world frame.
    """
    n = len(torso_position)
    index = model.body_index
    moved_by = {joint.body: (k, joint) for k, joint in enumerate(model.joints)}
    offsets = {body.name: np.array(body.offset) for body in model.bodies}
    bodies = np.empty((n, len(model.bodies), 7))
    poses: dict[str, tuple[Floats, Floats]] = {}
    for body in model.bodies:  # parents come before their children
        if body.name not in moved_by:
            position, rotation = torso_position, torso_rotation
        else:
            k, joint = moved_by[body.name]
            anchor = np.array(joint.anchor)
            parent_position, parent_rotation = poses[joint.parent]
            # frames are axis-parallel at angles 0, where the anchor lies at the sum of the offsets
            pivot = parent_position + parent_rotation @ (offsets[body.name] + anchor - offsets[joint.parent])
            rotation = parent_rotation @ _turns(np.array(joint.axis), np.deg2rad(joint_angles_deg[:, k]))
            position = pivot - rotation @ anchor
        poses[body.name] = position, rotation
        bodies[:, index[body.name], :3] = position
        bodies[:, index[body.name], 3:7] = quaternions(rotation)
    return bodies


def quaternions(rotations: Floats) -> Floats:
    """Return the (n, 4) unit quaternions w x y z, w >= 0, of (n, 3, 3) rotations.

    Each component's magnitude comes from the diagonal, and the signs from the largest one's row of products, so nothing
    is divided by a small number (Shepperd, "Quaternion from rotation matrix", 1978).
    """
    m = rotations
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    products = np.empty((len(m), 4, 4))
    products[:, 0, 0] = 1.0 + xx + yy + zz
    products[:, 1, 1] = 1.0 + xx - yy - zz
    products[:, 2, 2] = 1.0 - xx + yy - zz
    products[:, 3, 3] = 1.0 - xx - yy + zz
    for i, j, value in (
        (0, 1, m[:, 2, 1] - m[:, 1, 2]),
        (0, 2, m[:, 0, 2] - m[:, 2, 0]),
        (0, 3, m[:, 1, 0] - m[:, 0, 1]),
        (1, 2, m[:, 0, 1] + m[:, 1, 0]),
        (1, 3, m[:, 0, 2] + m[:, 2, 0]),
        (2, 3, m[:, 1, 2] + m[:, 2, 1]),
    ):
        products[:, i, j] = products[:, j, i] = value
    largest = np.argmax(np.einsum("nii->ni", products), axis=1)
    rows = products[np.arange(len(m)), largest]
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(np.where(rows[:, :1] < 0.0, -rows, rows))


def rotations(quaternions: Floats) -> Floats:
    """Return the (k, 3, 3) rotations into the world's frame of (k, 4) unit quaternions w, x, y, z."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _turns(axis: Floats, angles_rad: Floats) -> Floats:
    """Return the (n, 3, 3) rotations about a unit axis, by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, cosine = np.sin(angles_rad)[:, None, None], np.cos(angles_rad)[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross))
