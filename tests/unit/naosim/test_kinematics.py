"""Test poses of bodies from the torso's pose and joint angles."""

from __future__ import annotations

import numpy as np
import pytest
from naosim.simspark import BatchSimulator
from naosim.simspark.kinematics import body_poses, quaternions
from numpy.typing import NDArray

Array = NDArray[np.float64]


def matrix(quaternion: Array) -> Array:
    """Return the rotation of a unit quaternion w x y z."""
    w, (x, y, z) = quaternion[0], quaternion[1:]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross)


@pytest.mark.parametrize("robot_type", [0, 4])
def test_bodies_are_where_the_engine_has_them(robot_type: int) -> None:
    """All joints bent at once, in the air; joints give way by a millimetre there."""
    engine = BatchSimulator(3, robot_type, digits=None)
    engine.beam((0.0, 0.0, 2.0), -90.0)
    rng = np.random.default_rng(robot_type)
    for _ in range(20):
        before, rotation = engine.truth.bodies, engine.truth.torso_rotation.copy()
        engine.step(rng.uniform(-2.0, 2.0, (3, len(engine.model.joints))))
    # perceived angles are those before the last cycle
    angles = engine.perceptors.joint_angles
    assert np.abs(angles).max() > 10.0
    poses = body_poses(engine.model, before[:, 0, :3], rotation, angles)
    np.testing.assert_allclose(poses[..., :3], before[..., :3], rtol=0, atol=2e-3)
    same = np.abs((poses[..., 3:7] * before[..., 3:7]).sum(axis=-1))
    np.testing.assert_allclose(same, 1.0, atol=1e-5)
    assert poses.shape == (3, len(engine.model.bodies), 7)


def test_quaternions_turn_as_their_matrices_do() -> None:
    """Half turns about each axis, where three of the four components vanish, included."""
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(50, 4))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    wanted = np.concatenate([np.eye(4), unit])
    found = quaternions(np.stack([matrix(q) for q in wanted]))
    np.testing.assert_allclose(np.abs((found * wanted).sum(axis=1)), 1.0, atol=1e-12)
    assert (found[:, 0] >= 0.0).all()
