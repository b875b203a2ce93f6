"""Compute what a policy sees.

For the 22-joint robots these are the 89 numbers of the paper's table I, in the order of its released code. A *rate* is
the difference to the last step, not divided by the step time, and zero at the first observation of an episode.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from naosim.simspark import centre_of_mass

if TYPE_CHECKING:
    from naosprint.actuation import Actuation
    from naosprint.arrays import AnyArray, BoolArray, FloatArray, IntArray
    from naosprint.simulator import Perceptors, Truth

_AXES = ("x", "y", "z")
_EVERYONE = slice(None)

# the features in blocks, each of which is followed by its rates
_SHARED_BLOCKS: tuple[tuple[str, ...], ...] = (
    ("yaw",),
    ("height",),
    tuple(f"com_{axis}" for axis in _AXES),
    tuple(f"gyro_{axis}" for axis in _AXES),
    tuple(f"accel_{axis}" for axis in _AXES),
    tuple(f"left_foot_origin_{axis}" for axis in _AXES),
    tuple(f"left_foot_force_{axis}" for axis in _AXES),
    tuple(f"right_foot_origin_{axis}" for axis in _AXES),
    tuple(f"right_foot_force_{axis}" for axis in _AXES),
)


def observation_names(joint_names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the observations' names in order.

    ``step`` counts the steps of the episode. Joint angles are in radians, in the policies' convention; ``yaw`` is the
    angle in radians from the running direction to the torso's front, counter-clockwise; ``height`` the torso's in
    metres; ``com`` the centre of mass in metres in the torso's frame, by forward kinematics from the perceived angles;
    ``gyro`` in rad/s and ``accel`` in m/s^2 in the torso's frame; ``foot_origin`` the centre of pressure in metres in
    the foot's frame and ``foot_force`` in newtons, zero without contact. The foot counters count the steps since the
    foot last touched down.
    """
    names = ["step"]
    for block in (joint_names, *_SHARED_BLOCKS):
        names += block
        names += [f"{name}_rate" for name in block]
    return (*names, "right_foot_counter", "left_foot_counter")


class Observer:
    """Compute the observations of n robots at once.

    Attributes:
        names: the D observations' names.
        observations: (n, D) the latest observations.
        feet_loaded: (n, 2) whether the left and the right foot touch the ground, by their perceptors.
        both_feet_off: (n,) whether both feet carry less than 0.01 N.
    """

    def __init__(self, n: int, actuation: Actuation, robot_type: int) -> None:
        self.names = observation_names(actuation.names)
        self._actuation = actuation
        self._robot_type = robot_type
        place = {name: i for i, name in enumerate(self.names)}
        features = [name for name in self.names if f"{name}_rate" in place]
        self._value_columns = np.array([place[name] for name in features], dtype=np.int64)
        self._rate_columns = np.array([place[f"{name}_rate"] for name in features], dtype=np.int64)
        self._yaw = features.index("yaw")
        n_joints = actuation.n_actions
        self._joints = slice(0, n_joints)
        self._com = slice(n_joints + 2, n_joints + 5)
        self._gyro = slice(n_joints + 5, n_joints + 8)
        self._accel = slice(n_joints + 8, n_joints + 11)
        self._left = slice(n_joints + 11, n_joints + 17)
        self._right = slice(n_joints + 17, n_joints + 23)
        self.observations: FloatArray = np.zeros((n, len(self.names)))
        self.feet_loaded: BoolArray = np.zeros((n, 2), dtype=np.bool_)
        self.both_feet_off: BoolArray = np.zeros(n, dtype=np.bool_)
        self._features: FloatArray = np.zeros((n, len(features)))
        self._steps: IntArray = np.zeros(n, dtype=np.int64)
        self._counters: IntArray = np.zeros((n, 2), dtype=np.int64)

    def begin(self, rows: IntArray, perceptors: Perceptors, truth: Truth) -> None:
        """Compute the first observation of an episode for the robots ``rows``; leave the others alone."""
        features = self._perceive(perceptors, truth, rows)
        self._features[rows] = features
        self._steps[rows] = 0
        self._counters[rows] = 0
        self.feet_loaded[rows] = self._loaded(features)
        self.both_feet_off[rows] = self._unloaded(features)
        first = np.zeros((len(rows), len(self.names)))
        first[:, self._value_columns] = features
        self.observations[rows] = first

    def update(self, perceptors: Perceptors, truth: Truth, rows: slice = _EVERYONE) -> None:
        """Compute the observations of the robots ``rows`` after a step."""
        features = self._perceive(perceptors, truth, rows)
        rates = features - self._features[rows]
        # the short way round, also where the yaw passes from pi to -pi
        rates[:, self._yaw] = _wrap(rates[:, self._yaw])
        self._features[rows] = features
        self._steps[rows] += 1
        counters = self._counters[rows]
        counters += 1
        loaded = self._loaded(features)
        counters[loaded & ~self.feet_loaded[rows]] = 0
        self.feet_loaded[rows] = loaded
        self.both_feet_off[rows] = self._unloaded(features)
        observations = self.observations[rows]
        observations[:, 0] = self._steps[rows]
        observations[:, self._value_columns] = features
        observations[:, self._rate_columns] = rates
        observations[:, -2] = counters[:, 1]
        observations[:, -1] = counters[:, 0]

    def foot_loads(self) -> FloatArray:
        """Return the (n, 2) latest upward forces on left and right foot in newtons, zero without contact."""
        return np.stack([self._features[:, self._left][:, 5], self._features[:, self._right][:, 5]], axis=1)

    def state(self) -> dict[str, AnyArray]:
        """Return everything that the next observation depends on."""
        return {
            "observations": self.observations.copy(),
            "features": self._features.copy(),
            "steps": self._steps.copy(),
            "counters": self._counters.copy(),
            "feet_loaded": self.feet_loaded.copy(),
            "both_feet_off": self.both_feet_off.copy(),
        }

    def load_state(self, state: dict[str, AnyArray]) -> None:
        """Take over what :meth:`state` returned."""
        self.observations = np.array(state["observations"], dtype=np.float64)
        self._features = np.array(state["features"], dtype=np.float64)
        self._steps = np.array(state["steps"], dtype=np.int64)
        self._counters = np.array(state["counters"], dtype=np.int64)
        self.feet_loaded = np.array(state["feet_loaded"], dtype=np.bool_)
        self.both_feet_off = np.array(state["both_feet_off"], dtype=np.bool_)

    def _perceive(self, perceptors: Perceptors, truth: Truth, rows: IntArray | slice) -> FloatArray:
        angles = perceptors.joint_angles[rows]
        rotation, position = truth.torso_rotation[rows], truth.torso_position[rows]
        left, right = perceptors.foot_left[rows], perceptors.foot_right[rows]
        features = np.empty((len(angles), self._features.shape[1]))
        features[:, self._joints] = self._actuation.angles(angles)
        # the torso's front is its +y, the second column; the running direction is the world's +x
        features[:, self._yaw] = np.arctan2(rotation[:, 1, 1], rotation[:, 0, 1])
        features[:, self._yaw + 1] = position[:, 2]
        features[:, self._com] = centre_of_mass(self._robot_type, angles)
        features[:, self._gyro] = np.deg2rad(perceptors.gyro[rows])
        features[:, self._accel] = perceptors.accel[rows]
        features[:, self._left] = np.where(np.isnan(left), 0.0, left)
        features[:, self._right] = np.where(np.isnan(right), 0.0, right)
        return features

    def _loaded(self, features: FloatArray) -> BoolArray:
        left = features[:, self._left][:, 3:].any(axis=1)
        right = features[:, self._right][:, 3:].any(axis=1)
        return np.stack([left, right], axis=1)

    def _unloaded(self, features: FloatArray) -> BoolArray:
        left = features[:, self._left][:, 3:]
        right = features[:, self._right][:, 3:]
        limit = 0.01**2
        return np.asarray(((left * left).sum(axis=1) < limit) & ((right * right).sum(axis=1) < limit))


def _wrap(angles: FloatArray) -> FloatArray:
    return np.asarray((angles + np.pi) % (2.0 * np.pi) - np.pi)
