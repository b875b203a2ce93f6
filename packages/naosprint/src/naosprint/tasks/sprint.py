"""The sprint tasks: run straight ahead, as fast as possible.

The paper takes the speed from a start line on, over episodes that have at least 200 samples beyond it. That hides early
falls, so the same results over all episodes are given, too.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from naosim.simulator import STEP_S
from naospec.metrics import Chart, FieldLine, Metric, Presentation, Reference, Result, ResultTable
from pydantic import Field

from naosprint.tasks.base import End, RewardTerm, Task, seconds
from naosprint.tasks.disturbance_settings import DisturbanceSettings
from naosprint.tasks.episodes import rate_metric
from naosprint.tasks.falls import FALL, FALL_RATE, FallSettings, with_min_height
from naosprint.tasks.measurements import Below, Beyond, Deviation, Displacement
from naosprint.tasks.penalties import PenaltySettings, penalties
from naosprint.tasks.robot_defaults import robot_defaults
from naosprint.tasks.statistics import spread
from naosprint.tasks.world import World
from naosprint.terms import source

if TYPE_CHECKING:
    from collections.abc import Sequence

    from naosim.robots import Robot

    from naosprint.arrays import FloatArray, IntArray
    from naosprint.tasks.episodes import Episodes, Statistics
    from naosprint.tasks.observations import ObservationBlock

START_X_M = -14.0
"""World x of the torso at the start, metres."""

FINISH_X_M = 14.0
"""World x of the finish line of sprint task I, metres."""

START_LINES_M = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5)
"""Distances of the start lines from the start, metres."""

MIN_SAMPLES = 200
"""Samples beyond a start line that an episode needs to count in the top speed, as in the paper."""

NAO = ("nao",)
"""Families of the robots that the paper and the rules of the run challenge are about."""

PAPER_FALL_HEIGHT_M = 0.33
"""Torso height at the end below which the paper's statistics count a fall, metres."""

CHALLENGE_LINE_M = 0.5
"""Run challenge: the clock starts this far from the start, metres."""

CHALLENGE_START_S = 4.0
"""Run challenge: the clock starts at the latest after this time, seconds."""

CHALLENGE_RUN_S = 20.0
"""Run challenge: longest time on the clock, seconds."""

CHALLENGE_FALL_HEIGHT_M = 0.25
"""Run challenge: torso height of a fall, metres."""

CHALLENGE_FALL_UP = 0.6
"""Run challenge: upward component of the torso's up-vector below which it has fallen."""

CHALLENGE_PENALTY_M = 2.0
"""Run challenge: distance that a fall costs, metres."""

DISTANCE = Metric("distance_m", "Distance", "m", "Forward displacement of the torso.", 2, "higher")
SPEED = Metric("speed_mps", "Mean speed", "m/s", "Distance divided by duration, start included.", 2, "higher")
LENGTH = Metric("episode_length", "Episode length", "steps", "Length of an episode.", 0, live=False)
ARRIVAL_RATE = rate_metric("arrival_rate", "Arrivals", "Fraction of episodes that reached the finish line.", live=False)
TIME_LIMIT_RATE = rate_metric(
    "time_limit_rate", "Time limits", "Fraction of episodes that reached the time limit.", None, live=False
)
TOP_SPEED = Metric(
    "top_speed_mps",
    "Top speed",
    "m/s",
    f"Highest mean speed from any start line, over episodes with at least {MIN_SAMPLES} samples beyond it.",
    2,
    "higher",
    live=False,
)
FASTEST = Metric("fastest_mps", "Fastest episode", "m/s", "Top speed of the fastest episode.", 2, "higher", live=False)
DEVIATION = Metric(
    "deviation_deg",
    "Deviation",
    "°",
    "Angle between the running direction and the line from start to end.",
    2,
    "lower",
    live=False,
)
LOW_AT_END = rate_metric(
    "low_at_end",
    "Low at the end",
    f"Fraction of episodes with the torso below {PAPER_FALL_HEIGHT_M} m at the end.",
    "lower",
    live=False,
    families=NAO,
)
FLIGHT = Metric(
    "flight_share",
    "Both feet off the ground",
    "%",
    "Fraction of the time with both feet off the ground.",
    1,
    None,
    live=False,
)
CHALLENGE_SCORE = Metric(
    "run_challenge_score",
    "Run challenge score",
    "",
    "The league's run challenge: speed in m/s plus fraction of the time with both feet off the ground. The speed is "
    f"measured from {CHALLENGE_LINE_M} m on; a fall costs {CHALLENGE_PENALTY_M:.0f} m and the whole time of "
    f"{CHALLENGE_RUN_S:.0f} s. 0 for a robot that gets no further.",
    3,
    "higher",
    live=False,
    families=NAO,
)
CHALLENGE_SPEED = Metric(
    "run_challenge_speed_mps",
    "Run challenge speed",
    "m/s",
    "Speed by the rules of the run challenge.",
    2,
    "higher",
    live=False,
    families=NAO,
)
CHALLENGE_FLIGHT = Metric(
    "run_challenge_flight_share",
    "Run challenge flight",
    "%",
    "Fraction of the run challenge's time with both feet off the ground.",
    1,
    "higher",
    live=False,
    families=NAO,
)
CHALLENGE_FALLS = rate_metric(
    "run_challenge_fall_rate",
    "Run challenge falls",
    "Falls by the rules of the run challenge, in which a robot has fallen when its torso is below 0.25 m or tilted by "
    "more than 53 degrees at any time.",
    "lower",
    live=False,
    families=NAO,
)


class SprintSettings(FallSettings, PenaltySettings, DisturbanceSettings):
    """Settings of the sprint tasks."""

    drift_penalty: float = Field(
        default=1.0,
        ge=0.0,
        le=10.0,
        title="Drift penalty",
        description="Penalty per meter of distance from the line straight ahead, as a share of the reward per meter.",
    )
    fall_penalty_m: float = Field(
        default=0.0,
        ge=0.0,
        le=100.0,
        title="Fall penalty",
        description="Penalty for a fall, as the reward for this many meters forward.",
        json_schema_extra={"unit": "m"},
    )


class Sprint(Task[SprintSettings]):
    """Run forward from standing."""

    Parameters = SprintSettings
    metrics = (DISTANCE, FALL_RATE, SPEED)
    results = (
        ARRIVAL_RATE,
        TIME_LIMIT_RATE,
        TOP_SPEED,
        FASTEST,
        DEVIATION,
        LOW_AT_END,
        FLIGHT,
        CHALLENGE_SCORE,
        CHALLENGE_SPEED,
        CHALLENGE_FLIGHT,
        CHALLENGE_FALLS,
    )
    ends = (FALL, End("arrived", "Arrival"))
    presentation = Presentation(
        skill="Sprint",
        charts=(
            Chart("Speed", ("speed_mps",)),
            Chart("Distance", ("distance_m",)),
            Chart("Falls", ("fall_rate",)),
            Chart("Reward", ("reward",)),
            Chart("Episode length", ("episode_length",)),
        ),
        listed=("distance_m", "speed_mps", "fall_rate"),
        headline=("top_speed_mps", "speed_mps", "distance_m", "fall_rate", "deviation_deg"),
        references=(
            Reference("speed_mps", 2.60, "2.60 m/s, best before the paper", NAO),
            Reference("speed_mps", 3.91, "3.91 m/s, the paper", NAO),
        ),
    )
    finish_x_m: ClassVar[float | None] = None
    erect: ClassVar[bool] = False

    @classmethod
    def resolve(cls, parameters: SprintSettings, robot: Robot) -> SprintSettings:
        """Return the settings with the robot's own minimum height where none is given."""
        super().resolve(parameters, robot)
        usual = robot_defaults(robot)
        return with_min_height(parameters, robot, usual.erect_height_m if cls.erect else usual.fall_height_m)

    def __init__(self, parameters: SprintSettings, world: World, seed: int = 0) -> None:
        super().__init__(parameters, world, seed)
        self._along = Displacement(world)
        self._aside = Deviation(world, self.start_position()[1])
        self._fallen = Below(world, float(parameters.min_height_m or 0.0))  # resolve has filled it in
        finish = np.inf if self.finish_x_m is None else self.finish_x_m
        arrived = Beyond(self._along.now, finish, self._fallen.flag)
        self.measurements = (self._along, self._aside, self._fallen, arrived)
        self.flags = (self._fallen.flag, arrived.flag)
        self.arrays = {"x": self._along.now, "start_x": self._along.start, "aside": self._aside.now}

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return the robot's usual observations, and the distance from the line if the robot perceives where it is."""
        return [*super().observation_blocks(), *(self._line() if self.world.defaults.knows_position else ())]

    def critic_blocks(self) -> Sequence[ObservationBlock]:
        """Return the distance from the line where the robot does not perceive it."""
        return [*super().critic_blocks(), *(() if self.world.defaults.knows_position else self._line())]

    def _line(self) -> Sequence[ObservationBlock]:
        """Return the distance from the line, if the simulator tells where the robot is."""
        from naosprint.tasks.observations import ObservationBlock

        if "torso_pos" not in self.world.perceptors:
            return ()
        offset = self.world.perceived("torso_pos")[1] - self.start_position()[1]
        return (ObservationBlock(("line_offset",), offset, signs=(-1.0,)),)

    def start_position(self) -> tuple[float, float]:
        """Return the start: 14 m before the middle of the field, in the robot's lane."""
        return (START_X_M, float(self.robot.data.get("lane_y_m", 0.0)))

    def reward_terms(self) -> Sequence[RewardTerm]:
        """Return forward displacement and the penalties, in metres."""
        parameters = self.parameters
        return (
            RewardTerm("forward", 1.0, source(self._along.change)),
            RewardTerm("drift", -parameters.drift_penalty, source(self._aside.change)),
            RewardTerm("fall", -parameters.fall_penalty_m, source(self._fallen.flag)),
            *penalties(self.world, parameters),
        )

    def measure(self, rows: IntArray) -> FloatArray:
        """Return distance, fall and speed."""
        distance = self._along.now[rows] - self._along.start[rows]
        return np.stack([distance, self._fallen.flag[rows], distance / seconds(self.world.steps[rows])], axis=1)

    def summarize(self, episodes: Episodes, statistics: Statistics) -> tuple[Sequence[Result], Sequence[ResultTable]]:
        """Return the paper's statistics, those over all episodes, and the league's run challenge."""
        steps = episodes.steps
        distance = np.array([x[-1] - x[0] for x in episodes.x])
        deviation = np.array([deviation_deg(x, y) for x, y in zip(episodes.x, episodes.y, strict=True)])
        airborne = np.array([flags[1:].mean() for flags in episodes.airborne])
        low_at_end = np.array([height[-1] < PAPER_FALL_HEIGHT_M for height in episodes.height])
        long, everyone = [], []
        for line in START_LINES_M:
            long.append(statistics.mean(SPEED, speeds_beyond(episodes.x, line, MIN_SAMPLES)))
            everyone.append(statistics.mean(SPEED, speeds_beyond(episodes.x, line, 2)))
        top = max(long, key=lambda result: result.value or 0.0)
        challenge = np.array([_challenge(episodes, i) for i in range(len(episodes))])
        results = (
            statistics.mean(DISTANCE, distance),
            statistics.mean(SPEED, distance / (steps * STEP_S)),
            statistics.mean(LENGTH, steps),
            statistics.rate(FALL_RATE, episodes.ends["fallen"]),
            statistics.rate(ARRIVAL_RATE, episodes.ends["arrived"]),
            statistics.rate(TIME_LIMIT_RATE, steps >= episodes.max_steps),
            Result(
                TOP_SPEED,
                top.value,
                sd=top.sd,
                interval=top.interval,
                low=top.low,
                high=top.high,
                episodes=top.episodes,
            ),
            Result(FASTEST, max((result.high or 0.0 for result in long), default=None), episodes=top.episodes),
            Result(DEVIATION, float(deviation.mean()), sd=spread(deviation), episodes=len(deviation)),
            statistics.rate(LOW_AT_END, low_at_end),
            statistics.mean(FLIGHT, airborne),
            statistics.mean(CHALLENGE_SCORE, challenge[:, 0]),
            statistics.mean(CHALLENGE_SPEED, challenge[:, 1]),
            statistics.mean(CHALLENGE_FLIGHT, challenge[:, 2]),
            statistics.rate(CHALLENGE_FALLS, challenge[:, 3] > 0.0),
        )
        table = ResultTable(
            "speed_by_line",
            "Speed by start line",
            "Speed from a line behind the start to the last sample. Episodes with fewer than "
            f"{MIN_SAMPLES} samples beyond the line, which last less than 4 s there, are left out of one column.",
            Metric("line_m", "Start line", "m", digits=1),
            START_LINES_M,
            {"4 s or longer": tuple(long), "All episodes": tuple(everyone)},
        )
        return results, (table,)


class Sprint1(Sprint):
    """Sprint task I: 28 m to the finish line."""

    name = "sprint1"
    summary = "Run 28 m to the finish line at x = 14 m."
    finish_x_m = FINISH_X_M
    presentation = replace(
        Sprint.presentation,
        references=(*Sprint.presentation.references, Reference("distance_m", FINISH_X_M - START_X_M, "28 m, finish")),
        lines=(FieldLine(FINISH_X_M, "finish"),),
    )
    # a limit for robots that neither fall nor arrive; 60 s is twice what the slowest useful walk needs
    max_steps = 3000


class Sprint1Erect(Sprint1):
    """Sprint task I with the torso kept erect."""

    name = "sprint1-erect"
    summary = "Run 28 m to the finish line at x = 14 m, torso kept erect."
    erect = True


class Sprint2(Sprint):
    """Sprint task II: 8 s."""

    name = "sprint2"
    summary = "Run as far as possible in 400 steps (8 s)."
    max_steps = 400
    horizon_is_terminal = True


class Sprint2Erect(Sprint2):
    """Sprint task II with the torso kept erect."""

    name = "sprint2-erect"
    summary = "Run as far as possible in 400 steps (8 s), torso kept erect."
    erect = True


def speeds_beyond(xs: list[FloatArray], line_m: float, min_samples: int) -> FloatArray:
    """Return each episode's mean speed in m/s over its samples beyond a line, if it has enough of them."""
    speeds = []
    for x in xs:
        beyond = np.flatnonzero(x >= x[0] + line_m)
        if len(beyond) < min_samples:
            continue
        first, last = beyond[0], beyond[-1]
        speeds.append((x[last] - x[first]) / ((last - first) * STEP_S))
    return np.array(speeds)


def deviation_deg(x: FloatArray, y: FloatArray) -> float:
    """Return the angle in degrees between the running direction and the line from start to end."""
    return float(np.degrees(np.arctan2(abs(y[-1] - y[0]), abs(x[-1] - x[0]))))


def _challenge(episodes: Episodes, i: int) -> tuple[float, float, float, float]:
    """Score one episode by the league's run challenge: speed plus fraction of the time with both feet off the ground.

    The challenge starts at x = -13.5 and ends at 14.5; a sprint from -14 to 14 is the same 28 m, half a metre to the
    left. A fall costs 2 m and the whole running time.

    Returns:
        Score, speed in m/s, fraction of steps off the ground, and 1 for a fall.
    """
    x = episodes.x[i] - episodes.x[i][0]
    late = np.arange(len(x)) * STEP_S > CHALLENGE_START_S
    started = np.flatnonzero((x > CHALLENGE_LINE_M) | late)
    first = int(started[0]) if len(started) else len(x) - 1
    last = min(len(x) - 1, first + round(CHALLENGE_RUN_S / STEP_S))
    down = (episodes.height[i][: last + 1] < CHALLENGE_FALL_HEIGHT_M) | (episodes.up[i][: last + 1] < CHALLENGE_FALL_UP)
    fell = bool(down.any()) or (bool(episodes.ends["fallen"][i]) and last == len(x) - 1)
    if down.any():
        last = max(int(np.flatnonzero(down)[0]), first)
    duration = CHALLENGE_RUN_S if fell else max((last - first) * STEP_S, STEP_S)
    reached = x[last] - (CHALLENGE_PENALTY_M if fell else 0.0)
    speed = max(reached - CHALLENGE_LINE_M, 0.0) / duration
    off_ground = float(episodes.airborne[i][first : last + 1].mean())
    # a robot that runs backwards or jumps on the spot has not run
    score = speed + off_ground if speed > 0.0 else 0.0
    return score, speed, off_ground, float(fell)
