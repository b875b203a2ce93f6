"""Run an exported policy of a NAO: from what the robot perceives to joint speeds; needs only NumPy."""

import numpy as np

try:  # in the team's code, or beside check.py
    from behaviors.custom.Naosprint.terms import Observations, computed, latest
except ModuleNotFoundError:
    from terms import Observations, computed, latest


class Runner:
    """Policy that runs in the direction `heading` of the team's field, counter-clockwise from +x, in radians."""

    def __init__(self, path):
        self.__dict__.update(np.load(path))
        self.observations = Observations(self.terms, len(self.observation_names))
        self.estimates = self.observations.has("perceptors.vision")  # yaw and height, from the other inputs
        # A symmetric policy hops from a perfectly symmetric pose, which training never starts from.
        noise = np.random.default_rng(0).uniform(-2, 2, len(self.start_pose_rad))
        self.start_targets = self.start_pose_rad + np.radians(noise)
        self.start_action = np.linalg.lstsq(self.reach_rad, self.start_pose_rad - self.middle_rad, rcond=None)[0]
        self.begin()

    def begin(self, heading=0.0):
        """Begin a run."""
        self.heading, self.cycles, self.action = heading, 0, self.start_action
        self.observations.begin()

    def observe(self, yaw, height, angles_deg, gyro_deg, accel, left_foot, right_foot, vision=None, position=None):
        """Return the observation, once per cycle.

        yaw of the torso's front on the team's field, counter-clockwise from +x, in radians, and the torso's height in
        metres. The others as the server sends them, in its frames and signs: joint angles in degrees in the order of
        `joint_names`, gyroscope (3,) in degrees per second, accelerometer (3,) in m/s^2, centre and force (6,) of the
        left and right foot, zeros or NaN without contact.

        A policy with onboard sensing estimates yaw and height from the others and from vision: (8, 3) distance in
        metres, theta and phi in degrees of each of `onboard_landmarks`, NaN where it is not seen, or None.
        A policy that observes its velocity on the field needs the torso's position (2,) there, in metres.
        """
        self.angles, self.heading = np.array(angles_deg, float), float(latest(self.heading, yaw))
        left_foot, right_foot = (np.where(np.any(foot), foot, np.nan) for foot in (left_foot, right_foot))
        inputs = {
            "yaw": (yaw - self.heading + np.pi) % (2 * np.pi) - np.pi,
            **{"height": height, "centre_of_mass": self.centre_of_mass(), "steps": self.cycles},
            **{"perceptors.joint_angles": self.angles, "perceptors.gyro": gyro_deg, "perceptors.accel": accel},
            **{"perceptors.foot_left": left_foot, "perceptors.foot_right": right_foot},
            **{"perceptors.vision": np.full((8, 3), np.nan) if vision is None else vision, "heading": self.heading},
        }
        if position is not None:
            c, s = np.cos(self.heading), np.sin(self.heading)
            inputs["position"] = c * position[0] + s * position[1], c * position[1] - s * position[0]
        self.cycles += 1
        return self.observations.observe(inputs)

    @property
    def estimated_height(self):
        """Height of the torso in metres by the estimate of a policy with onboard sensing."""
        return self.observations.get("onboard_pose")[1]

    def centre_of_mass(self):
        """Return the centre of mass in the torso's frame, in metres."""
        at, turn = np.zeros((len(self.body_mass), 3)), np.tile(np.eye(3), (len(self.body_mass), 1, 1))
        for joint, body, parent, offset, anchor, axis in self.chain:
            angle, cross = np.radians(self.angles[joint]), np.cross(np.eye(3), axis)
            turn[body] = turn[parent] @ (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
            at[body] = at[parent] + turn[parent] @ offset - turn[body] @ anchor
        return self.body_mass @ at / self.body_mass.sum()

    def act(self, observation):
        """Return the target angles of all joints in the order of `joint_names`, in radians.

        They stay as they are if a number of the observation is not finite.
        """
        self.action = computed(self, observation, self.action)
        return np.clip(self.middle_rad + self.reach_rad @ self.action, self.low_rad, self.high_rad)

    def speeds(self, targets, angles_deg):
        """Return the speeds of all joints in rad/s that drive them to their targets; 0 where an angle is NaN."""
        wanted = self.gain * (targets - np.radians(angles_deg))
        return np.nan_to_num(np.clip(wanted, -self.max_speed, self.max_speed))
