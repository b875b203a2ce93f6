"""Dribbling: running behind a ball along a commanded line, at a commanded speed, and around corners.

A line begins where the ball is perceived when it is commanded. In trainings lines and speeds change at random moments,
in evaluations a course is run: ten metres along a line, a turn of 90 degrees, and ten metres along the next.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

import numpy as np
from naosim.simulator import BALL, STEP_S
from naospec.metrics import Chart, Metric, Presentation, Result, ResultTable
from pydantic import Field

from naosprint.tasks.ball import BallTask, NearBallSettings, components, principal
from naosprint.tasks.base import End, RewardTerm
from naosprint.tasks.episodes import rate_metric
from naosprint.tasks.falls import FALL, FALL_RATE
from naosprint.tasks.fields import between, weight
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
    equal,
    exp,
    given,
    hypot,
    maximum,
    minimum,
    sin,
    source,
    square,
    stack,
    uniform,
    where,
    wrapped,
)
from naosprint.terms.geometry import along

if TYPE_CHECKING:
    from collections.abc import Sequence

    from naosprint.arrays import AnyArray, BoolArray, FloatArray, IntArray
    from naosprint.tasks.episodes import Episodes, Statistics

LEG_M = 10.0
"""Length of each of the two lines of an evaluation's course, metres."""

CORRIDOR_HALF_M = 0.75
"""Half the width of the corridor around a line, metres."""

CORNER_M = 2.0
"""Way along the second line within which the ball may be outside the corridor: it rolls on while the robot turns."""

LEAD_M = 0.8
"""Distance of the ball ahead of the torso from which an opponent could take it, metres."""

LOST_M = 2.0
"""Distance of the ball from the torso at which an episode ends, metres."""

_TURN = np.pi / 2.0
_FLOW_SHARE = 0.04  # of the present velocity in the ball's mean velocity: half a second
_NEAR_M, _NEAR_SPREAD_M = 0.45, 0.3  # distance at which a ball is near, and how fast the reward for it falls
_OFFSET_M = 1.0  # largest distance from the line that is observed and penalized
_TRACKING_SCALE = 0.25  # squared error at which the narrow part of the reward has fallen to 1/e, (m/s)^2
_SHARE = 0.5  # share of a new velocity in the perceived velocity of the ball
_STREAM = 0xD21B

BALL_SPEED = Metric("ball_speed_mps", "Ball's speed", "m/s", "Mean speed of the ball along its line.", 2, "higher")
BALL_ERROR = Metric(
    "ball_error_mps",
    "Velocity error",
    "m/s",
    "Mean distance between the commanded velocity and the ball's, averaged over half a second.",
    2,
    "lower",
)
AHEAD = Metric("ahead_m", "Ball ahead", "m", "Mean distance of the ball ahead of the torso.", 2, "lower")
LOST_RATE = rate_metric("lost_rate", "Ball lost", "Fraction of episodes that ended with a lost ball.", "lower")
LINE = rate_metric(
    "line_rate",
    "Along a line",
    "Fraction of the starts from which the ball is dribbled 10 m through a corridor of 1.5 m.",
    live=False,
)
CORNER = rate_metric(
    "corner_rate",
    "Around a corner",
    "Fraction of the turns of 90 degrees after which the ball is dribbled 10 m, from the third metre on in a corridor "
    "of 1.5 m.",
    live=False,
)
KEPT = rate_metric(
    "kept_rate",
    "Ball kept close",
    f"Fraction of the lines dribbled to their ends on which the ball is never more than {LEAD_M:g} m ahead.",
    live=False,
)
COURSE_SPEED = Metric(
    "course_speed_mps",
    "Speed on the line",
    "m/s",
    "Mean speed of the ball along the lines that it is dribbled along.",
    2,
    "higher",
    live=False,
)
FARTHEST = Metric(
    "farthest_m",
    "Farthest ball",
    "m",
    "Median over the lines of the largest distance of the ball ahead of the torso.",
    2,
    "lower",
    live=False,
)


class DribbleSettings(NearBallSettings):
    """Settings of the task ``dribble``."""

    ranges = (("speed_min_mps", "speed_max_mps"),)

    aim_max_deg: float = Field(
        default=90.0,
        ge=0.0,
        le=180.0,
        title="Largest aim",
        description="Largest angle between the robot's front and the first line.",
        json_schema_extra={"unit": "deg"},
    )
    speed_min_mps: float = Field(
        default=0.6,
        ge=0.0,
        le=3.0,
        title="Slowest ball",
        description="Lower end of the commanded speed of the ball.",
        json_schema_extra={"unit": "m/s"},
    )
    speed_max_mps: float = Field(
        default=1.5,
        ge=0.1,
        le=3.0,
        title="Commanded speed",
        description="Upper end of the commanded speed of the ball, and the speed in evaluations.",
        json_schema_extra={"unit": "m/s"},
    )
    turn_max_deg: float = Field(
        default=120.0,
        ge=0.0,
        le=180.0,
        title="Largest turn",
        description="Largest angle between two lines in trainings.",
        json_schema_extra={"unit": "deg"},
    )
    line_steps: int = Field(
        default=300,
        ge=10,
        le=100_000,
        title="Line length",
        description="Steps after which a new line begins in trainings, on average.",
        json_schema_extra={"unit": "steps"},
    )
    episode_steps: int = Field(
        default=1000,
        ge=10,
        le=100_000,
        title="Episode length",
        description="Length limit of an episode.",
        json_schema_extra={"unit": "steps"},
    )
    course: bool = Field(
        default=False,
        title="Course",
        description="Dribble along two lines of 10 m with a turn of 90 degrees between them, as in evaluations.",
    )
    near_weight: float = weight(0.3, "Near weight", "Reward per step for a ball that is near.")
    offset_penalty: float = weight(
        0.4, "Offset penalty", "Penalty per step and meter of the ball's distance from the line."
    )

    def for_evaluation(self) -> Self:
        """Return the settings without disturbances, for the course, at the highest speed."""
        speed = {"speed_min_mps": self.speed_max_mps}
        return super().for_evaluation().model_copy(update={"course": True, "episode_steps": 2000, **speed})


class Dribble(BallTask[DribbleSettings]):
    """Dribble a ball along a commanded line, at a commanded speed.

    The walker's inputs are observed, too, with the commands of a simple dribble: turn to the line, bring a foot behind
    the ball, and walk through it at the commanded speed.
    """

    name = "dribble"
    summary = "Dribble a ball along a commanded line and around corners."
    Parameters = DribbleSettings
    metrics = (BALL_SPEED, BALL_ERROR, AHEAD, FALL_RATE, LOST_RATE)
    results = (LINE, CORNER, KEPT, COURSE_SPEED, FARTHEST)
    ends = (FALL, End("lost", "Ball lost", failure=True), End("done", "Course"))
    trace = ("ball_x", "ball_y", "ahead", "line", "line_x", "line_y", "direction")
    presentation = Presentation(
        skill="Dribble",
        charts=(
            Chart("Ball's speed", ("ball_speed_mps",)),
            Chart("Velocity error", ("ball_error_mps",)),
            Chart("Falls and lost balls", ("fall_rate", "lost_rate")),
            Chart("Ball ahead", ("ahead_m",)),
            Chart("Reward", ("reward",)),
            Chart("Episode length", ("episode_length",)),
        ),
        listed=("ball_speed_mps", "fall_rate", "lost_rate"),
        headline=("line_rate", "corner_rate", "kept_rate", "course_speed_mps", "fall_rate"),
        repeats=False,
    )
    velocity_share = _SHARE

    def __init__(self, parameters: DribbleSettings, world: World, seed: int = 0) -> None:
        super().__init__(parameters, world, seed)
        n = self.n
        self.max_steps = parameters.episode_steps
        self._speed: FloatArray = self.add_array("speed")  # commanded, m/s
        self._line: FloatArray = self.add_array("line", 2)  # where the line begins
        self._lines: IntArray = self.add_array("lines", fill=0)  # that have begun
        self._flow: FloatArray = self.add_array("flow", 2)  # the ball's velocity, averaged
        self._sums: FloatArray = self.add_array("sums", 3)  # of the ball's speed, its error, and how far ahead it is
        self._error: FloatArray = np.zeros(n)
        self._offset: FloatArray = np.zeros(n)
        self._ahead: FloatArray = np.zeros(n)
        self._apart: FloatArray = np.zeros(n)
        self._lost: BoolArray = np.zeros(n, dtype=np.bool_)
        self._over: BoolArray = np.zeros(n, dtype=np.bool_)  # the ball has passed the end of its line
        self._done: BoolArray = np.zeros(n, dtype=np.bool_)
        self.measurements = (StoredNumbers([*self._entered.last_actions(), *self._follow(), *self._lines_begin()]),)
        self.flags = (self._fallen, self._lost, self._done)

    # what is observed

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return what the walker observes, the ball as it is perceived, and the line."""
        names = ("ball_along", "ball_across", "ball_speed_along", "ball_speed_across", "ball_offset", "ball_speed")
        line = ObservationBlock(
            ("aim_sin", "aim_cos", *names),
            self._dribbled,
            signs=(-1.0, 1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0),
            spread=(0.5, 0.3, 0.3, 0.2, 0.7, 0.4, 0.4, 0.4),
        )
        return [*super().observation_blocks(), line]

    @property
    def _dribbled(self) -> Number:
        sighted, aim = self.stored("sightings") > 0.0, self.stored("aim")
        speeds = along(aim, clip(self.stored("expected"), -4.0, 4.0))
        offset = clip(along(aim, self._seen_at - self.stored("line"))[1], -_OFFSET_M, _OFFSET_M)
        return stack(sin(self._turn), cos(self._turn), self._behind, speeds, offset * sighted, self.stored("speed"))

    def critic_blocks(self) -> Sequence[ObservationBlock]:
        """Return what only a critic observes: the ball's true motion, and where it is before the feet."""
        names = ("speed_along", "speed_across", "flow_along", "flow_across", "ahead", "offset")
        truth = ObservationBlock(
            tuple(f"true_ball_{name}" for name in names), self._truth, signs=(1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
        )
        return [*super().critic_blocks(), truth, *self._foot_blocks()]

    @property
    def _truth(self) -> Number:
        world, aim = self.world, self.stored("aim")
        ball, velocity = world.body(BALL, "position")[:2], world.body(BALL, "velocity")[:2]
        ahead = along(world.true_yaw, ball - world.true_position[:2])[0]
        offset = along(aim, ball - self.stored("line"))[1]
        return stack(along(aim, velocity), along(aim, self.stored("flow")), clip(stack(ahead, offset), -3.0, 3.0))

    def _steer(self) -> list[Store]:
        """Return the walker's command, and where the first line begins: where the ball is seen.

        Turn to the line, bring the nearer foot behind the ball, and walk through it.
        """
        line, turn, speed = self.stored("line"), self._turn, self.stored("speed")
        ahead, across = self._behind[0], self._behind[1]
        begun = where(self._first_sight, self.stored("sighted"), line)
        foot = self.world.defaults.foot_line_m
        aside = across - where(across >= 0.0, foot, -foot)
        ready = clip(2.0 - absolute(aside) / 0.1 - absolute(turn) / 0.3, 0.0, 1.0)
        forward = speed * ready + (1.0 - ready) * clip((ahead - 0.4) * 2.0, -0.4, 0.8)
        walk = self._walk(forward, clip(aside * 3.0, -0.5, 0.5), (-0.4, -0.5, -1.0), (2.0, 0.5, 1.0))
        command = where(self.stored("sightings") > 0.0, walk, 0.0)
        return [
            Store(line, begin=begun, update=begun),
            self._command_walker(command),
        ]

    # starts

    def place(self, rows: IntArray) -> None:
        """Draw state, ball, first line and speed, and put the robot into the state and the ball to its place."""
        settings = self.parameters
        draw = self._drawn(rows, _STREAM, 6)
        heading = 2.0 * np.pi * draw[1]
        self._put(rows, draw[0], heading)
        ahead = between(settings.ball_near_m, settings.ball_far_m, draw[2])
        self._put_ball(rows, heading, ahead, settings.ball_aside_m * (2.0 * draw[3] - 1.0))
        self._aim[rows] = principal(heading + np.radians(settings.aim_max_deg) * (2.0 * draw[4] - 1.0))
        self._speed[rows] = between(settings.speed_min_mps, settings.speed_max_mps, draw[5])
        self._line[rows] = self._start[rows]
        self._lines[rows] = 1

    def handed_over(self, row: int) -> dict[str, AnyArray]:
        """Return what an exported skill is given at its start: direction and speed, and the walker's last step."""
        return {"target": np.array([self._aim[row], self._speed[row]]), **self._last_step(row)}

    # steps

    def _follow(self) -> list[Store]:
        """Return what is measured of a step: the ball against the line, falls and ends."""
        world, aim, flow, zero = self.world, self.stored("aim"), self.stored("flow"), constant(0.0)
        ball, velocity = world.body(BALL, "position")[:2], world.body(BALL, "velocity")[:2]
        error, offset, ahead, distance, fallen = (
            source(each) for each in (self._error, self._offset, self._ahead, self._apart, self._fallen)
        )
        over, sums = source(self._over), self.stored("sums")
        flowing, way = along(aim, flow), along(aim, ball - self.stored("line"))
        apart = ball - world.true_position[:2]
        course = constant(float(self.parameters.course))
        return [
            Store(flow, begin=constant([0.0, 0.0]), update=flow + _FLOW_SHARE * (velocity - flow)),
            Store(error, update=hypot(flowing[0] - self.stored("speed"), flowing[1])),
            Store(offset, update=minimum(absolute(way[1]), _OFFSET_M)),
            Store(over, update=way[0] >= LEG_M),
            Store(distance, update=hypot(apart[0], apart[1])),
            Store(ahead, update=along(world.true_yaw, apart)[0]),
            Store(sums, begin=constant([0.0] * 3), update=sums + stack(along(aim, velocity)[0], error, ahead)),
            self._falls(),
            Store(source(self._lost), begin=zero, update=(distance > LOST_M) & ~fallen),
            Store(source(self._done), begin=zero, update=course & over & (self.stored("lines") > 1.0) & ~fallen),
        ]

    def _lines_begin(self) -> list[Store]:
        """Return what begins new lines where the ball is perceived, and draws their directions and the ball's speed.

        A course has one, to the left or to the right. Otherwise they begin at random moments.
        """
        settings, world, streams = self.parameters, self.world, source(self.world.streams)
        aim, speed, line, lines, draws = (self.stored(name) for name in ("aim", "speed", "line", "lines", "draws"))
        fresh = source(np.zeros(self.n, dtype=np.bool_))
        if settings.course:
            drawn = uniform(self.seed + _STREAM + 2, streams, draws, 1)
            begins = source(self._over) & equal(lines, 1.0)
            turn, drawn_speed = where(drawn < 0.5, -_TURN, _TURN), speed
        else:
            # numbers that count the steps of a robot's episodes one after the other
            moments = draws * self.max_steps + world.step
            drawn = uniform(self.seed + _STREAM + 1, streams, moments, 3)
            begins = drawn[0] < 1.0 / settings.line_steps
            turn = np.radians(settings.turn_max_deg) * (2.0 * drawn[1] - 1.0)
            drawn_speed = between(settings.speed_min_mps, settings.speed_max_mps, drawn[2])
        renewed = given("new_line", fresh) & (self.stored("sightings") > 0.0)
        return [
            Store(fresh, update=begins),
            Store(aim, begin=given("aim", aim), update=given("aim", where(fresh, wrapped(aim + turn), aim))),
            Store(speed, begin=given("speed", speed), update=given("speed", where(fresh, drawn_speed, speed))),
            Store(line, update=where(renewed, self.stored("sighted"), line)),
            Store(lines, update=lines + fresh),
        ]

    def reward_terms(self) -> Sequence[RewardTerm]:
        """Return rewards for a ball that is near and moves as commanded, and the penalties."""
        settings, error = self.parameters, source(self._error)
        far = maximum(source(self._apart) - _NEAR_M, 0.0) / _NEAR_SPREAD_M
        near = exp(square(far) * -1.0)
        # the Gaussian alone has no slope for a ball that lies and should roll at 1.5 m/s
        tracking = 0.5 * exp(square(error) * -1.0 / _TRACKING_SCALE) + 0.5 / (1.0 + error)
        return (
            RewardTerm("track_ball", 1.0, tracking * (0.3 + 0.7 * near)),
            RewardTerm("near", settings.near_weight, near),
            RewardTerm("offset", -settings.offset_penalty, source(self._offset)),
            RewardTerm("fall", -settings.fall_penalty, source(self._fallen)),
            *penalties(self.world, settings),
        )

    def share_of_speed(self) -> FloatArray:
        """Return the (n,) speed of the ball along its line, averaged over half a second, as a share of the command."""
        return components(self._aim, self._flow)[0] / np.maximum(self._speed, 0.1)

    # results

    def measure(self, rows: IntArray) -> FloatArray:
        """Return the ball's speed and error, how far ahead it was, and fall and loss."""
        means = self._sums[rows] / np.maximum(self.world.steps[rows], 1)[:, None]
        return np.column_stack([means, self._fallen[rows], self._lost[rows]])

    def trace_row(self, rows: IntArray) -> FloatArray:
        """Return the ball's place, how far ahead it is, and the line."""
        ball = self.world.bodies[BALL].position[rows, :2]
        return np.column_stack([ball, self._ahead[rows], self._lines[rows], self._line[rows], self._aim[rows]])

    def summarize(self, episodes: Episodes, statistics: Statistics) -> tuple[Sequence[Result], Sequence[ResultTable]]:
        """Return how often the ball is dribbled along a line and around a corner, how fast, and how close."""
        first = [_Leg.of(trace, 1) for trace in episodes.trace]
        second = [_Leg.of(trace, 2, CORNER_M) for trace in episodes.trace]
        begun = [leg for leg in second if leg is not None]
        legs = [leg for leg in (*first, *begun) if leg is not None]
        passed = [leg for leg in legs if leg.passed]

        def rate(metric: Metric, values: Sequence[bool]) -> Result:
            return statistics.rate(metric, np.array(values, dtype=np.bool_))

        results = (
            rate(LINE, [leg is not None and leg.passed for leg in first]),
            rate(CORNER, [leg.passed for leg in begun]),
            rate(KEPT, [leg.farthest <= LEAD_M for leg in legs if leg.complete]),
            statistics.mean(COURSE_SPEED, [LEG_M / leg.seconds for leg in passed]),
            statistics.median(FARTHEST, [leg.farthest for leg in legs]),
            statistics.rate(FALL_RATE, episodes.ends["fallen"]),
        )
        return results, ()


class _Leg:
    """What became of one line of a course.

    Attributes:
        complete: whether the ball was dribbled to its end.
        passed: whether it was, within the corridor.
        seconds: time that it took.
        farthest: largest distance of the ball ahead of the torso, metres.
    """

    def __init__(self, rows: FloatArray, free_m: float, *, over: bool) -> None:
        ball, line, direction = rows[:, :2], rows[0, 4:6], rows[0, 6]
        reached, offset = components(np.array(direction), ball - line)
        inside = (np.abs(offset) <= CORRIDOR_HALF_M) | (np.maximum.accumulate(reached) < free_m)
        self.complete = bool(over or reached[-1] >= LEG_M)
        self.passed = self.complete and bool(inside.all())
        self.seconds = len(rows) * STEP_S
        self.farthest = float(rows[1:, 2].max()) if len(rows) > 1 else 0.0

    @classmethod
    def of(cls, trace: FloatArray, number: int, free_m: float = 0.0) -> Self | None:
        """Return line ``number`` of an episode, None if it has not begun; its corridor begins after ``free_m``."""
        rows = trace[trace[:, 3] == number]
        return cls(rows, free_m, over=trace[-1, 3] > number) if len(rows) else None
