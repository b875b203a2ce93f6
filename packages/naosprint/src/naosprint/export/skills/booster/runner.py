"""Run an exported policy of a T1 or K1: from what the robot perceives to target angles; needs only NumPy."""

import numpy as np

try:  # in the team's code, or beside check.py
    from mujococodebase.skills.naosprint.terms import Observations, computed, latest
except ModuleNotFoundError:
    from terms import Observations, computed, latest

POWER_M = 10.0  # commanded distance of a kick as far as possible
GOAL_BEHIND_M = 1.0  # distance of a goal without a given place: where keepers wait


class Runner:
    """Policy with the path that it runs along. Angles without a unit in their name are in radians.

    With `begin` and the first `observe` the path starts where the robot is. It leads in the direction `heading` of the
    team's field, counter-clockwise from +x.
    """

    def __init__(self, path):
        self.__dict__.update(np.load(path))
        self.observations = Observations(self.terms, len(self.observation_names))
        # A symmetric policy hops from a perfectly symmetric pose, which training never starts from.
        noise = np.random.default_rng(0).uniform(-2, 2, len(self.start_pose_rad))
        self.start_targets = self.start_pose_rad + np.radians(noise)
        inputs = ("launch_speed", "new_line", "goal")
        self.kicks, self.dribbles, self.keeps = (self.observations.has(name) for name in inputs)
        self.begin()

    def begin(self, heading=None, lane=None, target=None, action=None, position=None):
        """Begin a run along `heading`, the torso's own if it is None; `lane` is a point of the path, (x, y) metres.

        A policy of task kick needs a `target`: direction on the team's field in radians and distance in metres, or
        infinity for a kick as far as possible; one of task dribble direction and speed in m/s; one of task block the
        middle of the line of a goal that opens along +x, (x, y) metres, by default right behind the robot. They begin
        in the middle of a step, with the latest `action` and the torso's latest `position` of the policy that walked
        so far.
        """
        self.heading, self.walked = np.nan if heading is None else heading, position
        self.lane = np.full(2, np.nan) if lane is None else np.array(lane, float)
        self.command, self.cycles, self.position = np.zeros(3), 0, position
        self.action = np.zeros(len(self.action_names)) if action is None else np.nan_to_num(np.array(action, float))
        self.target, self.aimed = None, {}
        if self.kicks or self.dribbles:
            self.turn_to(target if known(target) else (0.0, np.inf if self.kicks else 1.0))
        elif self.keeps:
            self.target, self.aimed["aim"] = np.full(2, np.nan) if target is None else np.array(target, float), 0.0
        self.observations.begin()

    def turn_to(self, target):
        """Aim at the target of a kick, or begin a new line of a dribble."""
        target = tuple(float(value) for value in target)
        self.aimed["new_line"] = self.target is not None and target != self.target
        self.target, (self.aimed["aim"], reach) = target, target
        if self.kicks:
            power = self.aimed["power"] = not np.isfinite(reach)
            # balls swerve toward the field's diagonals: a launch differs from the kick's direction
            speed, aim = self.launch(POWER_M, 0.0) if power else self.launch(reach, target[0])
            self.aimed.update(launch_speed=speed, aim=self.power_aim(target[0]) if power else aim)
        else:
            self.aimed["speed"] = reach

    def launch(self, distance, direction):
        """Return speed and direction with which a ball has to roll off to stop in a direction at a distance."""
        axis = np.round(direction / (np.pi / 2)) * np.pi / 2
        at = [
            np.clip(np.interp(value, grid, np.arange(len(grid))), 0, len(grid) - 1.000001)
            for value, grid in ((distance, self.launch_distances_m), (abs(direction - axis), self.launch_directions))
        ]
        (i, j), (s, t) = np.array(at, int), np.array(at) % 1

        def between(values):
            rows = (1 - s) * values[i : i + 1, j : j + 2] + s * values[i + 1 : i + 2, j : j + 2]
            return float((1 - t) * rows[0, 0] + t * rows[0, 1])

        return between(self.launch_speeds), axis + np.sign(direction - axis) * between(self.launch_aims)

    def power_aim(self, direction):
        """Return the direction in which to kick as far as possible so that the ball passes a point in a direction."""
        axis = np.round(direction / (np.pi / 2)) * np.pi / 2
        aside = direction - axis
        return axis + np.sign(aside) * np.interp(abs(aside), self.launch_directions, self.power_aims)

    @property
    def kicked(self):
        """Whether the ball has been kicked and the policy that walks has to take over."""
        return bool(self.observations.get("task.kicked")[0] >= self.takeover_steps)

    def observe(self, position, quaternion, gyro_deg, angles_deg, speeds_deg, command=None, ball=None, target=None):
        """Return the observation, once per cycle.

        position (3,) in metres and quaternion (w, x, y, z) of the torso on the team's field, gyroscope (3,) in degrees
        per second, joints' angles and speeds in degrees and degrees per second in the order of `joint_names`. A policy
        of task velocity follows `command`: forward and sideways speed in m/s, turn rate in rad/s; a new one starts a
        new path. One that observes the ball needs the `ball` as it is seen: distance in metres, azimuth and elevation
        in degrees from the camera; None or NaN where it is not reported. A new `target` of a dribble begins a new line.
        Commands and targets with a NaN are ignored.
        """
        position, (w, x, y, z) = np.array(position, float), quaternion
        cross = np.cross(np.eye(3), (x, y, z))
        rotation = np.eye(3) + 2 * (w * cross + cross @ cross)
        yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
        if self.aimed or self.observations.has("command"):
            self.heading = 0.0  # what these policies observe is the same in every direction
        # NaN until both are perceived
        self.heading, self.lane = float(latest(self.heading, yaw)), latest(self.lane, position[:2])
        if self.cycles == 0 and self.walked is not None:
            self.observations.begin({"velocity_position": self._along(self.walked)})
        self.position = position  # for a skill that continues this one
        fresh = known(command) and bool((self.command != command).any())
        self.command = np.array(command, float) if fresh else self.command
        c, s = np.cos(self.heading / 2), -np.sin(self.heading / 2)
        inputs = {
            "perceptors.torso_pos": self._along(position),
            "perceptors.torso_quat": (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w),
            **{
                "perceptors.gyro": gyro_deg,
                "perceptors.joint_angles": angles_deg,
                "perceptors.joint_speeds": speeds_deg,
                "perceptors.ball": np.full(3, np.nan) if ball is None else ball,
            },
            **{"steps": self.cycles, "action": self.action},
            **{"command": self.command, "new_command": fresh, "entry_velocity": np.zeros(3)},
        }
        if self.aimed:
            if self.dribbles:
                self.turn_to(target if known(target) else self.target)
            elif self.keeps:
                self.target = latest(self.target, position[:2] - (GOAL_BEHIND_M, 0.0))
                inputs["goal"] = self._along(self.target)
            inputs.update(self.aimed)
        self.cycles += 1
        return self.observations.observe(inputs)

    def _along(self, position):
        """Return a place of the field where it is in trainings, whose runs lead along +x from one point."""
        (x, y), c, s = position[:2] - self.lane, np.cos(self.heading), np.sin(self.heading)
        at_x, at_y = self.observations.start
        return np.array([at_x + c * x + s * y, at_y + c * y - s * x, *position[2:]])

    def act(self, observation):
        """Return the target angles of all joints in the order of `joint_names`.

        They stay as they are if a number of the observation is not finite.
        """
        self.action = computed(self, observation, self.action)
        return np.clip(self.middle_rad + self.reach_rad @ self.action, self.low_rad, self.high_rad)


def known(values):
    """Return whether values are given, and numbers."""
    return values is not None and not np.isnan(values).any()


def wrapped(angle):
    """Return an angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
