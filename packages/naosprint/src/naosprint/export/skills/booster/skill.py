"""Skill for mujococodebase that runs an exported policy."""

from pathlib import Path

import numpy as np
from mujococodebase.skills.naosprint.runner import Runner
from mujococodebase.skills.skill import Skill

FALLEN = 0.6  # of the standing height


class Naosprint(Skill):
    """Run straight ahead, follow velocities (task velocity), kick to a point (kick), dribble, or keep goal (block)."""

    def __init__(self, agent):
        super().__init__(agent)
        self.runner = Runner(Path(__file__).with_name("policy.npz"))
        self.effectors = [str(name) for name in self.runner.effector_names]
        self.joints = ["q_" + name.replace("e", "j") for name in self.effectors]

    def execute(self, reset, orientation=None, lane=None, command=None, target=None, ball=None, after=None):
        """Run one cycle; return whether the robot has fallen.

        `orientation` is the direction on the team's field in degrees, `lane` a point of the line to keep to, (x, y) in
        metres; by default the robot runs ahead from where it is. `command` is forward and sideways speed in m/s and
        turn rate in rad/s, for a policy that follows them.

        A policy that observes the ball needs the `ball` as it is seen in this cycle: (distance in metres, azimuth,
        elevation in degrees), or None. A kick has a `target`, (direction on the team's field in radians, distance in
        metres or infinity); `after` is the skill whose last step it continues. Once `kicked`, the walking skill has to
        continue after it, with the command (0, 0, 0). A dribble takes the same, with a `target` of direction and speed
        in m/s in each cycle; a keeper (block) the middle of its goal's line, (x, y) in metres.
        """
        robot, position = self.agent.robot, self.agent.world.global_position
        if reset:
            last = {} if after is None else {"action": after.runner.action, "position": after.runner.position}
            self.runner.begin(None if orientation is None else np.radians(orientation), lane, target, **last)
        x, y, z, w = robot.global_orientation_quat
        angles, speeds = (
            [values[name] for name in self.joints] for values in (robot.motor_positions, robot.motor_speeds)
        )
        perceived = position, (w, x, y, z), robot.gyroscope, angles, speeds
        observation = self.runner.observe(*perceived, command, ball, target)
        self.move(self.runner.act(observation))
        return bool(position[2] < FALLEN * self.runner.standing_height_m)

    @property
    def kicked(self):
        """Whether the ball has been kicked."""
        return self.runner.kicked

    def hold(self):
        """Take the pose that runs start from, for one cycle."""
        self.move(self.runner.start_targets)

    def move(self, targets):
        """Set target angles in radians with the gains of the training."""
        for name, target, kp, kd in zip(self.effectors, np.degrees(targets), self.runner.kp, self.runner.kd):
            self.agent.robot.set_motor_target_position(name, float(target), kp=float(kp), kd=float(kd))

    def is_ready(self, *args):
        """Return whether the robot stands."""
        return bool(self.agent.world.global_position[2] > 0.9 * self.runner.standing_height_m)
