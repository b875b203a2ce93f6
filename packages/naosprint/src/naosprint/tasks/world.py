"""The robots as tasks and observations see them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from functools import cached_property, reduce
from typing import TYPE_CHECKING

import numpy as np
from naosim.robots.actuation import Actuation
from naosim.simulator import CONTACT_N

from naosprint.tasks.robot_defaults import RobotDefaults, robot_defaults
from naosprint.terms import Number, arctan2, clip, maximum, source

if TYPE_CHECKING:
    from naosim.robots import Robot
    from naosim.simulator import BodyState, RobotMotion, Simulator

    from naosprint.arrays import FloatArray, IntArray


class World:
    """State of the robots for tasks and observation blocks; all arrays have one row per robot.

    Attributes:
        n: number of robots.
        robot: their description.
        actuation: how actions become joint targets.
        steps: (n,) steps of each robot's episode so far.
        streams: (n,) whose random numbers each robot gets: its own in a training, those of its episode in an
            evaluation, whose results then do not depend on the number of robots.
        actions: (n, A) actions of the latest step, in [-1, 1]; zero at the start of an episode.
        previous_actions: (n, A) those of the step before.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.n = simulator.n
        self.robot: Robot = simulator.robot
        self.actuation = Actuation(simulator.robot)
        self.steps: IntArray = np.zeros(self.n, dtype=np.int64)
        self.streams: IntArray = np.arange(self.n)
        self.actions: FloatArray = np.zeros((self.n, self.actuation.n_actions))
        self.previous_actions: FloatArray = np.zeros((self.n, self.actuation.n_actions))

    @cached_property
    def defaults(self) -> RobotDefaults:
        """The robot's observations and fall heights unless the task differs.

        Raises:
            ValueError: if no package states them.
        """
        return robot_defaults(self.robot)

    @property
    def perceptors(self) -> Mapping[str, FloatArray]:
        """Perceptors by name."""
        return self.simulator.perceptors

    def perceived(self, name: str) -> Number:
        """Return a perceptor for expressions."""
        return source(lambda: self.perceptors[name], f"perceptors.{name}")

    @cached_property
    def true_position(self) -> Number:
        """The torso's true position in metres, for expressions."""
        return source(lambda: self.simulator.truth.torso_position)

    @cached_property
    def true_rotation(self) -> Number:
        """The nine numbers of the true rotation from the torso's frame into the world's, for expressions."""
        return source(lambda: self.simulator.truth.torso_rotation)

    @cached_property
    def true_yaw(self) -> Number:
        """Angle in radians from the world's +x to the torso's front, counter-clockwise, for expressions."""
        front = self.robot.front_axis
        return arctan2(self.true_rotation[3 + front], self.true_rotation[front])

    @cached_property
    def step(self) -> Number:
        """Steps of the episode so far, for expressions."""
        return source(self.steps, "steps")

    @cached_property
    def action(self) -> Number:
        """Latest action, for expressions."""
        return source(self.actions, "action")

    @cached_property
    def previous_action(self) -> Number:
        """Action of the step before, for expressions."""
        return source(self.previous_actions)

    @cached_property
    def flight(self) -> Number:
        """1 for robots with both feet off the ground in two successive measurements of the step, for expressions.

        The same as ``Simulator.flight``.
        """
        frames = source(self.simulator.foot_frames)
        if frames.width == 2:
            return source(self.simulator.airborne)
        off = [(frames[k] < CONTACT_N) & (frames[k + 1] < CONTACT_N) for k in range(0, frames.width, 2)]
        return reduce(maximum, [first & second for first, second in itertools.pairwise(off)])

    @cached_property
    def torque_shares(self) -> Number:
        """Share of its torque limit that each motor applies, from -1 to 1, for expressions.

        Raises:
            ValueError: if the simulator does not report motor torques.
        """
        limits = [joint.max_torque for joint in self.robot.joints]
        return clip(source(self.simulator.torques) / limits, -1.0, 1.0)

    def body(self, name: str, part: str) -> Number:
        """Return a part of :attr:`bodies` for expressions: position, rotation, velocity or spin of a body."""
        return source(lambda: getattr(self.bodies[name], part))

    def contact(self, part: str) -> Number:
        """Return the share of the latest step in which the ball touched a part of the robot, for expressions."""
        return source(lambda: self.contacts[part])

    def position(self, rows: slice | IntArray) -> FloatArray:
        """Return the (k, 3) true torso positions in metres."""
        return self.simulator.truth.torso_position[rows]

    def rotation(self, rows: slice | IntArray) -> FloatArray:
        """Return the (k, 3, 3) true rotations from the torso's frame into the world's."""
        return self.simulator.truth.torso_rotation[rows]

    @property
    def bodies(self) -> Mapping[str, BodyState]:
        """True motion of the bodies that the task's scene names: torso, feet and ball."""
        return self.simulator.truth.bodies

    @property
    def contacts(self) -> Mapping[str, FloatArray]:
        """By part of the robot, (n,) share of the latest step in which the ball touched it."""
        return self.simulator.truth.contacts

    def place_ball(
        self,
        rows: IntArray,
        position_m: FloatArray,
        velocity_mps: FloatArray | None = None,
        spin_rad_s: FloatArray | None = None,
    ) -> None:
        """Place the ball of the (k,) robots ``rows`` at (k, 3), at rest or with (k, 3) velocities and spins.

        Raises:
            ValueError: if the task's scene has no ball.
        """
        self.simulator.place_ball(rows, position_m, velocity_mps, spin_rad_s)

    def motion(self, rows: IntArray) -> RobotMotion:
        """Return poses and velocities of the (k,) robots ``rows``.

        Raises:
            ValueError: if the simulator's robots can begin at rest only.
        """
        return self.simulator.motion(rows)

    def set_motion(self, rows: IntArray, motion: RobotMotion) -> None:
        """Give the (k,) robots ``rows`` these poses and velocities, instead of rest, to begin with.

        Raises:
            ValueError: if the simulator's robots can begin at rest only.
        """
        self.simulator.set_motion(rows, motion)

    def yaw(self, rows: slice | IntArray) -> FloatArray:
        """Return the (k,) angles in radians from the world's +x to the torso's front, counter-clockwise."""
        front = self.robot.front_axis
        rotation = self.rotation(rows)
        return np.asarray(np.arctan2(rotation[:, 1, front], rotation[:, 0, front]))
