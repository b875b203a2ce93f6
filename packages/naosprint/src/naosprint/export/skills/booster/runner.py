"""Run an exported policy of a T1 or K1: from what the robot perceives to target angles; needs only NumPy."""

import numpy as np

try:  # in the team's code, or beside check.py
    from mujococodebase.skills.naosprint.terms import Observations
except ModuleNotFoundError:
    from terms import Observations

ACTIVATIONS = {"tanh": np.tanh, "relu": lambda values: np.maximum(values, 0), "linear": lambda values: values}
FOOT_M, KICKED_M, CALM, NEVER, POWER_M = 0.106, 0.04, 0.2, 1e6, 10.0


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
        balls = {"launch_speed": Kicking, "ball_offset": Dribbling}
        self.ball = next((kind(self) for name, kind in balls.items() if name in self.observation_names), None)
        self.begin()

    def begin(self, heading=None, lane=None, target=None, action=None, position=None):
        """Begin a run along `heading`, the torso's own if it is None; `lane` is a point of the path, (x, y) metres.

        A policy of task kick needs a `target`: direction on the team's field in radians and distance in metres, or
        infinity for a kick as far as possible; one of task dribble direction and speed in m/s. They begin in the middle
        of a step, with the latest `action` and the torso's latest `position` of the policy that walked so far.
        """
        self.heading, self.lane, self.walked = heading, None if lane is None else np.array(lane, float), position
        self.command, self.cycles, self.position = np.zeros(3), 0, position
        self.action = np.zeros(len(self.action_names)) if action is None else np.array(action, float)
        if self.ball:
            self.ball.begin(self.ball.usual if target is None else target)
        self.observations.begin()

    def observe(self, position, quaternion, gyro_deg, angles_deg, speeds_deg, command=None, ball=None, target=None):
        """Return the observation, once per cycle.

        position (3,) in metres and quaternion (w, x, y, z) of the torso on the team's field, gyroscope (3,) in degrees
        per second, joints' angles and speeds in degrees and degrees per second in the order of `joint_names`. A policy
        of task velocity follows `command`: forward and sideways speed in m/s, turn rate in rad/s; a new one starts a
        new path. Those of tasks kick and dribble need the `ball` as it is seen: distance in metres, azimuth and
        elevation in degrees from the camera; None or NaN where it is not reported. A new `target` of a dribble begins a
        new line.
        """
        position, (w, x, y, z) = np.array(position, float), quaternion
        cross = np.cross(np.eye(3), (x, y, z))
        rotation = np.eye(3) + 2 * (w * cross + cross @ cross)
        yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
        if self.ball or self.observations.has("command"):
            self.heading = 0.0  # what these policies observe is the same in every direction
        self.heading = yaw if self.heading is None else self.heading
        self.lane = position[:2] if self.lane is None else self.lane
        if self.cycles == 0 and self.walked is not None:
            self.observations.begin({"velocity_position": self._along(self.walked)})
        self.position = position  # for a skill that continues this one
        fresh = command is not None and bool((self.command != command).any())
        self.command = np.array(command, float) if fresh else self.command
        c, s = np.cos(self.heading / 2), -np.sin(self.heading / 2)
        inputs = {
            "perceptors.torso_pos": self._along(position),
            "perceptors.torso_quat": (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w),
            **{
                "perceptors.gyro": gyro_deg,
                "perceptors.joint_angles": angles_deg,
                "perceptors.joint_speeds": speeds_deg,
            },
            **{"steps": self.cycles, "action": self.action},
            **{"command": self.command, "new_command": fresh},
        }
        if self.ball:
            if target is not None and not isinstance(self.ball, Kicking):
                self.ball.turn_off(target)
            inputs.update(self.ball.observe(position, rotation, yaw, np.radians(angles_deg), ball))
            inputs.update(line_offset=0.0, heading_sin=0.0, heading_cos=1.0)
        self.cycles += 1
        return self.observations.observe(inputs)

    def _along(self, position):
        """Return a place of the field where it is in trainings, whose runs lead along +x from one point."""
        (x, y), c, s = position[:2] - self.lane, np.cos(self.heading), np.sin(self.heading)
        at_x, at_y = self.observations.start
        return np.array([at_x + c * x + s * y, at_y + c * y - s * x, *position[2:]])

    def act(self, observation):
        """Return the target angles of all joints in the order of `joint_names`."""
        values = np.clip((observation - self.mean) * self.scale, -self.clip, self.clip)
        for i in range(self.layers):
            values = getattr(self, f"weights_{i}") @ values + getattr(self, f"bias_{i}")
            values = ACTIVATIONS[str(self.activations[i])](values)
        self.action = np.clip(values, -1, 1)
        return np.clip(self.middle_rad + self.reach_rad @ self.action, self.low_rad, self.high_rad)


def wrapped(angle):
    """Return an angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


class Ball:
    """The ball as it is seen, and the command of a walk to it. Angles are in radians."""

    share = 0.5  # of a new velocity in the average

    def __init__(self, arrays):
        self.arrays = arrays
        names = [str(name) for name in arrays.joint_names]
        self.head = [names.index("head_yaw"), names.index("head_pitch")]

    def clear(self):
        """Forget what was seen."""
        self.place, self.velocity, self.age = np.zeros(2), np.zeros(2), NEVER
        self.sighted, self.expected, self.sightings, self.unseen = None, np.zeros(2), 0, 0

    def look(self, position, rotation, yaw, angles, ball):
        """Take in what is seen; return what is observed of it, and where the ball is behind the aim's direction."""
        self.age, self.unseen = self.age + 1, self.unseen + (self.sightings > 0 or self.age < NEVER)
        if ball is not None and np.isfinite(ball[0]):
            self._see(position[:2] + (rotation @ self.in_torso(np.asarray(ball, float), *angles[self.head]))[:2])
        apart = (self.place - position[:2]) * (self.sightings > 0)
        ahead, left = self._along(yaw, apart)
        along, across = self._along(self.aim, apart)
        speeds = self._along(yaw, self.velocity)
        seen = {
            **dict(zip(("ball_forward", "ball_left"), (ahead, left))),
            **dict(zip(("ball_forward_velocity", "ball_left_velocity"), speeds)),
            "ball_age": min(self.age * self.arrays.cycle_s, 1.0),
        }
        turn, along, across = wrapped(self.aim - yaw), np.clip(along, -1, 3), np.clip(across, -2, 2)
        seen.update(aim_sin=np.sin(turn), aim_cos=np.cos(turn), ball_along=along, ball_across=across)
        return seen, turn, along, across

    def in_torso(self, ball, yaw, pitch):
        """Return a seen ball in the torso's frame; the server truncates, so half a digit is added."""
        distance, azimuth, elevation = ball + np.copysign(0.005, ball)
        azimuth, elevation = np.radians([azimuth, elevation])
        level = distance * np.cos(elevation)
        seen = np.array([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)])
        (c, s), (d, z) = (np.cos(yaw), np.sin(yaw)), (np.cos(pitch), np.sin(pitch))
        turn, nod = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.array([[d, 0, z], [0, 1, 0], [-z, 0, d]])
        at_yaw, at_pitch, at_camera = self.arrays.camera_m
        return at_yaw + turn @ (at_pitch + nod @ (at_camera + seen))

    def _see(self, place):
        known, step = self.age < NEVER, self.arrays.cycle_s
        self.velocity = (place - self.place) / (max(self.age, 1) * step) if known else np.zeros(2)
        if known:
            elapsed = max(self.unseen, 1) * step
            moved = place - self.sighted
            self._notice(moved, elapsed)
            share = 1.0 if self.sightings == 1 else self.share
            self.expected = self.expected + share * (moved / elapsed - self.expected)
        self.place = self.sighted = place
        self.sightings, self.unseen, self.age = self.sightings + 1, 0, 0

    def _notice(self, moved, elapsed):
        """Take in how the ball has moved between two sightings."""

    def _along(self, heading, way):
        cosine, sine = np.cos(heading), np.sin(heading)
        return cosine * way[0] + sine * way[1], cosine * way[1] - sine * way[0]

    def _walk(self, turn, forward, left, low, high):
        """Return the walker's command: velocity in the aim's frame, turned to the torso's."""
        cosine, sine = np.cos(turn), np.sin(turn)
        return np.clip((cosine * forward - sine * left, sine * forward + cosine * left, 3 * turn), low, high)


class Kicking(Ball):
    """A kick: its target and whether the ball has been kicked."""

    usual = 0.0, np.inf
    share = CALM

    def begin(self, target):
        """Begin a kick to (direction, distance); direction and speed of the launch follow from the table of rolls.

        Balls swerve toward the field's diagonals, so the launch of a pass differs from its direction. A kick as far as
        possible, with the distance infinity, goes straight at its target.
        """
        direction, distance = (float(value) for value in target)
        self.power = not np.isfinite(distance)
        if self.power:
            self.speed, self.aim = self.launch(POWER_M, 0.0)[0], direction
        else:
            self.speed, self.aim = self.launch(distance, direction)
        self.clear()
        self.kicked, self.side = -1, 1

    def launch(self, distance, direction):
        """Return speed and direction with which a ball has to roll off to stop in a direction at a distance."""
        table = self.arrays
        axis = np.round(direction / (np.pi / 2)) * np.pi / 2
        at = [
            np.clip(np.interp(value, grid, np.arange(len(grid))), 0, len(grid) - 1.000001)
            for value, grid in ((distance, table.launch_distances_m), (abs(direction - axis), table.launch_directions))
        ]
        (i, j), (s, t) = np.array(at, int), np.array(at) % 1

        def between(values):
            rows = (1 - s) * values[i : i + 1, j : j + 2] + s * values[i + 1 : i + 2, j : j + 2]
            return float((1 - t) * rows[0, 0] + t * rows[0, 1])

        return between(table.launch_speeds), axis + np.sign(direction - axis) * between(table.launch_aims)

    @property
    def done(self):
        """Whether the ball has been kicked and the policy that walks has to take over."""
        return self.kicked >= int(self.arrays.takeover_steps)

    def observe(self, position, rotation, yaw, angles, ball):
        """Return what a kick observes besides the robot, once per cycle."""
        self.kicked += self.kicked >= 0
        seen, turn, along, across = self.look(position, rotation, yaw, angles, ball)
        if self.sightings == 1 and self.age == 0:
            self.side = 1 if across >= 0 else -1
        walks = self.sightings > 0 and self.kicked < 0
        command = self._approach(turn, along, across) if walks else np.zeros(3)
        return {
            **seen,
            **dict(zip(("command_forward", "command_sideways", "command_turn"), command)),
            **{"launch_speed": self.speed, "power": self.power, "kicked": min((self.kicked + 1) / 10, 1.0)},
        }

    def _notice(self, moved, elapsed):
        """Take in whether the ball has left the path that it was on."""
        surprise = np.hypot(*(moved - self.expected * elapsed))
        most = KICKED_M + 0.3 * max(elapsed - 2 * self.arrays.cycle_s, 0)
        if self.sightings >= 2 and surprise > most and self.kicked < 0:
            self.kicked = 0

    def _approach(self, turn, along, across):
        """Return the walker's command: bring a foot behind the ball, then walk through it."""
        aside = across - self.side * FOOT_M
        ready = np.clip(1.6 - abs(aside) / 0.05 - abs(turn) / 0.2, 0, 1)
        forward = np.clip(0.25 * self.speed, 0.4, 0.8) * ready + (1 - ready) * np.clip(2 * (along - 0.52), -0.3, 0.8)
        return self._walk(turn, forward, np.clip(3 * aside, -0.45, 0.45), (0, -0.45, -1), (1, 0.45, 1))


class Dribbling(Ball):
    """A dribble along a line, which begins where the ball is seen."""

    usual = 0.0, 1.0

    def begin(self, target):
        """Begin to dribble in a direction at a speed."""
        self.clear()
        self.target, self.line = None, None
        self.turn_off(target)

    def turn_off(self, target):
        """Begin a new line if the target, (direction, speed), is another one."""
        target = tuple(float(value) for value in target)
        if target != self.target:
            self.target, (self.aim, self.speed), self.line = target, target, self.sighted

    def observe(self, position, rotation, yaw, angles, ball):
        """Return what a dribble observes besides the robot, once per cycle."""
        seen, turn, along, across = self.look(position, rotation, yaw, angles, ball)
        command, offset = np.zeros(3), 0.0
        if self.sightings:
            self.line = self.sighted if self.line is None else self.line
            offset = np.clip(self._along(self.aim, self.place - self.line)[1], -1, 1)
            command = self._approach(turn, along, across)
        speeds = self._along(self.aim, np.clip(self.expected, -4, 4))
        return {
            **seen,
            **dict(zip(("command_forward", "command_sideways", "command_turn"), command)),
            **dict(zip(("ball_speed_along", "ball_speed_across"), speeds)),
            **{"ball_offset": offset, "ball_speed": self.speed},
        }

    def _approach(self, turn, along, across):
        """Return the walker's command: bring the nearer foot behind the ball, then walk through it."""
        aside = across - (FOOT_M if across >= 0 else -FOOT_M)
        ready = np.clip(2 - abs(aside) / 0.1 - abs(turn) / 0.3, 0, 1)
        forward = self.speed * ready + (1 - ready) * np.clip(2 * (along - 0.4), -0.4, 0.8)
        return self._walk(turn, forward, np.clip(3 * aside, -0.5, 0.5), (-0.4, -0.5, -1), (2, 0.5, 1))
