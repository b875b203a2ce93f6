"""Actions of policies as target angles, and perceived angles as policies see them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from naosim.robots.description import Floats, Robot


class Actuation:
    """Mapping between a robot's joints and the actions of a policy.

    An action of -1 or 1 is an end of the joint's range, or, for a robot with ``action_range_rad``, this far from the
    nominal angle. Angles of policies are in the policy convention (:mod:`naosim.robots.description`).

    Attributes:
        robot: the robot.
        names: joints that a policy moves, in action order, which is the order of ``robot.joints``.
        n_actions: number of them, A.
        n_joints: number of all joints, J.
        index: (A,) their indices among all joints.
        sign: (A,) factor between the simulator's angle and the policy's.
        low_rad, high_rad: (A,) ends of the joints' ranges, policy convention.
        nominal: (A,) nominal angles, policy convention.
        action_range_rad: (A,) angles from the nominal one that an action of 1 stands for; None if it stands for the end
            of the joint's range.
        signed_half_range, signed_low: (A,) half of the joints' ranges and their lower ends, in the simulator's signs.
    """

    def __init__(self, robot: Robot) -> None:
        moved = [(index, joint) for index, joint in enumerate(robot.joints) if joint.actuated]
        self.robot = robot
        self.names = tuple(joint.name for _, joint in moved)
        self.n_actions, self.n_joints = len(moved), len(robot.joints)
        self.index = np.array([index for index, _ in moved], dtype=np.int64)
        self.sign: Floats = np.array([joint.sign for _, joint in moved])
        ends = np.array([[joint.low_rad, joint.high_rad] for _, joint in moved]) * self.sign[:, None]
        self.low_rad: Floats = ends.min(axis=1)
        self.high_rad: Floats = ends.max(axis=1)
        self.nominal: Floats = robot.nominal[self.index] * self.sign
        self._half_range = (self.high_rad - self.low_rad) / 2.0
        # in the simulator's signs, which changes no bit
        self.signed_half_range, self.signed_low = self._half_range * self.sign, self.low_rad * self.sign
        self.action_range_rad: Floats | None = None
        if robot.action_range_rad is not None:
            self.action_range_rad = np.array([robot.action_range_rad[name] for name in self.names])

    @property
    def mirror(self) -> tuple[tuple[str, ...], tuple[float, ...]]:
        """Joint and sign of each action's mirror image."""
        moved = [joint for joint in self.robot.joints if joint.actuated]
        return tuple(joint.mirror for joint in moved), tuple(joint.mirror_sign for joint in moved)

    @property
    def rest(self) -> Floats:
        """(A,) actions that stand for angle 0 of every joint, or the nearest that an action reaches."""
        unit = (
            -self.low_rad / self._half_range - 1.0
            if self.action_range_rad is None
            else -self.nominal / self.action_range_rad
        )
        rest: Floats = np.clip(unit, -1.0, 1.0)
        return rest

    def targets(self, actions: Floats) -> Floats:
        """Map actions onto joint angles.

        Args:
            actions: (n, A); clipped to [-1, 1].

        Returns:
            (n, J) target angles in radians, simulator order and signs; joints that no action moves are at their nominal
            angle.
        """
        targets = np.empty((len(actions), self.n_joints))
        targets[:] = self.robot.nominal
        unit = np.clip(actions, -1.0, 1.0)
        if self.action_range_rad is None:
            unit += 1.0
            unit *= self.signed_half_range
            unit += self.signed_low
        else:
            unit = np.clip(self.nominal + unit * self.action_range_rad, self.low_rad, self.high_rad) * self.sign
        targets[:, self.index] = unit
        return targets

    def angles(self, angles_deg: Floats) -> Floats:
        """Return (n, A) angles in radians, policy convention, from (n, J) perceived angles in degrees."""
        seen: Floats = np.deg2rad(angles_deg[:, self.index]) * self.sign
        return seen
