"""The task push-ball: an example of a task with a ball that a package of its own adds to naosprint."""

from __future__ import annotations

import numpy as np
from naosim.simulator import STEP_S, Scene
from naosprint.tasks import Chart, End, Metric, Presentation, RewardTerm, Task, TaskSettings
from naosprint.tasks.observations import blocks
from naosprint.terms.randomness import uniform
from pydantic import Field

BALL_M = Metric("ball_m", "Ball's way", "m", "Distance that the ball has moved forward.", 2, "higher")
TOUCH_RATE = Metric("touch_rate", "Touches", "%", "Fraction of episodes with a touch by a foot.", 1, kind="rate")
FALL_RATE = Metric("push_fall_rate", "Falls", "%", "Fraction of episodes that ended by a fall.", 1, "lower", "rate")


class PushBallSettings(TaskSettings):
    """Settings of the task."""

    ball_ahead_m: float = Field(default=0.3, ge=0.25, le=3.0, title="Ball ahead", description="Least distance, m.")
    episode_steps: int = Field(default=250, ge=10, le=10_000, title="Episode length", description="Steps.")


class PushBall(Task[PushBallSettings]):
    """Push a ball forward that lies before one of the feet."""

    name = "push-ball"
    summary = "Push a ball as far forward as possible."
    Parameters = PushBallSettings
    scene = Scene(ball=True)
    metrics = (BALL_M, TOUCH_RATE, FALL_RATE)
    ends = (End("fell", "Fall", failure=True),)
    presentation = Presentation(
        charts=(Chart("Ball's way", ("ball_m",)), Chart("Falls", ("push_fall_rate",))),
        listed=("ball_m", "push_fall_rate"),
        headline=("ball_m", "touch_rate", "push_fall_rate"),
    )
    trace = ("ball_x", "touched")

    def __init__(self, parameters, world, seed=0):
        super().__init__(parameters, world, seed)
        self.max_steps = parameters.episode_steps
        self._start, self._touched = self.add_array("start"), self.add_array("touched")
        self._draws, self._fell = self.add_array("draws", fill=0), np.zeros(self.n, dtype=np.bool_)

    def observation_blocks(self):
        """Return the robot's usual observations and the ball as the robot perceives it."""
        return blocks(self.world, [*self.world.defaults.observations, "ball"])

    def place(self, rows):
        """Place the ball at rest before one of the feet; every episode draws its place."""
        ahead, side = uniform(self.seed, self.world.streams[rows], self._draws[rows], 2).T
        self._draws[rows] += 1
        ball = self.world.position(rows).copy()
        ball[:, 0] += self.parameters.ball_ahead_m + 0.1 * ahead
        ball[:, 1] += np.where(side < 0.5, -0.1, 0.1)
        ball[:, 2] = self.robot.field.ball_radius_m
        self.world.place_ball(rows, ball)

    def begin(self, rows):
        """Store where the ball starts."""
        self._start[rows] = self.world.bodies["ball"].position[rows, 0]
        self._touched[rows] = 0.0

    def advance(self, rows):
        """Note touches and falls."""
        touching = np.maximum(self.world.contacts["left_foot"][rows], self.world.contacts["right_foot"][rows])
        self._touched[rows] = np.maximum(self._touched[rows], touching > 0.0)
        self._fell[rows] = self.world.position(rows)[:, 2] < self.world.defaults.fall_height_m

    def reward_terms(self):
        """Return the ball's velocity and, so that it is found at all, that of a torso which approaches it."""
        ball, torso = self.world.bodies["ball"], self.world.bodies["torso"]
        return (
            RewardTerm("ball", 1.0, lambda rows: ball.velocity[rows, 0] * STEP_S),
            RewardTerm("approach", 0.2, lambda rows: np.minimum(torso.velocity[rows, 0], 0.5) * STEP_S),
            RewardTerm("on its feet", 0.005, lambda rows: ~self._fell[rows]),
        )

    def ended(self, rows):
        """Return which robots have fallen."""
        return (self._fell[rows],)

    def measure(self, rows):
        """Return the ball's way, whether a foot touched it, and fall."""
        return np.stack([self._way(rows), self._touched[rows], self._fell[rows]], axis=1)

    def _way(self, rows):
        return self.world.bodies["ball"].position[rows, 0] - self._start[rows]

    def trace_row(self, rows):
        """Return the ball's way so far and whether a foot touched it."""
        return np.stack([self._way(rows), self._touched[rows]], axis=1)

    def summarize(self, episodes, statistics):
        """Return the ball's way, touches and falls."""
        last = np.array([trace[-1] for trace in episodes.trace])
        return (
            statistics.mean(BALL_M, last[:, 0]),
            statistics.rate(TOUCH_RATE, last[:, 1] > 0.0),
            statistics.rate(FALL_RATE, episodes.ends["fell"]),
        ), ()
