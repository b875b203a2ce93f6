"""Run an exported policy of a T1 or K1: from what the robot perceives to target angles; needs only NumPy."""

import numpy as np

ACTIVATIONS = {"tanh": np.tanh, "relu": lambda values: np.maximum(values, 0), "linear": lambda values: values}


class Runner:
    """Policy with the path that it runs along. Angles without a unit in their name are in radians.

    With `begin` and the first `observe` the path starts where the robot is. It leads in the direction `heading` of the
    team's field, counter-clockwise from +x.
    """

    def __init__(self, path):
        self.__dict__.update(np.load(path))
        self.names = [str(name) for name in self.observation_names if "_ago" not in str(name)]
        self.commanded = "command_forward" in self.names
        # A symmetric policy hops from a perfectly symmetric pose, which training never starts from.
        noise = np.random.default_rng(0).uniform(-2, 2, len(self.start_pose_rad))
        self.start_targets = self.start_pose_rad + np.radians(noise)
        self.begin()

    def begin(self, heading=None, lane=None):
        """Begin a run along `heading`, the torso's own if it is None; `lane` is a point of the path, (x, y) metres."""
        self.heading, self.lane, self.position = heading, lane, None
        self.offset, self.command, self.action = 0.0, np.zeros(3), np.zeros(len(self.action_names))
        self.cycles, self.past = 0, []

    def observe(self, position, quaternion, gyro_deg, angles_deg, speeds_deg, command=None):
        """Return the observation, once per cycle.

        position (3,) in metres and quaternion (w, x, y, z) of the torso on the team's field, gyroscope (3,) in degrees
        per second, joints' angles and speeds in degrees and degrees per second in the order of `joint_names`. A policy
        of task velocity follows `command`: forward and sideways speed in m/s, turn rate in rad/s; a new one starts a
        new path.
        """
        position, (w, *axis) = np.array(position, float), quaternion
        cross = np.cross(np.eye(3), axis)
        rotation = np.eye(3) + 2 * (w * cross + cross @ cross)
        yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
        if self.position is None:
            self.heading, self.position = yaw if self.heading is None else self.heading, position
            if self.lane is not None:
                self.offset = self._aside(position[:2] - self.lane)
        moved, self.position = position - self.position, position
        self.offset += self._aside(moved) - self.command[1] * self.cycle_s
        self.heading += self.command[2] * self.cycle_s
        if command is not None and (self.command != command).any():
            self.command, self.heading, self.offset = np.array(command, float), yaw, 0.0
        velocity, error = rotation.T @ moved / self.cycle_s, yaw - self.heading
        joints = np.radians([angles_deg, speeds_deg]) @ self.joint_view.T
        seen = dict(zip(("command_forward", "command_sideways", "command_turn"), self.command))
        seen["height"], seen["heading_sin"], seen["heading_cos"] = position[2], np.sin(error), np.cos(error)
        seen["time"], self.cycles = min(self.cycles * self.cycle_s / 4.0, 1.0), self.cycles + 1
        for wave in "sin", "cos":
            seen.update((f"time_{wave}_{k}", getattr(np, wave)(np.pi * k * seen["time"])) for k in range(1, 7))
        seen["line_offset"] = np.clip(self.offset, -0.5, 0.5) if self.commanded else self.offset
        for name, vector in ("gravity", rotation[2]), ("gyro", np.radians(gyro_deg)), ("velocity", velocity):
            seen.update(zip((f"{name}_{axis}" for axis in "xyz"), vector))
        for name, values in zip(("", "speed_", "action_"), (*joints, self.action)):
            seen.update(zip((f"{name}{joint}" for joint in self.action_names), values))
        now = np.array([seen[name] for name in self.names])
        self.past = [now, *(self.past or [now] * 10)][:11]  # before a run everything was as it is at its start
        return np.concatenate(self.past[: len(self.observation_names) // len(now)])

    def _aside(self, way):
        return np.cos(self.heading) * way[1] - np.sin(self.heading) * way[0]

    def act(self, observation):
        """Return the target angles of all joints in the order of `joint_names`."""
        values = np.clip((observation - self.mean) * self.scale, -self.clip, self.clip)
        for i in range(self.layers):
            values = getattr(self, f"weights_{i}") @ values + getattr(self, f"bias_{i}")
            values = ACTIVATIONS[str(self.activations[i])](values)
        self.action = np.clip(values, -1, 1)
        return np.clip(self.middle_rad + self.reach_rad @ self.action, self.low_rad, self.high_rad)
