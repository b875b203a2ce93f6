"""The task stroll: an example of a task that is made of parts of naosprint and shows what to do."""

from __future__ import annotations

import numpy as np
from naosim.simulator import Starts
from naosprint.tasks import (
    FALL,
    FALL_RATE,
    Below,
    Beyond,
    Deviation,
    Displacement,
    DisturbanceSettings,
    End,
    FallSettings,
    Metric,
    PenaltySettings,
    RewardTerm,
    Task,
    draw_start_poses,
    penalties,
    robot_defaults,
    seconds,
    with_min_height,
)
from naosprint.terms import source

WAY = Metric("way_m", "Way", "m", "Displacement forward.", 2, "higher")
SPEED = Metric("way_mps", "Speed", "m/s", "Displacement divided by time.", 2, "higher")
GOAL_M = 1.0


class StrollSettings(FallSettings, PenaltySettings, DisturbanceSettings):
    """Fall height, penalties, pushes, noise and delays."""


class Stroll(Task[StrollSettings]):
    """Walk a meter ahead."""

    name = "stroll"
    summary = "Walk a meter ahead."
    Parameters = StrollSettings
    metrics = (WAY, FALL_RATE, SPEED)
    ends = (FALL, End("arrived", "Arrival"))
    max_steps = 100

    @classmethod
    def resolve(cls, parameters, robot):
        """Return the settings with the robot's fall height where none is given."""
        super().resolve(parameters, robot)
        return with_min_height(parameters, robot, robot_defaults(robot).fall_height_m)

    @classmethod
    def demonstrates(cls, robot):
        """Return whether an action of 0 is the nominal pose."""
        return robot.action_range_rad is not None

    def __init__(self, parameters, world, seed=0):
        super().__init__(parameters, world, seed)
        self._along, self._aside = Displacement(world), Deviation(world, 0.0)
        self._fallen = Below(world, parameters.min_height_m)
        arrived = Beyond(self._along.now, GOAL_M, self._fallen.flag)
        self.measurements = (self._along, self._aside, self._fallen, arrived)
        self.flags = (self._fallen.flag, arrived.flag)
        self.arrays = {"x": self._along.now, "start_x": self._along.start, "aside": self._aside.now}

    def starts(self, count, seed, noise_deg):
        """Return poses near the nominal one."""
        return Starts(draw_start_poses(self.world.actuation, count, noise_deg, seed), self.start_position())

    def reward_terms(self):
        """Return displacement ahead, drift and the penalties that the settings ask for."""
        return (
            RewardTerm("ahead", 1.0, source(self._along.change)),
            RewardTerm("aside", -1.0, source(self._aside.change)),
            *penalties(self.world, self.parameters),
        )

    def demonstration(self, rows):
        """Show how to stand: the nominal pose."""
        return np.zeros((rows.stop - rows.start, self.world.actuation.n_actions))

    def measure(self, rows):
        """Return way, fall and speed."""
        way = self._along.now[rows] - self._along.start[rows]
        return np.stack([way, self._fallen.flag[rows], way / seconds(self.world.steps[rows])], axis=1)

    def summarize(self, episodes, statistics):
        """Return way and falls."""
        way = np.array([x[-1] - x[0] for x in episodes.x])
        return (statistics.mean(WAY, way), statistics.rate(FALL_RATE, episodes.ends["fallen"])), ()
