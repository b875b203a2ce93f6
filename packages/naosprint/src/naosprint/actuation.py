"""Turn actions into joint speeds, and joint angles into the convention that policies see.

Policies see and set angles in the convention of the paper's code: pitch joints count as on the real NAO (hips forward
is negative, knees bent is positive) and the right side is mirrored, so that the same number on both sides is a
symmetric posture. The simulator keeps its own signs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from naosim.robots.nao_model import RobotModel

    from naosprint.arrays import FloatArray

GAIN = 7.0
"""Gain of the proportional controller in 1/s: speed = GAIN * (target - angle). Paper, section IV-B."""

CYCLE_S = 0.02
"""Length of one simulation step in seconds."""

NECK_JOINTS = ("hj1", "hj2")
"""Joints that no policy moves; they are held at zero."""

START_POSE_DEG: Mapping[str, float] = {"aj1": 90.0, "aj3": -90.0, "aj4": -90.0, "lj3": -30.0, "lj4": 60.0, "lj5": -30.0}
"""The start pose in degrees, in the policies' convention and without the side's letter; joints not named are at 0."""

_REVERSED_PITCH = frozenset({"aj1", "lj3", "lj4", "lj5"})
_LATERAL = frozenset({"aj2", "aj3", "aj4", "lj2", "lj6"})


def _sign(joint: str) -> float:
    side, kind = joint[0], joint[1:]
    if kind in _REVERSED_PITCH or (side == "r" and kind in _LATERAL):
        return -1.0
    return 1.0


class Actuation:
    """Know a robot type's joints as policies see them.

    Attributes:
        names: joints that a policy moves, in action order: left arm, right arm, left leg, right leg.
        index: (A,) their positions among the simulator's joints.
        sign: (A,) factor between the simulator's angle and the policy's.
        low_rad: (A,) lower end of the policy's range, radians.
        high_rad: (A,) upper end of the policy's range, radians.
        max_speed: (J,) speed limit of every joint of the simulator, rad/s.
    """

    def __init__(self, model: RobotModel) -> None:
        self.n_joints = len(model.joints)
        moved = [(place, joint) for place, joint in enumerate(model.joints) if joint.name not in NECK_JOINTS]
        self.names = tuple(joint.name for _, joint in moved)
        self.index = np.array([place for place, _ in moved], dtype=np.int64)
        self.sign = np.array([_sign(joint.name) for _, joint in moved])
        ends = np.deg2rad([[joint.low_deg, joint.high_deg] for _, joint in moved]) * self.sign[:, None]
        self.low_rad: FloatArray = ends.min(axis=1)
        self.high_rad: FloatArray = ends.max(axis=1)
        self.max_speed: FloatArray = np.array([joint.max_speed for joint in model.joints], dtype=np.float64)
        self._half_range = (self.high_rad - self.low_rad) / 2.0

    @property
    def n_actions(self) -> int:
        """Number of joints that a policy moves."""
        return len(self.names)

    @property
    def rest(self) -> FloatArray:
        """(A,) actions that stand for angle 0 of every joint, or the end of its range next to it."""
        unit: FloatArray = np.clip(-self.low_rad / self._half_range - 1.0, -1.0, 1.0)
        return unit

    def targets(self, actions: FloatArray) -> FloatArray:
        """Map actions onto joint angles.

        Args:
            actions: (n, A); clipped to [-1, 1], which stands for the joint's range.

        Returns:
            (n, J) target angles in radians, the simulator's order and signs, the neck at 0.
        """
        targets = np.zeros((len(actions), self.n_joints))
        unit = np.clip(actions, -1.0, 1.0)
        targets[:, self.index] = ((unit + 1.0) * self._half_range + self.low_rad) * self.sign
        return targets

    def speeds(self, targets_rad: FloatArray, angles_deg: FloatArray) -> FloatArray:
        """Return the proportional controller's joint speeds.

        Args:
            targets_rad: (n, J) target angles in radians.
            angles_deg: (n, J) perceived angles in degrees.

        Returns:
            (n, J) speeds in rad/s within the joints' limits.
        """
        wanted = GAIN * (targets_rad - np.deg2rad(angles_deg))
        return np.clip(wanted, -self.max_speed, self.max_speed)

    def angles(self, angles_deg: FloatArray) -> FloatArray:
        """Return (n, A) angles in radians as policies see them, from (n, J) perceived angles in degrees."""
        seen: FloatArray = np.deg2rad(angles_deg[:, self.index]) * self.sign
        return seen

    def start_pose(self) -> FloatArray:
        """Return the (J,) start pose in radians, the simulator's order and signs."""
        pose = np.zeros(self.n_joints)
        pose[self.index] = np.deg2rad([START_POSE_DEG.get(name[1:], 0.0) for name in self.names]) * self.sign
        return pose
