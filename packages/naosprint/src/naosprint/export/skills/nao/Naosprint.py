"""Behavior for FCPCodebase that runs an exported policy."""

from pathlib import Path

import numpy as np
from behaviors.custom.Naosprint.runner import Runner

FALLEN_M = 0.25


class Naosprint:
    """Run in a direction of the field."""

    def __init__(self, base_agent):
        self.world = base_agent.world
        self.description = "Run straight ahead (naosprint)"
        self.auto_head = False
        self.runner = Runner(Path(__file__).with_name("policy.npz"))
        # The team code counts joints in an order of its own and turns some of them round.
        robot = self.world.robot
        self.index = np.array([robot.MAP_PERCEPTOR_TO_INDEX[str(name)] for name in self.runner.joint_names])
        self.sign = np.array([-1 if str(name) in robot.FIX_PERCEPTOR_SET else 1 for name in self.runner.joint_names])

    def execute(self, reset, orientation=None):
        """Run one cycle; return whether the robot has fallen.

        `orientation` is the direction on the field in degrees, 0 towards the opponents' goal; by default the robot
        runs ahead.
        """
        robot, (yaw, height, position) = self.world.robot, self.pose()
        if robot.type != self.runner.robot_type:
            raise ValueError(f"the policy is for robot type {self.runner.robot_type}, this robot has {robot.type}")
        if reset:
            self.runner.begin(yaw if orientation is None else np.radians(orientation))
        feet = [np.zeros(6) if foot is None else served(foot) for foot in map(robot.frp.get, ("lf", "rf"))]
        felt = served(robot.gyro), served(robot.acc), *feet
        self.move(self.runner.act(self.runner.observe(yaw, height, self.angles(), *felt, self.vision(), position)))
        if self.runner.estimates:
            height = self.runner.estimated_height
        return bool(height < FALLEN_M)

    def pose(self):
        """Return the torso's yaw in radians, its height and its position (2,) in metres, by the team's localization."""
        robot = self.world.robot
        x, y, height = robot.imu_weak_torso_position
        return np.radians(robot.imu_torso_orientation), height, (x, y)

    def vision(self):
        """Return the landmarks in sight (8, 3) for a policy with onboard sensing; none for another."""
        if not self.runner.estimates:
            return None
        seen = {**self.world.flags_posts, **self.world.flags_corners}
        return np.array([seen.get(tuple(place), (np.nan,) * 3) for place in self.runner.onboard_landmarks.tolist()])

    def angles(self):
        """Return the joint angles in degrees, in the server's order and signs."""
        return self.world.robot.joints_position[self.index] * self.sign

    def hold(self):
        """Take the pose that runs start from, for one cycle."""
        self.move(self.runner.start_targets)

    def move(self, targets):
        """Set joint speeds that lead to target angles in radians."""
        self.world.robot.joints_target_speed[self.index] = self.runner.speeds(targets, self.angles()) * self.sign

    def is_ready(self, *args):
        """Return whether the robot stands."""
        return bool(self.pose()[1] > 0.9 * self.runner.standing_height_m)


def served(vectors):
    """Return vectors (3,) or pairs of them (6,) in the server's frame: x to the right, y to the front."""
    x, y, z = np.reshape(vectors, (-1, 3)).T
    return np.stack([-y, x, z], axis=1).ravel()
