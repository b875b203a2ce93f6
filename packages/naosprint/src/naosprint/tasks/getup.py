"""Getting up from lying on the front, the back, or a side."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

import numpy as np
from naosim.simulator import STEP_S, Ability, Starts
from naospec.metrics import Chart, Metric, Presentation, Result, ResultTable
from pydantic import Field

from naosprint.tasks.base import RewardTerm, Task
from naosprint.tasks.disturbance_settings import DisturbanceSettings
from naosprint.tasks.episodes import rate_metric
from naosprint.tasks.fields import fraction, weight
from naosprint.tasks.measurements import StoredNumbers
from naosprint.tasks.motions import Motion, motions
from naosprint.tasks.observations import ObservationBlock, blocks, radians
from naosprint.tasks.penalties import PenaltySettings, penalties
from naosprint.tasks.world import World
from naosprint.terms import (
    Number,
    Store,
    absolute,
    clip,
    constant,
    cos,
    equal,
    exp,
    mean,
    minimum,
    sin,
    source,
    square,
    stack,
    where,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from naosim.robots import Robot

    from naosprint.arrays import BoolArray, FloatArray, IntArray
    from naosprint.tasks.episodes import Episodes, Statistics

STANDING_HEIGHT = 0.88
"""Torso height from which a robot stands, as a fraction of its standing height."""

STANDING_UP = 0.94
"""Upward component of the torso's z axis from which a robot stands: 20 degrees of tilt."""

HOLD_STEPS = 25
"""Steps for which it has to stay so: half a second."""

LIMIT_S = 3.0
"""Time within which the first attempt counts, seconds."""

_STREAM = 0x6E7

STANDING_RATE = rate_metric("standing_rate", "Standing at the end", "Fraction of episodes that end standing.")
SUCCESS_RATE = rate_metric(
    "success_rate", "Up within 3 s", "Fraction of episodes in which the robot stands within 3 s and stays up for 0.5 s."
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


class GetUpSettings(PenaltySettings, DisturbanceSettings):
    """Settings of the task ``getup``."""

    unused = frozenset({"start_noise_deg"})  # robots lie at the start
    pose_noise_deg: float = Field(
        default=30.0,
        ge=0.0,
        le=90.0,
        title="Pose noise",
        description="Each joint of a lying robot is offset from its nominal angle by up to this angle.",
        json_schema_extra={"unit": "deg"},
    )
    side_fraction: float = fraction(
        0.5,
        "Fraction of sides",
        "Fraction of robots that have tipped over to the left or right; the others lie on front and back. "
        "Evaluations have as many of either.",
    )
    episode_steps: int = Field(
        default=250,
        ge=HOLD_STEPS,
        le=10_000,
        title="Episode length",
        description="Length of an episode.",
        json_schema_extra={"unit": "steps"},
    )
    pose_weight: float = weight(0.5, "Pose weight", "Weight of being near the nominal pose while upright.")

    def for_evaluation(self) -> Self:
        """Return the settings without disturbances, with sides and episodes as usual, whatever the training's were."""
        usual = {name: type(self).model_fields[name].get_default() for name in ("side_fraction", "episode_steps")}
        return super().for_evaluation().model_copy(update=usual)


SIDES: Mapping[str, float] = {"front": 0.5 * np.pi, "back": 1.5 * np.pi, "right": 0.0}
"""Sides from which there are scripted motions, that of the left is mirrored: direction of the axis about which a robot
has tipped over, counter-clockwise from its front, radians."""

_PERIODS = 6
_TIME_S = 4.0
_TIME = ("time", *(f"time_{wave}_{k}" for k in range(1, _PERIODS + 1) for wave in ("sin", "cos")))


def time_numbers(steps: Number) -> Number:
    """Return 13 observations of the time since a robot began to get up, given in steps.

    Sines and cosines make moments distinguishable that are close to each other; after four seconds nothing changes.
    """
    time = minimum(steps * STEP_S, _TIME_S) / _TIME_S
    return stack(time, *(wave(np.pi * k * time) for k in range(1, _PERIODS + 1) for wave in (sin, cos)))


def lying(around: FloatArray, tilt: FloatArray, yaw: FloatArray) -> FloatArray:
    """Return (k, 4) torso quaternions w, x, y, z of robots that have tipped over.

    Args:
        around: (k,) directions of the horizontal axes about which they turn, counter-clockwise from the front, radians.
        tilt: (k,) angles by which they turn.
        yaw: (k,) angles by which they turn about the vertical after that.
    """
    half = 0.5 * tilt
    w, x, y = np.cos(half), np.sin(half) * np.cos(around), np.sin(half) * np.sin(around)
    c, s = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
    return np.stack([c * w, c * x - s * y, c * y + s * x, s * w], axis=1)


def side_of(rotation: Number) -> Number:
    """Return which side a robot lies on by its torso's rotation: 0 to 2 for those of :data:`SIDES`, 3 for the left."""
    front, left = rotation[6], rotation[7]  # upward components
    return where(absolute(front) > absolute(left), front > 0.0, where(left > 0.0, 2.0, 3.0))


class GetUp(Task[GetUpSettings]):
    """Stand up from lying on the front, the back, or a side, and stay up."""

    name = "getup"
    summary = "Stand up from lying on the front, the back, or a side."
    Parameters = GetUpSettings
    metrics = (STANDING_RATE, SUCCESS_RATE)
    results = (TIME, HEIGHT)
    presentation = Presentation(
        skill="Stand up",
        charts=(Chart("Success", ("success_rate", "standing_rate")), Chart("Reward", ("reward",))),
        listed=("success_rate", "standing_rate"),
        headline=("success_rate", "time_s", "standing_rate", "final_height_m"),
        repeats=False,
    )

    needs = frozenset({Ability.LYING})

    @classmethod
    def supports(cls, robot: Robot) -> bool:
        """Return whether the robot perceives its orientation."""
        return any(perceptor.name == "torso_quat" for perceptor in robot.perceptors)

    @classmethod
    def demonstrates(cls, robot: Robot) -> bool:
        """Return whether there are scripted motions of the robot."""
        return motions(cls.name, robot).keys() >= SIDES.keys()

    def __init__(self, parameters: GetUpSettings, world: World, seed: int = 0) -> None:
        super().__init__(parameters, world, seed)
        self._demonstrations: FloatArray | None = None  # (4, T, A)
        if self.demonstrates(self.robot):
            scripted = motions(self.name, self.robot)
            moves = [*(scripted[side] for side in SIDES), scripted["right"].mirrored(self.robot)]
            self._demonstrations = self._actions(moves)
        self.max_steps = parameters.episode_steps
        self._held: IntArray = self.add_array("held", fill=0)
        self._stood_at: IntArray = self.add_array("stood_at", fill=0)  # 0: not yet
        self._side: IntArray = self.add_array("side", fill=0)
        self.measurements = (StoredNumbers(self._attempt()),)

    def _attempt(self) -> list[Store]:
        """Return what is stored of an attempt: the side that it began on, and how long the robot has been standing."""
        held, stood_at, zero = source(self._held), source(self._stood_at), constant(0.0)
        first = equal(held, HOLD_STEPS) & equal(stood_at, 0.0)
        return [
            Store(source(self._side), begin=side_of(self.world.true_rotation)),
            Store(held, begin=zero, update=where(self._standing(), held + 1.0, 0.0)),
            Store(stood_at, begin=zero, update=where(first, self.world.step - HOLD_STEPS + 1.0, stood_at)),
        ]

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return the robot's usual observations without its heading in the world, and the time."""
        usual = blocks(self.world, [name for name in self.world.defaults.observations if name != "heading"])
        return [*usual, ObservationBlock(_TIME, time_numbers(self.world.step))]

    def _actions(self, moves: Sequence[Motion]) -> FloatArray:
        """Return the (k, T, A) actions of motions, each followed by those of the nominal pose."""
        actuation = self.world.actuation
        assert actuation.action_range_rad is not None
        tables = [move.targets(self.robot)[:, actuation.index] * actuation.sign for move in moves]
        angles = np.tile(actuation.nominal, (len(moves), 1 + max(map(len, tables)), 1))
        for row, table in zip(angles, tables, strict=True):
            row[: len(table)] = table
        return np.clip((angles - actuation.nominal) / actuation.action_range_rad, -1.0, 1.0)

    def demonstration(self, rows: slice) -> FloatArray | None:
        """Return the actions of the robot's scripted motion for the side that it lay on, at this time."""
        if self._demonstrations is None:
            return None
        steps = np.minimum(self.world.steps[rows], self._demonstrations.shape[1] - 1)
        return np.asarray(self._demonstrations[self._side[rows], steps])

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
        # tilt by a right angle about a horizontal axis of the torso, then turn about the vertical
        around = 0.5 * np.pi * self._quarters(count) + rng.uniform(-0.3, 0.3, count)
        tilt = np.pi / 2.0 + rng.uniform(-0.2, 0.2, count)
        yaw = rng.uniform(-np.pi, np.pi, count)
        poses = np.clip(self.robot.nominal + offsets, low, high)
        return Starts(poses, self.start_position(), orientations=lying(around, tilt, yaw))

    def _quarters(self, count: int) -> IntArray:
        """Return each robot's quarter turns from the right side: the two sides in turn, and front and back in turn."""
        due = np.ceil(np.arange(count + 1) * self.parameters.side_fraction)
        aside = np.diff(due) > 0.0
        turn = np.where(aside, np.cumsum(aside), np.cumsum(~aside)) - 1
        return np.asarray(2 * (turn % 2) + ~aside, dtype=np.int64)

    def reward_terms(self) -> Sequence[RewardTerm]:
        """Return rewards for height, for an upright torso at that height, and for the nominal pose once up.

        Height counts squared and tilt in proportion to it, so that sitting upright is worth little.
        """
        world, actuation = self.world, self.world.actuation
        tall = square(clip(world.true_position[2] / self.robot.standing_height_m, 0.0, 1.0))
        angles = radians(world, "joint_angles")
        off_pose = mean(square(angles - actuation.nominal.tolist())) * 4.0
        standing = self._standing()
        return (
            RewardTerm("height", 1.0, tall),
            RewardTerm("upright", 0.5, 0.5 * (1.0 + world.true_rotation[8]) * tall),
            RewardTerm("standing", 1.0, standing),
            RewardTerm("pose", self.parameters.pose_weight, where(standing, exp(off_pose * -1.0), 0.0)),
            *penalties(world, self.parameters),
        )

    def _standing(self) -> Number:
        """Return whether the robot stands: its torso is high and upright."""
        tall = self.world.true_position[2] > STANDING_HEIGHT * self.robot.standing_height_m
        return tall & (self.world.true_rotation[8] > STANDING_UP)

    def skill_over(self, rows: slice | IntArray) -> BoolArray:
        """Return which robots have stood for long enough."""
        return self._held[rows] >= HOLD_STEPS

    def succeeded(self, rows: IntArray) -> BoolArray:
        """Return which robots stood in time."""
        stood = self._stood_at[rows]
        return (stood > 0) & (stood * STEP_S <= LIMIT_S)

    def measure(self, rows: IntArray) -> FloatArray:
        """Return whether the robot stands, and whether it stood in time."""
        return np.stack([self._held[rows] > 0, self.succeeded(rows)], axis=1).astype(np.float64)

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
