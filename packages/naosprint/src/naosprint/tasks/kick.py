"""Kicking a ball in a commanded direction and over a commanded distance, from the middle of a step.

A walker approaches, the kick takes over, and the walker takes over again; every episode has all three. It begins with a
state of the walker (:mod:`naosprint.tasks.handover`), and after the kick the walker acts, whose falls count: a kick
that leaves the robot on one leg has failed.

What acts knows only what a player perceives: the ball from the camera, and whether it has been kicked from its motion.
Rewards and results use the truth.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from naosim.simulator import BALL, STEP_S
from naospec.metrics import Chart, Presentation

from naosprint.tasks import rolling
from naosprint.tasks.ball import BallTask, principal
from naosprint.tasks.base import End, RewardTerm
from naosprint.tasks.falls import FALL, FALL_RATE
from naosprint.tasks.fields import between
from naosprint.tasks.kick_results import METRICS, RESULTS, UPRIGHT_S, Kicks
from naosprint.tasks.kick_settings import KickSettings
from naosprint.tasks.measurements import StoredNumbers
from naosprint.tasks.observations import ObservationBlock
from naosprint.tasks.penalties import penalties
from naosprint.tasks.world import World
from naosprint.terms import (
    Number,
    Store,
    absolute,
    arctan2,
    clip,
    constant,
    cos,
    equal,
    exp,
    given,
    hypot,
    log,
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

    from naospec.metrics import Result, ResultTable

    from naosprint.arrays import AnyArray, BoolArray, FloatArray, IntArray
    from naosprint.tasks.episodes import Episodes, Statistics
    from naosprint.tasks.observations import Observer

PLACED = (0.16, 0.04, np.radians(12.0))
"""Ball before the ankle, and spreads of its distance from the foot's line and of the foot's yaw, at a good touch."""

_ALIGNED = (np.radians(10.0), 0.45, 0.9, 0.06)  # aim, nearest, farthest, distance from a foot's line
_LEAST_SPEED = 0.03  # of a ball that still rolls, m/s
_ROLL_STEPS = 600  # steps after which a roll is over in any case
_SETTLED = 25  # steps after the touch until which a score counts
_SCORE_M = 6.5
_POWER_M = 8.0
_CALM = 0.2  # share of a new velocity in that which is expected
_TRACKED = 6.0  # sights before one in which a kick is noticed, where the path is evened out
_STREAM = 0x61C


class Kick(BallTask[KickSettings]):
    """Kick a ball to a commanded point.

    The command is a direction in the field and a distance. A table of rolls turns it into the direction and the speed
    with which the ball has to leave the foot (:mod:`naosprint.tasks.rolling`), which are observed. The walker's inputs
    are there, too, with the commands of an approach: turn to the aim, bring a foot behind the ball, and walk through
    it; and stand once the ball has been kicked.
    """

    name = "kick"
    summary = "Kick a ball to a commanded point, from walking, and keep standing."
    Parameters = KickSettings
    metrics = (*METRICS, FALL_RATE)
    results = RESULTS
    ends = (FALL, End("done", "Kick"), End("missed", "No kick"))
    trace = ("ball_x", "ball_y", "touched", "direction", "distance", "aligned", "launch_error", "roll_x", "roll_y")
    presentation = Presentation(
        skill="Kick",
        charts=(
            Chart("Launch error", ("launch_error_deg",)),
            Chart("Roll", ("roll_m",)),
            Chart("Roll error", ("roll_error",)),
            Chart("Touches", ("contact_rate",)),
            Chart("Falls", ("fall_rate",)),
            Chart("Reward", ("reward",)),
            Chart("Episode length", ("episode_length",)),
        ),
        listed=("launch_error_deg", "roll_m", "fall_rate"),
        headline=("contact_rate", "upright_rate", "corridor_5_rate", "stop_error_deg", "power_distance_m"),
        repeats=False,
    )
    ends_are_final = True
    horizon_is_terminal = True
    velocity_share = _CALM

    def __init__(self, parameters: KickSettings, world: World, seed: int = 0) -> None:
        super().__init__(parameters, world, seed)
        n, settings = self.n, parameters
        rest = _ROLL_STEPS if settings.whole_roll else settings.takeover_steps + settings.watch_steps + 50
        self.max_steps = settings.approach_steps + rest
        self._target: FloatArray = self.add_array("target", 2)  # direction in the field, distance
        self._speed: FloatArray = self.add_array("speed")  # speed with which the ball has to roll off
        self._power: BoolArray = self.add_array("power", fill=False)
        self._aligned: BoolArray = self.add_array("aligned", fill=False)
        self.add_array("side", fill=1.0)  # 1: kick with the left foot
        self._kicked: IntArray = self.add_array("kicked", fill=-1)  # steps since the perceived kick
        self._touched: IntArray = self.add_array("touched", fill=-1)  # steps since the true touch
        self._score: FloatArray = self.add_array("score")
        self._launch: FloatArray = self.add_array("launch", 2)  # error of the direction, roll in metres
        if settings.sight_share < 1.0:
            self.add_array("tracked", 2)  # where the ball is, evened out over sights
        self._again = settings.least_share > 0.0
        if self._again:
            self.add_array("asked", 2)  # aim and speed of the first kick, by which all are scored
            self.add_array("since", fill=-1)  # steps since the last kick's touch
            self.add_array("weak", fill=False)  # the last kick was too weak
            self.add_array("noticed", 2)  # where the ball was when a kick was perceived
            self.add_array("point", 2)  # where the ball is to be kicked to
        self._walks: BoolArray = np.zeros(n, dtype=np.bool_)
        self.frozen = self._walks
        self._gain: FloatArray = np.zeros(n)
        self._placed: FloatArray = np.zeros(n)
        self._done: BoolArray = np.zeros(n, dtype=np.bool_)
        self._hasty: BoolArray = np.zeros(n, dtype=np.bool_)
        self._missed: BoolArray = np.zeros(n, dtype=np.bool_)
        aim = self.stored("aim")
        self.measurements = (
            StoredNumbers([*self._entered.last_actions(), Store(aim, begin=given("aim", aim)), *self._follow()]),
        )
        self.flags = (self._fallen, self._done, self._missed)

    # what is observed

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return what the walker observes, the ball as it is perceived, and the command."""
        aim = ObservationBlock(
            ("aim_sin", "aim_cos", "ball_along", "ball_across", "launch_speed", "power", "kicked"),
            self._aimed,
            signs=(-1.0, 1.0, 1.0, -1.0, 1.0, 1.0, 1.0),
            spread=(0.3, 0.1, 0.3, 0.2, 1.0, 0.5, 0.5),
        )
        return [*super().observation_blocks(), aim]

    def critic_blocks(self) -> Sequence[ObservationBlock]:
        """Return what only a critic observes: the ball's true motion, the feet, and how far the episode is."""
        names = (
            "ball_speed_along",
            "ball_speed_across",
            "ball_height",
            "touched",
            "since_touch",
            "since_kick",
            "score",
        )
        progress = ObservationBlock(
            tuple(f"true_{name}" for name in names), self._progress, signs=(1.0, -1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
        )
        return [*super().critic_blocks(), progress, *self._foot_blocks()]

    @property
    def _aimed(self) -> Number:
        kicked = minimum((self.stored("kicked") + 1.0) / 10.0, 1.0)
        power = given("power", self.stored("power"))
        return stack(sin(self._turn), cos(self._turn), self._behind, self._launch_speed, power, kicked)

    @property
    def _launch_speed(self) -> Number:
        """Speed with which the ball has to roll off; an exported skill is given that of the first kick."""
        return self.stored("speed") if self._again else given("launch_speed", self.stored("speed"))

    @property
    def _progress(self) -> Number:
        way = along(self.stored("aim"), self.world.body(BALL, "velocity")[:2])
        height = self.world.body(BALL, "position")[2]
        touched, kicked = (minimum(self.stored(name) + 1.0, 100.0) / 50.0 for name in ("touched", "kicked"))
        return stack(way, height, touched > 0.0, touched, kicked, self.stored("score"))

    # what the ball does, as it is perceived

    def _share_of_velocity(self, sightings: Number) -> Number:
        usual = super()._share_of_velocity(sightings)
        # of a path that is evened out the first sights count alike
        return maximum(usual, 1.0 / maximum(sightings, 1.0)) if "tracked" in self.arrays else usual

    def _notice(self, seen: Number, moved: Number, elapsed: Number) -> list[Store]:
        """Return what is stored of the kick: it is perceived when the ball has left the path that it was on."""
        settings, kicked, expected = self.parameters, self.stored("kicked"), self.stored("expected") * elapsed
        off = moved - expected
        tracking: list[Store] = []
        if "tracked" in self.arrays:
            tracked, place, first = self.stored("tracked"), self._seen_at, equal(self.stored("sightings"), 0.0)
            off = place - tracked - expected
            evened = where(first, place, tracked + expected + settings.sight_share * off)
            # robots see the ball for the first time at the start, or later
            tracking = [Store(tracked, begin=place, update=where(seen, evened, tracked))]
        surprise = hypot(off[0], off[1]) > settings.kicked_m + 0.3 * maximum(elapsed - 2 * STEP_S, 0.0)
        known = self.stored("sightings") >= (_TRACKED if tracking else 2.0)
        now = seen & known & surprise & (kicked < 0.0)
        noticing = [
            Store(kicked, begin=constant(-1.0), update=kicked + (kicked >= 0.0)),
            Store(kicked, update=where(now, 0.0, kicked)),
            *tracking,
        ]
        if not self._again:
            return noticing
        noticed = self.stored("noticed")
        return [
            Store(noticed, begin=self._seen_at, update=where(now, self._seen_at, noticed)),
            *noticing,
            *self._weigh(),
        ]

    def _weigh(self) -> list[Store]:
        """Return what is stored of weak kicks: when the walker would take over, the robot kicks again instead."""
        names = ("kicked", "weak", "noticed", "point", "aim", "speed", "expected")
        kicked, weak, noticed, point, aim, speed, expected = (self.stored(name) for name in names)
        place, direction = self._seen_at, stack(cos(aim), sin(aim))
        # the point to kick to is ahead of where the ball is first seen
        first = place + direction * rolling.straight(speed)
        # by now a ball that was kicked weakly rolls, and no longer slides
        velocity = (place - noticed) / (maximum(kicked - self._age, 1.0) * STEP_S)
        rolls = hypot(velocity[0], velocity[1])
        stop = place + velocity * (rolling.straight(rolls) / maximum(rolls, 1e-6))
        left = point - stop
        short = along(aim, left)[0] > (1.0 - self.parameters.least_share) * rolling.straight(speed)
        due = equal(kicked, float(self.parameters.takeover_steps)) & (self._age < kicked)
        slower = rolling.speed_of(hypot(left[0], left[1]))
        pass_on = weak & ~(given("power", self.stored("power")) > 0.0)
        evened = [self.stored("tracked")] if "tracked" in self.arrays else []
        return [
            Store(speed, begin=given("launch_speed", speed)),
            Store(point, begin=first, update=where(equal(self.stored("sightings"), 0.0), first, point)),
            Store(weak, begin=constant(0.0), update=due & short),
            Store(expected, update=where(weak, velocity, expected)),
            *(Store(tracked, update=where(weak, place, tracked)) for tracked in evened),
            Store(speed, update=where(pass_on, slower, speed)),
            Store(aim, update=where(weak, arctan2(left[1], left[0]), aim)),
            Store(kicked, update=where(weak, -1.0, kicked)),
        ]

    def _steer(self) -> list[Store]:
        """Return the foot to kick with, that on the ball's side, and the walker's command.

        Bring the foot behind the ball, walk through it, and stand once it has been kicked.
        """
        side, kicked, turn = self.stored("side"), self.stored("kicked"), self._turn
        ahead, across = self._behind[0], self._behind[1]
        chosen = where(self._first_sight, where(across >= 0.0, 1.0, -1.0), side)
        aside = across - side * self.world.defaults.foot_line_m
        ready = clip(1.6 - absolute(aside) / 0.05 - absolute(turn) / 0.2, 0.0, 1.0)
        # a soft kick begins with a slow walk
        through = clip(self._launch_speed * 0.25, 0.4, 0.8)
        forward = through * ready + (1.0 - ready) * clip((ahead - 0.52) * 2.0, -0.3, 0.8)
        walk = self._walk(forward, clip(aside * 3.0, -0.45, 0.45), (0.0, -0.45, -1.0), (1.0, 0.45, 1.0))
        approaching = (kicked < 0.0) & (self.stored("sightings") > 0.0)
        command = where(approaching, walk, 0.0)
        return [
            Store(side, begin=chosen, update=chosen),
            self._command_walker(command),
            Store(source(self._walks), begin=constant(0.0), update=kicked >= self.parameters.takeover_steps),
        ]

    # starts

    def place(self, rows: IntArray) -> None:
        """Draw state, ball and command, and put the robot into the state and the ball to its place."""
        settings = self.parameters
        draw = self._drawn(rows, _STREAM, 13)
        heading = 2.0 * np.pi * draw[1]
        self._put(rows, draw[0], heading)
        # where the ball is to be kicked, and where to, in the robot's frame
        aligned = draw[2] < settings.aligned_fraction
        most, near, far, line = _ALIGNED
        aim = np.where(aligned, most, np.radians(settings.aim_max_deg)) * (2.0 * draw[3] - 1.0)
        anywhere = between(settings.ball_near_m, settings.ball_far_m, draw[4])
        ahead = np.where(aligned, between(near, far, draw[4]), anywhere)
        foot = self.world.defaults.foot_line_m * np.where(draw[5] < 0.5, -1.0, 1.0)
        beside = foot + line * (2.0 * draw[6] - 1.0)
        aside = np.where(
            aligned, (beside + np.sin(aim) * ahead) / np.cos(aim), settings.ball_aside_m * (2.0 * draw[6] - 1.0)
        )
        self._power[rows] = draw[7] < settings.power_fraction
        drawn = between(settings.distance_min_m, settings.distance_max_m, draw[8])
        self._aligned[rows] = aligned
        self._target[rows, 0] = principal(heading + aim)
        self._target[rows, 1] = np.where(self._power[rows], KickSettings.model_fields["distance_max_m"].default, drawn)
        self._speed[rows], self._aim[rows] = self._launched(self._target[rows], self._power[rows])
        if self._again:
            self.arrays["asked"][rows] = np.stack([self._aim[rows], self._speed[rows]], axis=1)
        # a rolling ball gets there after 0.3 to 0.8 s
        rolls = draw[9] < settings.rolling_fraction
        velocity = np.where(rolls, settings.ball_speed_max_mps * draw[10], 0.0)
        way, ago = 2.0 * np.pi * draw[11], 0.3 + 0.5 * draw[12]
        aside -= np.sin(way) * velocity * ago
        ahead = np.maximum(ahead - np.cos(way) * velocity * ago, 0.35)
        self._put_ball(rows, heading, ahead, aside, velocity, way)

    @staticmethod
    def _launched(target: FloatArray, power: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return speed and direction with which a ball has to roll off to stop at (k, 2) directions and distances.

        A power kick passes through a point in that direction on its way, wherever it stops.
        """
        direction, distance = target.T
        speed, aim = rolling.launch(distance, np.where(power, 0.0, direction))
        return speed, np.where(power, rolling.power_aim(direction), aim) if power.any() else aim

    def handed_over(self, row: int) -> dict[str, AnyArray]:
        """Return what an exported skill is given when its kick begins: target, and the walker's last step."""
        distance = np.inf if self._power[row] else self._target[row, 1]
        return {"target": np.array([self._target[row, 0], distance]), **self._last_step(row)}

    # steps

    def take_over(self, rows: slice, observer: Observer) -> None:
        """Apply the walker's actions after the kick."""
        others = np.arange(self.n)[rows][self._walks[rows]]
        if len(others):
            self.world.actions[others] = self._walker.act(observer, others)

    @property
    def touched(self) -> BoolArray:
        """(n,) robots that have touched the ball."""
        return self._touched >= 0

    def skill_over(self, rows: slice | IntArray) -> BoolArray:
        """Return in which robots the walker has to take over."""
        return self._walks[rows]

    def _follow(self) -> list[Store]:
        """Return what is measured of a step: touch, launch and score, falls and ends."""
        world, settings, zero = self.world, self.parameters, constant(0.0)
        names = ("touched", "launch", "score", "kicked")
        touched, launch, score, kicked = (self.stored(name) for name in names)
        since = self._since
        gain, placed, fallen, done = (source(each) for each in (self._gain, self._placed, self._fallen, self._done))
        hasty = source(self._hasty)
        fresh, before = source(np.zeros(self.n, dtype=np.bool_)), source(np.zeros(self.n))
        live = (since >= 0.0) & ~(since > _SETTLED)
        if settings.whole_roll:
            velocity = world.body(BALL, "velocity")
            still = hypot(velocity[0], velocity[1]) < _LEAST_SPEED
            over = (kicked >= 0.0) & (since >= round(UPRIGHT_S / STEP_S)) & still
        else:
            over = kicked >= settings.takeover_steps + settings.watch_steps
        late = (kicked < 0.0) & (world.step >= settings.approach_steps)
        return [
            Store(fresh, update=(touched < 0.0) & (world.contact("robot") > 0.0)),
            Store(touched, begin=constant(-1.0), update=where(fresh, 0.0, touched + (touched >= 0.0))),
            *(self._follow_again() if self._again else []),
            Store(placed, update=where(fresh, self._placement(), 0.0)),
            Store(hasty, update=fresh & (world.step < settings.earliest_touch_steps)),
            Store(launch, begin=constant([0.0, 0.0]), update=where(live, self._launch_now(), launch)),
            Store(before, update=score),
            Store(score, begin=zero, update=where(live, self._scored(launch[0], launch[1]), score)),
            Store(gain, update=score - before),
            self._falls(),
            Store(done, begin=zero, update=over & ~fallen),
            Store(source(self._missed), begin=zero, update=late & ~fallen),
        ]

    def _follow_again(self) -> list[Store]:
        """Return what is stored of the steps since the touch of the latest kick that was not too weak."""
        since, touches = self.stored("since"), self.world.contact("robot") > 0.0
        return [
            Store(since, begin=constant(-1.0), update=where(self.stored("weak"), -1.0, since + (since >= 0.0))),
            Store(since, update=where((since < 0.0) & touches, 0.0, since)),
        ]

    @property
    def _since(self) -> Number:
        """Steps since the touch of the latest kick that was not too weak."""
        return self.stored("since" if self._again else "touched")

    @property
    def _scored_by(self) -> Number:
        """Aim and speed that were commanded at first."""
        return self.stored("asked") if self._again else stack(self.stored("aim"), self.stored("speed"))

    def _placement(self) -> Number:
        """Return the score of how the ball lies before the nearer foot."""
        left, right = self._foot("left"), self._foot("right")
        distances = [hypot(foot[0] - PLACED[0], foot[1]) for foot in (left, right)]
        foot = where(distances[1] < distances[0], right, left)
        spread = self.parameters.place_spread
        return _bell(foot[1] / (spread * PLACED[1])) * (0.3 + 0.7 * _bell(foot[3] / (spread * PLACED[2])))

    def _launch_now(self) -> Number:
        """Return angle from the aim and length of the roll that would follow from now on."""
        roll, start, place = self._roll(), source(self._start), self.world.body(BALL, "position")[:2]
        speed = hypot(roll[0], roll[1])
        way = along(
            self._scored_by[0],
            place - start + roll * (rolling.straight(speed) / maximum(speed, 1e-6)),
        )
        return stack(arctan2(way[1], way[0]), hypot(way[0], way[1]))

    def _roll(self) -> Number:
        """Return the velocity with which the ball rolls once it no longer slides."""
        return rolling.roll(self.world.body(BALL, "velocity"), self.world.body(BALL, "spin"), self._radius)

    def _scored(self, angle: Number, reached: Number) -> Number:
        """Return the score of a launch at an angle from the aim, that lets the ball roll straight so far."""
        error = absolute(angle)
        direction = (
            0.25 * maximum(cos(error) - 2.5 * sin(error), -0.5)
            + 0.35 * _bell(error / np.radians(14.0))
            + 0.4 * _bell(error / np.radians(5.0))
        )
        ratio = reached / maximum(rolling.straight(self._scored_by[1]), 0.1)
        # a kick that goes four times too far still scores, so that there is a slope towards softer ones
        off = log(maximum(ratio, 1e-3))
        close = 0.3 * exp(-1.5 * absolute(off)) + 0.7 * _bell(off / self.parameters.distance_spread)
        far = minimum(reached / _POWER_M, 1.0)
        return _SCORE_M * direction * where(self.stored("power"), far, close)

    def reward_terms(self) -> Sequence[RewardTerm]:
        """Return the gain of the score, so that a second touch counts, and what becomes of the robot."""
        settings = self.parameters
        return (
            RewardTerm("kick", 1.0, source(self._gain)),
            RewardTerm("placement", settings.place_weight, source(self._placed)),
            RewardTerm("upright", settings.upright_weight, source(self._done)),
            RewardTerm("fall", -settings.fall_penalty, source(self._fallen)),
            RewardTerm("miss", -settings.miss_penalty, source(self._missed)),
            RewardTerm("haste", -settings.miss_penalty, source(self._hasty)),
            RewardTerm("time", -settings.time_penalty, self._since < 0.0),
            *penalties(self.world, settings),
        )

    # results

    def succeeded(self, rows: IntArray) -> BoolArray:
        """Return which robots have kicked."""
        return self._touched[rows] >= 0

    def measure(self, rows: IntArray) -> FloatArray:
        """Return touch, errors of launch and roll, roll, and fall."""
        angle, reached = self._launch[rows].T
        asked = rolling.straight(self._scored_by[1])(rows)[:, 0]
        error = np.where(self._power[rows], 0.0, np.abs(reached / np.maximum(asked, 0.1) - 1.0))
        touched = self._touched[rows] >= 0
        angle = np.where(touched, np.abs(angle), np.pi)  # nothing is farther off than a ball that is missed
        return np.stack([touched, np.degrees(angle), reached, error, self._fallen[rows]], axis=1)

    def trace_row(self, rows: IntArray) -> FloatArray:
        """Return the ball's place, whether it was touched, the command, and the velocity with which the ball rolls."""
        ball, touched = self.world.bodies[BALL].position[rows, :2], self._touched[rows] >= 0
        kind = np.where(self._aligned[rows], 1.0, 0.0)
        distance = np.where(self._power[rows], np.inf, self._target[rows, 1])
        error, roll = np.degrees(self._launch[rows, 0]), self._roll()(rows)
        return np.column_stack([ball, touched, self._target[rows, 0], distance, kind, error, roll])

    def summarize(self, episodes: Episodes, statistics: Statistics) -> tuple[Sequence[Result], Sequence[ResultTable]]:
        """Return results of all episodes, and those of aligned and of other starts side by side."""
        kicks = Kicks(episodes)
        everyone = np.ones(len(episodes), dtype=np.bool_)
        results = (
            *kicks.results(everyone, statistics),
            statistics.rate(FALL_RATE, episodes.ends["fallen"]),
        )
        return results, (kicks.corridors(statistics),)


def _bell(number: Number) -> Number:
    """Return exp(-x^2)."""
    return exp(square(number) * -1.0)
