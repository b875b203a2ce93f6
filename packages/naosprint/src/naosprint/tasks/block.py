"""Keeping goal: a shot comes, the robot stops it and stays on its feet.

An episode begins with a state of the walker before its goal, on the line between the goal's middle and the ball, and
with a ball that rolls into the goal unless it is stopped. It ends some time after the ball no longer comes nearer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from naosim.simulator import BALL, STEP_S
from naospec.metrics import Chart, Metric, Presentation, Result, ResultTable
from pydantic import Field

from naosprint.tasks import rolling
from naosprint.tasks.ball import BallSettings, BallTask
from naosprint.tasks.base import End, RewardTerm
from naosprint.tasks.episodes import rate_metric
from naosprint.tasks.falls import FALL, FALL_RATE
from naosprint.tasks.fields import between, fraction, weight
from naosprint.tasks.measurements import StoredNumbers
from naosprint.tasks.observations import ObservationBlock
from naosprint.tasks.penalties import penalties
from naosprint.tasks.world import World
from naosprint.terms import (
    Number,
    Store,
    absolute,
    clip,
    constant,
    cos,
    exp,
    given,
    maximum,
    minimum,
    sin,
    source,
    square,
    stack,
    where,
)
from naosprint.terms.geometry import along

if TYPE_CHECKING:
    from collections.abc import Sequence

    from naosprint.arrays import AnyArray, BoolArray, FloatArray, IntArray
    from naosprint.tasks.episodes import Episodes, Statistics

HOME_M = 1.0
"""Distance before the goal line at which a keeper waits, metres."""

CALM_S = 1.5
"""Time for which a ball must not come nearer, and the robot stay upright, until a shot is saved, seconds."""

SPEEDS_MPS = (3.0, 4.0, 5.0, 6.0)
"""Upper ends of the ranges of speed by which results are listed, m/s."""

_AWAY = -0.1  # velocity out of the goal above which a ball no longer comes nearer, m/s
_COMES = 0.3  # speed toward the goal from which a ball is followed, m/s
_BEYOND = 1.3  # a shot would roll this many times as far as the goal
_INSIDE_M = 0.25  # distance of a shot's target from the posts' inner sides
_REACH_M = 2.0  # largest distances that are observed
_OVER_S = 1.0
_SOON_S = 2.0  # longest time to a crossing that is observed
_NEAR_M = 0.25  # distance of the crossing from the torso at which the reward for it has fallen to 1/e
_SHARE = 0.3  # share of a new velocity in the perceived velocity of the ball
_STREAM = 0xB10C

SAVED = rate_metric(
    "saved_rate", "Saves", "Fraction of the shots that are kept out of the goal by a robot that stays on its feet."
)
CONCEDED = rate_metric("conceded_rate", "Goals against", "Fraction of the shots that go in.", "lower")
SAVE = End("saved", "Save")
"""The end of a shot that is saved."""

STOPPED = rate_metric("stopped_rate", "Touched", "Fraction of the shots that the robot touches.")


class BlockSettings(BallSettings):
    """Settings of the task ``block``."""

    ranges = (("shot_distance_min_m", "shot_distance_max_m"), ("shot_speed_min_mps", "shot_speed_max_mps"))

    entry_speed_mps: float = Field(
        default=0.4,
        ge=0.0,
        le=3.0,
        title="Entry speed",
        description="Fastest commanded speed of the walker in the states that episodes begin with.",
        json_schema_extra={"unit": "m/s"},
    )
    shot_distance_min_m: float = Field(
        default=4.0,
        ge=1.0,
        le=12.0,
        title="Nearest shot",
        description="Least distance of the ball from the middle of the goal at the start.",
        json_schema_extra={"unit": "m"},
    )
    shot_distance_max_m: float = Field(
        default=10.0,
        ge=1.0,
        le=12.0,
        title="Farthest shot",
        description="Largest distance of the ball from the middle of the goal at the start.",
        json_schema_extra={"unit": "m"},
    )
    shot_speed_min_mps: float = Field(
        default=2.0,
        ge=0.5,
        le=6.0,
        title="Slowest shot",
        description="Lower end of a shot's speed; a shot that would not reach the goal is as fast as it has to be.",
        json_schema_extra={"unit": "m/s"},
    )
    shot_speed_max_mps: float = Field(
        default=6.0,
        ge=0.5,
        le=6.0,
        title="Fastest shot",
        description="Upper end of a shot's speed.",
        json_schema_extra={"unit": "m/s"},
    )
    shot_angle_max_deg: float = Field(
        default=45.0,
        ge=0.0,
        le=80.0,
        title="Largest angle",
        description="Largest angle of the ball's place from straight before the goal.",
        json_schema_extra={"unit": "deg"},
    )
    sliding_fraction: float = fraction(
        0.5,
        "Sliding shots",
        "Fraction of the shots that slide at first, as kicked balls do, and are faster by 7/5 until they roll.",
    )
    astray_m: float = Field(
        default=0.3,
        ge=0.0,
        le=1.0,
        title="Astray",
        description="Largest distance of the robot from where a keeper waits, along and across the goal line.",
        json_schema_extra={"unit": "m"},
    )
    save_weight: float = weight(5.0, "Save weight", "Reward for a shot that is saved.")
    goal_penalty: float = weight(5.0, "Goal penalty", "Penalty for a shot that goes in.")
    cover_weight: float = weight(0.05, "Cover weight", "Reward per step for standing where the ball comes.")


def draw_shot(
    settings: BlockSettings, half_m: float, draw: FloatArray, slides: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return (k,) angles and distances of balls from the middle of a goal, and the speeds and directions of the shots.

    Angles are radians, counted from the way out of the goal, which leads along an axis of the field.

    Args:
        settings: where shots come from, and how fast.
        half_m: half the width of the goal, metres.
        draw: (4, k) random numbers from 0 to 1.
        slides: (k,) shots that slide at first.
    """
    angle = np.radians(settings.shot_angle_max_deg) * (2.0 * draw[0] - 1.0)
    distance = between(settings.shot_distance_min_m, settings.shot_distance_max_m, draw[1])
    # to a point between the posts, fast enough to get there
    target = (half_m - _INSIDE_M) * (2.0 * draw[2] - 1.0)
    needed = rolling.launch(_BEYOND * distance, np.zeros_like(distance))[0]
    slowest = np.minimum(np.maximum(settings.shot_speed_min_mps, needed), settings.shot_speed_max_mps)
    speed = between(slowest, settings.shot_speed_max_mps, draw[3])
    # it rolls against the way out, to whose left the goal's right is
    way = np.pi + rolling.aim(speed, distance * np.cos(angle), distance * np.sin(angle) - target, slides)
    return angle, distance, speed, way


class Block(BallTask[BlockSettings]):
    """Stop shots at the goal, on one's feet.

    The walker's inputs are observed, too, with the commands of a simple keeper: face the field, and step sideways to
    where the ball comes.
    """

    name = "block"
    summary = "Stop shots at the goal, and stay on one's feet."
    Parameters = BlockSettings
    metrics = (SAVED, CONCEDED, STOPPED, FALL_RATE)
    ends = (FALL, End("conceded", "Goal against", failure=True), SAVE)
    trace = ("ball_x", "ball_y", "touched", "speed", "distance")
    presentation = Presentation(
        skill="Keep goal",
        charts=(
            Chart("Saves", ("saved_rate",)),
            Chart("Touched", ("stopped_rate",)),
            Chart("Goals and falls", ("conceded_rate", "fall_rate")),
            Chart("Reward", ("reward",)),
            Chart("Episode length", ("episode_length",)),
        ),
        listed=("saved_rate", "fall_rate"),
        headline=("saved_rate", "stopped_rate", "fall_rate"),
        repeats=False,
    )
    ends_are_final = True
    horizon_is_terminal = True
    velocity_share = _SHARE
    standing = 0.6

    def __init__(self, parameters: BlockSettings, world: World, seed: int = 0) -> None:
        super().__init__(parameters, world, seed)
        n = self.n
        self.max_steps = round(12.0 / STEP_S)
        self._goal: FloatArray = self.add_array("goal", 2)  # middle of its line; the aim leads from it into the field
        self._shot: FloatArray = self.add_array("shot", 2)  # speed and distance
        self._calm: IntArray = self.add_array("calm", fill=0)  # steps for which the ball has not come nearer
        self._touched: BoolArray = self.add_array("touched", fill=False)
        self._cover: FloatArray = np.zeros(n)
        self._conceded: BoolArray = np.zeros(n, dtype=np.bool_)
        self._saved: BoolArray = np.zeros(n, dtype=np.bool_)
        aim = self.stored("aim")
        self.measurements = (
            StoredNumbers([*self._entered.last_actions(), Store(aim, begin=given("aim", aim)), *self._follow()]),
        )
        self.flags = (self._fallen, self._conceded, self._saved)

    # what is observed

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return what the walker observes, the ball as it is perceived, and where it comes and the goal is."""
        names = ("ball_along", "ball_across", "ball_speed_along", "ball_speed_across", "crossing", "crossing_time")
        shot = ObservationBlock(
            ("aim_sin", "aim_cos", *names, "goal_along", "goal_across"),
            stack(sin(self._turn), cos(self._turn), self._near, self._speeds, *self._crossing, self._place),
            signs=(-1.0, 1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, 1.0, -1.0),
            spread=(0.3, 0.1, 0.6, 0.6, 1.5, 1.0, 0.6, 0.6, 0.3, 0.6),
        )
        return [*super().observation_blocks(), shot]

    def critic_blocks(self) -> Sequence[ObservationBlock]:
        """Return what only a critic observes: the ball's true motion, where it comes, and what has become of it."""
        names = ("ball_along", "ball_across", "ball_speed_along", "ball_speed_across", "ball_height", "crossing")
        truth = ObservationBlock(
            tuple(f"true_{name}" for name in (*names, "touched", "calm")),
            self._truth,
            signs=(1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, 1.0),
        )
        return [*super().critic_blocks(), truth, *self._foot_blocks()]

    @property
    def _truth(self) -> Number:
        ball = {part: self.world.body(BALL, part) for part in ("position", "velocity")}
        aim = self.stored("aim")
        way, speed = along(aim, ball["position"][:2] - self.world.true_position[:2]), along(aim, ball["velocity"][:2])
        height, calm = ball["position"][2], minimum(self.stored("calm"), 100.0) / 50.0
        return stack(clip(way, -3.0, 3.0), speed, height, self._true_crossing, self.stored("touched"), calm)

    @property
    def _near(self) -> Number:
        """Return how far ahead and to the left in the aim's direction the ball is perceived, near the robot."""
        return clip(self._behind, -_REACH_M, _REACH_M)

    @property
    def _speeds(self) -> Number:
        return along(self.stored("aim"), clip(self.stored("expected"), -8.0, 8.0))

    @property
    def _crossing(self) -> tuple[Number, Number]:
        """Return how far to the left, and after how many seconds, the ball passes the robot, as it is perceived."""
        aim = self.stored("aim")
        way = along(aim, self._seen_at - self.world.perceived("torso_pos")[:2])
        speed = self._speeds
        time = clip(way[0] / maximum(speed[0] * -1.0, _COMES) - minimum(self._age, 50.0) * STEP_S, 0.0, _SOON_S)
        since = time + minimum(self._age, 50.0) * STEP_S
        comes = (speed[0] < -_COMES) & (self.stored("sightings") > 1.0)
        return clip(way[1] + speed[1] * since, -_REACH_M, _REACH_M) * comes, where(comes, time, _SOON_S)

    @property
    def _true_crossing(self) -> Number:
        """Return how far to the left of the robot the ball truly passes, metres; 0 if it does not come nearer."""
        aim = self.stored("aim")
        way = along(aim, self.world.body(BALL, "position")[:2] - self.world.true_position[:2])
        speed = along(aim, self.world.body(BALL, "velocity")[:2])
        time = clip(way[0] / maximum(speed[0] * -1.0, _COMES), 0.0, 10.0)
        return clip(way[1] + speed[1] * time, -_REACH_M, _REACH_M) * (speed[0] < -_COMES)

    @property
    def _place(self) -> Number:
        """Return how far before the goal line, and to the left of its middle, the robot perceives itself."""
        goal = given("goal", self.stored("goal"))
        return clip(along(self.stored("aim"), self.world.perceived("torso_pos")[:2] - goal), -_REACH_M, _REACH_M)

    def _steer(self) -> list[Store]:
        """Return the walker's command: face the field, stay before the goal line, step to where the ball comes."""
        crossing, place, half = self._crossing[0], self._place, 0.5 * self.robot.field.goal.width_m
        left = maximum(minimum(crossing, place[1] * -1.0 + half), place[1] * -1.0 - half)
        walk = self._walk(
            clip((place[0] * -1.0 + HOME_M) * 2.0, -0.4, 0.4),
            clip(left * 4.0, -1.0, 1.0),
            [-0.5, -1.0, -1.0],
            [0.5, 1.0, 1.0],
        )
        command = where(self.stored("sightings") > 1.0, walk, 0.0)
        return [self._command_walker(command)]

    # starts

    def place(self, rows: IntArray) -> None:
        """Draw state and shot, and put the robot into the state before its goal, and the ball on its way."""
        settings, goal = self.parameters, self.robot.field.goal
        draw = self._drawn(rows, _STREAM, 9)
        slides = draw[8] < settings.sliding_fraction
        angle, distance, speed, way = draw_shot(settings, 0.5 * goal.width_m, draw[1:5], slides)
        # the goal opens along +x; the robot faces roughly the ball
        self._put(rows, draw[0], 0.5 * angle + 0.3 * (2.0 * draw[5] - 1.0))
        self._aim[rows] = 0.0
        place = np.stack([HOME_M * np.cos(angle), HOME_M * np.sin(angle)], axis=1)
        place += settings.astray_m * (2.0 * draw[6:8].T - 1.0)
        self._goal[rows] = self.world.position(rows)[:, :2] - place
        self._shot[rows] = np.stack([speed, distance], axis=1)
        ahead, aside = distance * np.cos(angle) - place[:, 0], distance * np.sin(angle) - place[:, 1]
        self._put_ball(rows, np.zeros(len(rows)), ahead, aside, speed, way, slides)

    def handed_over(self, row: int) -> dict[str, AnyArray]:
        """Return what an exported skill is given when it begins: where the goal is, and the walker's last step."""
        return {"target": self._goal[row].copy(), **self._last_step(row)}

    # steps

    def skill_over(self, rows: slice | IntArray) -> BoolArray:
        """Return in which robots the ball has not come nearer for a second, after which a player walks on."""
        return np.asarray(self._calm[rows] >= _OVER_S / STEP_S)

    def _follow(self) -> list[Store]:
        """Return what is measured of a step: where the ball is, falls and ends."""
        world, aim, zero, goal = self.world, self.stored("aim"), constant(0.0), self.robot.field.goal
        touched, calm = self.stored("touched"), self.stored("calm")
        fallen, conceded, saved = (source(each) for each in (self._fallen, self._conceded, self._saved))
        ball = world.body(BALL, "position")
        place = along(aim, ball[:2] - self.stored("goal"))
        behind = place[0] < -self._radius
        between = (absolute(place[1]) < 0.5 * goal.width_m) & (ball[2] < goal.height_m)
        away = along(aim, world.body(BALL, "velocity")[:2])[0] > _AWAY
        cover = exp(square(self._true_crossing / _NEAR_M) * -1.0) * ~(away | behind)
        return [
            Store(touched, begin=zero, update=(touched > 0.0) | (world.contact("robot") > 0.0)),
            Store(calm, begin=zero, update=where(away | behind, calm + 1.0, 0.0)),
            Store(source(self._cover), update=cover),
            self._falls(),
            Store(conceded, begin=zero, update=behind & between & ~fallen),
            Store(saved, begin=zero, update=(calm >= CALM_S / STEP_S) & ~fallen & ~conceded),
        ]

    def reward_terms(self) -> Sequence[RewardTerm]:
        """Return the rewards for standing in the ball's way and for a save, and the penalties."""
        settings = self.parameters
        return (
            RewardTerm("cover", settings.cover_weight, source(self._cover)),
            RewardTerm("save", settings.save_weight, source(self._saved)),
            RewardTerm("goal", -settings.goal_penalty, source(self._conceded)),
            RewardTerm("fall", -settings.fall_penalty, source(self._fallen)),
            *penalties(self.world, settings),
        )

    # results

    def succeeded(self, rows: IntArray) -> BoolArray:
        """Return which robots have saved the shot."""
        return self._saved[rows] > 0

    def measure(self, rows: IntArray) -> FloatArray:
        """Return save, goal, touch, and fall."""
        return np.stack([each[rows] for each in (self._saved, self._conceded, self._touched, self._fallen)], axis=1)

    def trace_row(self, rows: IntArray) -> FloatArray:
        """Return the ball's place, whether it was touched, and the shot."""
        ball = self.world.bodies[BALL].position[rows, :2]
        return np.column_stack([ball, self._touched[rows], self._shot[rows]])

    def summarize(self, episodes: Episodes, statistics: Statistics) -> tuple[Sequence[Result], Sequence[ResultTable]]:
        """Return how many shots are saved, and of shots by speed from near and from far."""
        shots: FloatArray = np.array([trace[-1, 2:5] for trace in episodes.trace])
        saved, speed, distance = episodes.ends["saved"], shots[:, 1], shots[:, 2]
        middle = 0.5 * (self.parameters.shot_distance_min_m + self.parameters.shot_distance_max_m)
        results = (
            statistics.rate(SAVED, saved),
            statistics.rate(CONCEDED, episodes.ends["conceded"]),
            statistics.rate(STOPPED, shots[:, 0] > 0.0),
            statistics.rate(FALL_RATE, episodes.ends["fallen"]),
        )
        column = np.searchsorted(SPEEDS_MPS, speed)
        classes = {f"Nearer than {middle:g} m": distance < middle, f"{middle:g} m and more": distance >= middle}
        by_speed = ResultTable(
            "shots",
            "Saves by shot",
            "Fraction of the shots up to this speed, and above the one before, that are saved.",
            Metric("shot_speed_mps", "Shot", "m/s", digits=1),
            SPEEDS_MPS,
            {
                title: tuple(statistics.rate(SAVED, saved[chosen & (column == i)]) for i in range(len(SPEEDS_MPS)))
                for title, chosen in classes.items()
            },
        )
        return results, (by_speed,)
