"""Getting up from lying on the front, the back, or a side."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

import numpy as np
from naosim.simulator import STEP_S, Starts
from pydantic import Field

from naosprint.tasks.base import RewardTerm, Task, World
from naosprint.tasks.metrics import Chart, Metric, Presentation, Result, ResultTable
from naosprint.tasks.penalties import PenaltySettings, penalties

if TYPE_CHECKING:
    from collections.abc import Sequence

    from naosim.robots import Robot

    from naosprint.arrays import BoolArray, FloatArray, IntArray
    from naosprint.tasks.episodes import Episodes, Statistics
    from naosprint.tasks.observations import ObservationBlock

STANDING_HEIGHT = 0.88
"""Torso height from which a robot stands, as a fraction of its standing height."""

STANDING_UP = 0.94
"""Upward component of the torso's z axis from which a robot stands: 20 degrees of tilt."""

HOLD_STEPS = 25
"""Steps for which it has to stay so: half a second."""

LIMIT_S = 3.0
"""Time within which the first attempt counts, seconds."""

_STREAM = 0x6E7

STANDING_RATE = Metric(
    "standing_rate", "Standing at the end", "%", "Fraction of episodes that end standing.", 1, "higher", "rate"
)
SUCCESS_RATE = Metric(
    "success_rate",
    "Up within 3 s",
    "%",
    "Fraction of episodes in which the robot stands within 3 s and stays up for 0.5 s.",
    1,
    "higher",
    "rate",
)
TIME = Metric(
    "time_s",
    "Time to stand",
    "s",
    "Time until the robot stands, of the episodes in which it does.",
    2,
    "lower",
    live=False,
)
HEIGHT = Metric("final_height_m", "Final height", "m", "Torso height at the end.", 2, "higher", live=False)


class GetUpSettings(PenaltySettings):
    """Settings of the task ``getup``."""

    pose_noise_deg: float = Field(
        default=30.0,
        ge=0.0,
        le=90.0,
        title="Pose noise",
        description="Each joint of a lying robot is offset from its nominal angle by up to this angle.",
        json_schema_extra={"unit": "deg"},
    )
    crouching_starts: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        title="Crouching starts",
        description="Share of training episodes that start from a crouch with a tilted torso, which is easier. "
        "Evaluations have none.",
    )
    episode_steps: int = Field(
        default=250,
        ge=HOLD_STEPS,
        le=10_000,
        title="Episode length",
        description="Length of an episode.",
        json_schema_extra={"unit": "steps"},
    )
    pose_weight: float = Field(
        default=0.5,
        ge=0.0,
        le=1000.0,
        title="Pose weight",
        description="Weight of being near the nominal pose while upright.",
    )

    def for_evaluation(self) -> Self:
        """Return the same settings without disturbances and without easier starts."""
        return super().for_evaluation().model_copy(update={"crouching_starts": 0.0})


_CROUCH = {"hip_pitch": -1.35, "knee_pitch": 1.5, "ankle_pitch": -0.6}
"""Offsets of the legs' joints from the nominal pose in the deepest crouch, radians, by the end of their names."""

_CROUCH_LEAN = 0.45
"""Forward tilt of the torso in the deepest crouch, radians: its centre of mass is above the feet."""


def _crouch(robot: Robot) -> FloatArray:
    """Return the (J,) offsets of the deepest crouch."""
    ends = [[offset for end, offset in _CROUCH.items() if joint.name.endswith(end)] for joint in robot.joints]
    return np.array([sum(offsets) for offsets in ends])


class GetUp(Task):
    """Stand up from lying on the front, the back, or a side, and stay up."""

    name = "getup"
    summary = "Stand up from lying on the front, the back, or a side."
    Parameters = GetUpSettings
    metrics = (STANDING_RATE, SUCCESS_RATE)
    results = (TIME, HEIGHT)
    presentation = Presentation(
        charts=(Chart("Success", ("success_rate", "standing_rate")), Chart("Reward", ("reward",))),
        listed=("success_rate", "standing_rate"),
        headline=("success_rate", "time_s", "standing_rate", "final_height_m"),
    )

    @classmethod
    def supports(cls, robot: Robot) -> bool:
        """Return whether the robot perceives its orientation, and its simulators can start it lying."""
        return any(perceptor.name == "torso_quat" for perceptor in robot.perceptors)

    def __init__(self, parameters: GetUpSettings, world: World, seed: int = 0) -> None:
        super().__init__(parameters, world, seed)
        self.max_steps = parameters.episode_steps
        self._held: IntArray = np.zeros(self.n, dtype=np.int64)
        self._stood_at: IntArray = np.zeros(self.n, dtype=np.int64)  # 0: not yet
        self.arrays = {"held": self._held, "stood_at": self._stood_at}
        self._height: FloatArray = np.zeros(self.n)
        self._up: FloatArray = np.zeros(self.n)
        self._off_pose: FloatArray = np.zeros(self.n)

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return the robot's usual observations without its heading in the world."""
        from naosprint.tasks.observations import blocks

        return blocks(self.world, [name for name in self.robot.observations if name != "heading"])

    def start_position(self) -> tuple[float, float]:
        """Return a start in the robot's lane."""
        return (0.0, float(self.robot.data.get("lane_y_m", 0.0)))

    def starts(self, count: int, seed: int, noise_deg: float) -> Starts:
        """Return ``count`` lying robots: on the front, the back and both sides in turn, with random limbs."""
        del noise_deg
        rng = np.random.default_rng([_STREAM, seed])
        joints = self.robot.joints
        offsets = np.deg2rad(rng.uniform(-1.0, 1.0, (count, len(joints))) * self.parameters.pose_noise_deg)
        low = np.array([joint.low_rad for joint in joints])
        high = np.array([joint.high_rad for joint in joints])
        poses = np.clip(self.robot.nominal + offsets, low, high)
        # tilt by a right angle about a horizontal axis of the torso, then turn about the vertical
        around = 0.5 * np.pi * (np.arange(count) % 4) + rng.uniform(-0.3, 0.3, count)
        tilt = np.pi / 2.0 + rng.uniform(-0.2, 0.2, count)
        yaw = rng.uniform(-np.pi, np.pi, count)
        crouching = rng.uniform(size=count) < self.parameters.crouching_starts
        depth = rng.uniform(0.0, 1.0, count)
        around = np.where(crouching, 0.5 * np.pi + rng.uniform(-0.5, 0.5, count), around)
        tilt = np.where(crouching, depth * _CROUCH_LEAN + rng.uniform(-0.1, 0.1, count), tilt)
        bent = self.robot.nominal + depth[:, None] * _crouch(self.robot) + 0.2 * offsets
        poses = np.where(crouching[:, None], np.clip(bent, low, high), poses)
        half = 0.5 * tilt
        tilted = np.stack(
            [np.cos(half), np.sin(half) * np.cos(around), np.sin(half) * np.sin(around), np.zeros(count)], axis=1
        )
        c, s = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
        w, x, y, z = tilted.T
        orientations = np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=1)
        return Starts(poses, self.start_position(), orientations=orientations)

    def reward_terms(self) -> Sequence[RewardTerm]:
        """Return rewards for height, for an upright torso at that height, and for the nominal pose once up.

        Height counts squared and tilt in proportion to it, so that sitting upright is worth little.
        """
        standing = self.robot.standing_height_m

        def height(rows: slice) -> FloatArray:
            return np.square(np.clip(self._height[rows] / standing, 0.0, 1.0))

        def upright(rows: slice) -> FloatArray:
            return 0.5 * (1.0 + self._up[rows]) * height(rows)

        def pose(rows: slice) -> FloatArray:
            return np.where(self._standing(rows), np.exp(-self._off_pose[rows]), 0.0)

        return (
            RewardTerm("height", 1.0, height),
            RewardTerm("upright", 0.5, upright),
            RewardTerm("standing", 1.0, lambda rows: self._standing(rows).astype(np.float64)),
            RewardTerm("pose", self.parameters.pose_weight, pose),
            *penalties(self.world, self.parameters),
        )

    def _standing(self, rows: slice | IntArray) -> BoolArray:
        tall = self._height[rows] > STANDING_HEIGHT * self.robot.standing_height_m
        return np.asarray(tall & (self._up[rows] > STANDING_UP))

    def begin(self, rows: IntArray) -> None:
        """Reset the attempt."""
        self._held[rows] = self._stood_at[rows] = 0
        self._height[rows] = self.world.position(rows)[:, 2]
        self._up[rows] = self.world.rotation(rows)[:, 2, 2]

    def advance(self, rows: slice) -> None:
        """Measure height, tilt, and how long the robot has been standing."""
        world = self.world
        self._height[rows] = world.position(rows)[:, 2]
        self._up[rows] = world.rotation(rows)[:, 2, 2]
        off = world.actuation.angles(world.perceptors["joint_angles"][rows]) - world.actuation.nominal
        self._off_pose[rows] = np.square(off).mean(axis=1) * 4.0
        self._held[rows] = np.where(self._standing(rows), self._held[rows] + 1, 0)
        first = (self._held[rows] == HOLD_STEPS) & (self._stood_at[rows] == 0)
        self._stood_at[rows] = np.where(first, world.steps[rows] - HOLD_STEPS + 1, self._stood_at[rows])

    def measure(self, rows: IntArray) -> FloatArray:
        """Return whether the robot stands, and whether it stood in time."""
        stood = self._stood_at[rows]
        return np.stack([self._held[rows] > 0, (stood > 0) & (stood * STEP_S <= LIMIT_S)], axis=1).astype(np.float64)

    trace = ("stood_at", "held")

    def trace_row(self, rows: IntArray) -> FloatArray:
        """Return the step at which the robot stood, and how long it has been standing."""
        return np.stack([self._stood_at[rows], self._held[rows]], axis=1).astype(np.float64)

    def summarize(self, episodes: Episodes, statistics: Statistics) -> tuple[Sequence[Result], Sequence[ResultTable]]:
        """Return the success rates and the time to stand up."""
        stood = np.array([trace[-1, 0] for trace in episodes.trace]) * STEP_S
        held = np.array([trace[-1, 1] for trace in episodes.trace])
        height = np.array([height[-1] for height in episodes.height])
        success = (stood > 0.0) & (stood <= LIMIT_S)
        results = [
            statistics.rate(SUCCESS_RATE, success),
            statistics.rate(STANDING_RATE, held > 0),
            statistics.mean(TIME, stood[stood > 0.0]),
            statistics.mean(HEIGHT, height),
        ]
        return results, ()
