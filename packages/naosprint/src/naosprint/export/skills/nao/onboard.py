"""Estimate yaw and height of a NAO's torso from what it perceives, as in its policy's training; needs only NumPy."""

import numpy as np


class OnboardPose:
    """Estimate for one robot; `tables` are the arrays of policy.npz that begin with `onboard_`."""

    def __init__(self, tables):
        self.__dict__.update(tables)
        self.turn, self.sights = None, 0

    def begin(self, heading, bodies, accel):
        """Begin a run of a robot that stands still and faces `heading`; return yaw in radians and height in metres.

        bodies: positions (B, 3) and rotations (B, 3, 3) of all bodies in the torso's frame, by the joint angles.
        """
        x, y, z = accel / np.linalg.norm(accel)
        turn = rotation(np.array([1.0 + z, y, -x, 0.0]))
        yaw = heading - np.arctan2(turn[1, 1], turn[0, 1])
        self.turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]) @ turn
        self.sights, self.soles, self.speed, self.up = 0, self.sole_heights(bodies), 0.0, self.turn[2]
        self.height = -min(self.soles)
        return heading, self.height

    def update(self, bodies, gyro, accel, touching, vision):
        """Use what the robot perceives after a cycle; return yaw in radians and height in metres, a cycle ahead.

        gyro in rad/s; touching: whether left and right foot do; vision: (8, 3) distance, theta and phi in degrees of
        each of `onboard_landmarks`, NaN where it is not seen.
        """
        half = 0.5 * self.cycle_s * gyro
        self.turn = self.turn @ rotation(np.append(1.0, half))
        if np.isfinite(vision[:, 0]).sum() >= self.onboard_min_sights:
            self.see(bodies, vision)
        self.speed += self.cycle_s * (self.up @ accel - self.onboard_gravity)
        self.height += self.cycle_s * self.speed
        if any(touching):
            error = self.onboard_sole_height_m - min(self.soles[touching]) - self.height
            self.height += self.onboard_height_gain * error
            self.speed += self.onboard_climb_gain / self.cycle_s * error
        self.up, self.soles = self.turn[2], self.sole_heights(bodies)
        ahead = self.turn @ rotation(np.append(1.0, half))
        return np.arctan2(ahead[1, 1], ahead[0, 1]), self.height + self.cycle_s * self.speed

    def sole_heights(self, bodies):
        """Return the heights of the lowest points of left and right sole relative to the torso, in metres."""
        places, turns = (part[self.onboard_feet] for part in bodies)
        return places @ self.turn[2] - np.abs(self.turn[2] @ turns) @ self.onboard_sole_m

    def see(self, bodies, vision):
        """Correct the orientation by the landmarks that are seen."""
        found = np.isfinite(vision[:, 0])
        known, distance = self.onboard_landmarks[found], vision[found, 0]
        theta, phi = np.radians(vision[found, 1:].T)
        level = distance * np.cos(phi)
        seen = np.stack([-level * np.sin(theta), level * np.cos(theta), distance * np.sin(phi)], axis=1)
        sight = seen @ (self.turn @ bodies[1][self.onboard_head]).T
        weight = 1.0 / np.maximum(distance, 1.0)
        weight /= weight.sum()
        a, b = (points[:, :2] - weight @ points[:, :2] for points in (sight, known))
        yaw = np.arctan2(weight @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), weight @ (a * b).sum(axis=1))
        lever = np.stack([sight[:, 1], -sight[:, 0]], axis=1)
        missing = known[:, 2] - (self.height + self.turn[2] @ bodies[0][self.onboard_head]) - sight[:, 2]
        normal = (weight * lever.T) @ lever + self.onboard_level * np.eye(2)
        self.sights += 1
        gain = max(self.onboard_min_sight_gain, 1.0 / self.sights)
        turn = 0.5 * gain * np.append(np.linalg.solve(normal, (weight * lever.T) @ missing), yaw)
        self.turn = rotation(np.append(np.sqrt(1.0 - min(0.99, turn @ turn)), turn)) @ self.turn


def rotation(quaternion):
    """Return the rotation (3, 3) of a quaternion w, x, y, z of any length."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross
