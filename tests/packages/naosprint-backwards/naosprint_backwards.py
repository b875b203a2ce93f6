"""The task run-backwards: an example of a task that a package of its own adds to naosprint."""

from __future__ import annotations

import numpy as np
from naosim.simulator import STEP_S
from naosprint.tasks import Chart, End, Metric, ObservationBlock, Presentation, RewardTerm, Task, TaskSettings
from pydantic import Field

TARGET_MPS = 0.5  # speed above which there is no more reward
BACKWARD = Metric("backward_m", "Distance backwards", "m", "Displacement towards the robot's back.", 2, "higher")
FALL_RATE = Metric("backward_fall_rate", "Falls", "%", "Fraction of episodes that ended by a fall.", 1, "lower", "rate")
SPEED = Metric(
    "backward_mps", "Speed backwards", "m/s", "Distance backwards divided by duration.", 2, "higher", live=False
)


class RunBackwardsSettings(TaskSettings):
    """Settings of the task."""

    gait_period_s: float = Field(
        default=0.4,
        gt=0.0,
        le=2.0,
        title="Gait period",
        description="Period of the clock that the policy observes.",
        json_schema_extra={"unit": "s"},
    )


class RunBackwards(Task[RunBackwardsSettings]):
    """Run backwards from the middle of the field."""

    name = "run-backwards"
    summary = "Run backwards as far as possible in 20 s."
    Parameters = RunBackwardsSettings
    metrics = (BACKWARD, FALL_RATE, SPEED)
    ends = (End("fell", "Fall", failure=True),)
    presentation = Presentation(
        charts=(Chart("Distance backwards", ("backward_m",)), Chart("Falls", ("backward_fall_rate",))),
        listed=("backward_m", "backward_fall_rate"),
        headline=("backward_m", "backward_mps", "backward_fall_rate"),
    )
    max_steps = 1000

    def __init__(self, parameters, world, seed=0):
        super().__init__(parameters, world, seed)
        self._start, self._x = self.add_array("start"), self.add_array("x")
        self._back, self._fell = np.zeros(self.n), np.zeros(self.n, dtype=np.bool_)

    def observation_blocks(self):
        """Return the robot's usual observations and a clock, which a mirror shifts by half a period."""
        clock = ObservationBlock(("gait_sin", "gait_cos"), self._clock, signs=(-1.0, -1.0))
        return [*super().observation_blocks(), clock]

    def _clock(self, rows):
        phase = 2.0 * np.pi * self.world.steps[rows] * STEP_S / self.parameters.gait_period_s
        return np.stack([np.sin(phase), np.cos(phase)], axis=1)

    def reward_terms(self):
        """Return displacement backwards up to the target speed, and as much for every step on its feet, in meters."""
        most = TARGET_MPS * STEP_S
        return (
            RewardTerm("backward", 1.0, lambda rows: np.clip(self._back[rows], -most, most)),
            RewardTerm("on its feet", 0.5 * most, lambda rows: ~self._fell[rows]),
        )

    def begin(self, rows):
        """Store where the robots start."""
        self._start[rows] = self._x[rows] = self.world.position(rows)[:, 0]

    def advance(self, rows):
        """Compute how far the step went back."""
        position = self.world.position(rows)
        self._back[rows] = self._x[rows] - position[:, 0]
        self._x[rows] = position[:, 0]
        self._fell[rows] = position[:, 2] < self.world.defaults.fall_height_m

    def ended(self, rows):
        """Return which robots have fallen."""
        return (self._fell[rows],)

    def measure(self, rows):
        """Return distance and fall."""
        return np.stack([self._start[rows] - self._x[rows], self._fell[rows]], axis=1)

    def summarize(self, episodes, statistics):
        """Return distance, speed and falls."""
        distance = np.array([x[0] - x[-1] for x in episodes.x])
        results = (
            statistics.mean(BACKWARD, distance),
            statistics.mean(SPEED, distance / (episodes.steps * STEP_S)),
            statistics.rate(FALL_RATE, episodes.ends["fell"]),
        )
        return results, ()
