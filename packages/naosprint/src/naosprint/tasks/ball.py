"""What tasks with a ball share: starts in the stride of a walker, the ball as a player perceives it, and the feet.

A walker brings the robot to the ball, so episodes begin with one of its states (:mod:`naosprint.tasks.handover`). Its
inputs are observed, with the commands of a simple approach: a training that starts from the walker's policy begins with
a walk through the ball. What acts knows only what a player perceives; rewards and results use the truth.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar, Generic

import numpy as np
from naosim.simulator import BALL, STEP_S, Ability, Scene, Starts
from naospec.sections import PlainName
from pydantic import Field
from typing_extensions import TypeVar

from naosprint.tasks import rolling
from naosprint.tasks.base import Task
from naosprint.tasks.commands import ACCELERATIONS, AccelerationSettings, approached
from naosprint.tasks.disturbance_settings import BallNoiseSettings, DisturbanceSettings
from naosprint.tasks.falls import FallSettings, with_min_height
from naosprint.tasks.fields import weight
from naosprint.tasks.frozen import FrozenPolicy, bundled, chosen, require_entries
from naosprint.tasks.handover import Entries, EntrySettings, HandOver, joined, record, record_own
from naosprint.tasks.observations import ObservationBlock, blocks, seen_yaw
from naosprint.tasks.penalties import PenaltySettings
from naosprint.tasks.robot_defaults import robot_defaults
from naosprint.tasks.velocity import Velocity, VelocitySettings
from naosprint.tasks.world import World
from naosprint.terms import (
    Number,
    Store,
    arctan2,
    clip,
    constant,
    cos,
    equal,
    maximum,
    sin,
    source,
    stack,
    where,
    wrapped,
)
from naosprint.terms.geometry import along, turned
from naosprint.terms.randomness import uniform

if TYPE_CHECKING:
    from collections.abc import Sequence

    from naosim.robots import Robot

    from naosprint.arrays import AnyArray, BoolArray, FloatArray, IntArray

UPRIGHT = 0.6
"""Upward component of the torso's axis below which a robot has fallen."""


class BallSettings(
    FallSettings, PenaltySettings, DisturbanceSettings, BallNoiseSettings, AccelerationSettings, EntrySettings
):
    """Settings of tasks with a ball."""

    walker: PlainName | None = Field(
        default=None,
        title="Walker",
        description="Bundled policy that approaches the ball, and takes over after a kick; left out: the robot's own. "
        "The task observes at least as many earlier steps as this policy.",
    )
    entry_speed_mps: float = Field(
        default=1.1,
        ge=0.0,
        le=3.0,
        title="Entry speed",
        description="Fastest commanded speed of the walker in these states.",
        json_schema_extra={"unit": "m/s"},
    )
    fall_penalty: float = weight(
        6.0,
        "Fall penalty",
        "Penalty for a fall. Where rewards are normalized, what is ten standard deviations of a return or "
        "more counts as ten.",
    )


class NearBallSettings(BallSettings):
    """Settings of tasks that begin with a ball within a few steps."""

    ranges = (("ball_near_m", "ball_far_m"),)

    ball_near_m: float = Field(
        default=0.35,
        ge=0.3,
        le=2.0,
        title="Nearest ball",
        description="Least distance of the ball ahead of the torso at the start.",
        json_schema_extra={"unit": "m"},
    )
    ball_far_m: float = Field(
        default=0.9,
        ge=0.3,
        le=2.0,
        title="Farthest ball",
        description="Largest distance of the ball ahead of the torso at the start.",
        json_schema_extra={"unit": "m"},
    )
    ball_aside_m: float = Field(
        default=0.22,
        ge=0.0,
        le=1.0,
        title="Ball aside",
        description="Largest distance of the ball to either side at the start.",
        json_schema_extra={"unit": "m"},
    )


Settings = TypeVar("Settings", bound=BallSettings, default=BallSettings, covariant=True)


class BallTask(Task[Settings], Generic[Settings]):
    """A task with a ball that begins in a walker's stride.

    Subclasses place robot and ball with :meth:`_put`, command a direction in :attr:`_aim`, and a walk by
    :meth:`_steer`.
    """

    velocity_share: ClassVar[float]
    """Share of a new velocity in that of the ball which is expected, an average over sights."""

    standing: ClassVar[float] = 0.2
    """Fraction of the states that episodes begin with in which the walker is commanded to stand."""

    scene = Scene(ball=True)
    needs = frozenset({Ability.MOVING})

    @classmethod
    def supports(cls, robot: Robot) -> bool:
        """Return whether the robot has a camera, and a bundled policy walks it."""
        return robot.camera is not None and bool(bundled(robot.name, Velocity.name))

    @classmethod
    def resolve(cls, parameters: Settings, robot: Robot) -> Settings:  # type: ignore[misc] # a task gets its own
        """Return the settings with walker, minimum height, and at least the earlier steps that the walker observes."""
        super().resolve(parameters, robot)
        defaults = robot_defaults(robot)
        if not defaults.knows_position:
            raise ValueError(
                f"robot: with these settings {robot.name} does not know its position and cannot follow the ball's; use "
                "settings with which it does, such as onboard_sensing=false"
            )
        walker = chosen(parameters.walker, "task.walker", robot.name, Velocity.name)
        require_entries(parameters.entry_policies, robot, cls.scene)
        trained = bundled(robot.name, Velocity.name)[walker]
        remembered = max(parameters.history_steps, int(trained.get("history_steps", 0)))
        own = {name: trained.get(name) for name in ACCELERATIONS if getattr(parameters, name) is None}
        settings = parameters.model_copy(update={"walker": walker, "history_steps": remembered, **own})
        return with_min_height(settings, robot, defaults.fall_height_m)

    def __init__(self, parameters: Settings, world: World, seed: int = 0) -> None:
        super().__init__(parameters, world, seed)
        n = self.n
        self._min_height = float(parameters.min_height_m or 0.0)  # resolve has filled it in
        assert parameters.walker is not None, "filled in by resolve"
        self._walker = FrozenPolicy(parameters.walker)
        self._radius = self.robot.field.ball_radius_m
        self.add_array("command", 3)  # the walker's: forward, sideways, turn
        self._draws: IntArray = self.add_array("draws", fill=0)
        self._aim: FloatArray = self.add_array("aim")  # direction in which the ball has to leave
        self._entered = Entries(world)
        self.arrays["state"] = self._entered.numbers
        self.add_array("sighted", 2)  # where the ball was last seen
        self.add_array("expected", 2)  # its velocity
        self.add_array("sightings", fill=0)
        self.add_array("unseen", fill=0)  # steps since
        self._start: FloatArray = self.add_array("start", 2)
        self._fallen: BoolArray = np.zeros(n, dtype=np.bool_)
        self.flags = (self._fallen,)
        self.entries: IntArray = np.full(n, -1)  # of the next episode: number of its state, -1 to draw one
        usual = [name for name in world.defaults.observations if name != "heading"]
        self._usual = dict(zip(usual, blocks(world, usual), strict=True))
        (self._sight,) = blocks(world, ("ball",))
        self._seen_at = source(self._sight.arrays["ball_place"])
        self._first_sight = source(np.zeros(n, dtype=np.bool_), "first_sight")
        self._age = source(self._sight.arrays["ball_seen"])  # steps since it was seen

    # what is observed

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return the walker's observations, the ball as it is perceived, and the walker's command."""
        command = ObservationBlock(
            ("command_forward", "command_sideways", "command_turn"),
            self.stored("command"),
            signs=(1.0, -1.0, -1.0),
            stores=[self._entered.moving(self._usual["velocity"]), *self._look(), *self._steer()],
        )
        path = ObservationBlock(
            ("line_offset", "heading_sin", "heading_cos"), constant([0.0, 0.0, 1.0]), signs=(-1.0, -1.0, 1.0)
        )
        return [*self._usual.values(), self._sight, command, path]

    def _foot_blocks(self) -> list[ObservationBlock]:
        """Return where the ball truly is before each foot, for critics."""
        return [
            ObservationBlock(
                tuple(f"{side}_foot_{name}" for name in ("ball_ahead", "ball_aside", "height", "yaw")),
                self._foot(side),
                partners=tuple(f"{other}_foot_{name}" for name in ("ball_ahead", "ball_aside", "height", "yaw")),
                signs=(1.0, -1.0, 1.0, -1.0),
            )
            for side, other in (("left", "right"), ("right", "left"))
        ]

    @property
    def _turn(self) -> Number:
        """Angle from the perceived front to the aim."""
        return wrapped(self.stored("aim") - seen_yaw(self.world))

    @property
    def _behind(self) -> Number:
        """How far ahead in the aim's direction, and to its left, the ball is perceived; 0 if it never was."""
        way = along(self.stored("aim"), self._seen_at - self.world.perceived("torso_pos")[:2])
        return clip(way, [-1.0, -2.0], [3.0, 2.0]) * (self.stored("sightings") > 0.0)

    def _foot(self, side: str) -> Number:
        """Ball before and left of an ankle in the foot's direction, the ankle's height, and its yaw from the aim."""
        position, rotation = (self.world.body(f"{side}_foot", part) for part in ("position", "rotation"))
        yaw = arctan2(rotation[3], rotation[0])
        way = along(yaw, self.world.body(BALL, "position")[:2] - position[:2])
        return stack(clip(way, -1.0, [1.5, 1.0]), position[2], wrapped(yaw - self.stored("aim")))

    # what the ball does, as it is perceived

    def _look(self) -> list[Store]:
        """Return what is stored of sights of the ball: where it is, and how it moves, averaged over sightings."""
        names = ("sighted", "expected", "sightings", "unseen")
        sighted, expected, sightings, unseen = (self.stored(name) for name in names)
        seen, place = equal(self._age, 0.0), self._seen_at
        elapsed = maximum(unseen, 1.0) * STEP_S
        moved = place - sighted
        share = where(sightings > 0.0, where(sightings > 1.0, self._share_of_velocity(sightings), 1.0), 0.0)
        zero = constant(0.0)
        return [
            Store(unseen, begin=zero, update=unseen + 1.0),
            *self._notice(seen, moved, elapsed),
            Store(
                expected,
                begin=constant([0.0, 0.0]),
                update=where(seen, expected + share * (moved / elapsed - expected), expected),
            ),
            Store(self._first_sight, begin=seen, update=seen & equal(sightings, 0.0)),
            Store(sighted, begin=where(seen, place, sighted), update=where(seen, place, sighted)),
            Store(sightings, begin=seen, update=sightings + seen),
            Store(unseen, update=where(seen, 0.0, unseen)),
        ]

    def _share_of_velocity(self, sightings: Number) -> Number:
        """Return the share of a new velocity in the expected one, from the third sight on."""
        del sightings
        return constant(self.velocity_share)

    def _notice(self, seen: Number, moved: Number, elapsed: Number) -> list[Store]:
        """Return what is stored of how the ball, if it is seen now, has moved in the seconds since the last sight."""
        del seen, moved, elapsed
        return []

    def _command_walker(self, command: Number) -> Store:
        """Return what stores the walker's command, approached as in its training from the velocity of the robot."""
        stored, moving = self.stored("command"), source(self._usual["velocity"].arrays["velocity"], "velocity")
        begin = approached(self.parameters, stack(moving[0], moving[1], 0.0), command)
        return Store(stored, begin=begin, update=approached(self.parameters, stored, command))

    @abstractmethod
    def _steer(self) -> list[Store]:
        """Return what is stored at first sights, and the walker's command."""

    def _walk(self, forward: Number, left: Number, low: Sequence[float], high: Sequence[float]) -> Number:
        """Return the walker's command for velocities in the aim's frame, limited to [low, high]."""
        cosine, sine, turn = cos(self._turn), sin(self._turn), self._turn
        command = stack(cosine * forward - sine * left, sine * forward + cosine * left, turn * 3.0)
        return clip(command, low, high)

    # starts

    def starts(self, count: int, seed: int, noise_deg: float) -> Starts:
        """Record the states of the walker that episodes begin with, and return a pose to replace by them."""
        settings = self.parameters
        walkers = [self._walker, *map(FrozenPolicy, settings.entry_policies)]
        states = max(1, min(settings.handover_states, 4 * count) // len(walkers))
        walk = VelocitySettings(
            name=Velocity.name,
            start_noise_deg=noise_deg,
            forward_min_mps=min(0.4, settings.entry_speed_mps),
            forward_max_mps=settings.entry_speed_mps,
            sideways_max_mps=0.3,
            turn_max_rad_s=0.5,
            straight_fraction=0.4,
            stand_fraction=self.standing,
            command_steps=100,
            episode_steps=100_000,
        )
        recorded = []
        for walker in walkers:
            if walker.spec.task.name != Velocity.name:
                recorded.append(record_own(self.world.simulator, walker, states, seed))
                continue
            own = {name: getattr(walker.spec.task, name) for name in ("history_steps", *ACCELERATIONS)}
            recorded.append(record(self.world.simulator, walker, Velocity, walk.model_copy(update=own), states, seed))
        return self.enter(joined(recorded))

    def enter(self, states: HandOver) -> Starts:
        """Begin episodes with these states, and return a pose to replace by them."""
        self._entered.states = states
        # two alike: in one the camera reports in odd steps, in the other in even ones
        return Starts(np.repeat(self.robot.nominal[None], 2, axis=0))

    def _drawn(self, rows: IntArray, stream: int, count: int) -> FloatArray:
        """Return (count, k) new random numbers from 0 to 1 for the robots ``rows``, whose episode begins."""
        numbers = uniform(self.seed + stream, self.world.streams[rows], self._draws[rows], count)
        self._draws[rows] += 1
        return numbers.T

    def _put(self, rows: IntArray, state: FloatArray, heading: FloatArray) -> None:
        """Put robots into the walker's states, numbered from 0 to 1, at the origin with (k,) headings."""
        drawn = (state * len(self._entered.states)).astype(np.int64)
        numbers, zero = np.where(self.entries[rows] < 0, drawn, self.entries[rows]), np.zeros_like(heading)
        self._entered.put(rows, numbers, np.stack([zero, zero, heading], axis=1))

    def _put_ball(
        self,
        rows: IntArray,
        heading: FloatArray,
        ahead: FloatArray,
        aside: FloatArray,
        velocity: FloatArray | None = None,
        way: FloatArray | None = None,
        slides: BoolArray | None = None,
    ) -> None:
        """Put the ball (k,) metres ahead and aside of robots with (k,) headings, at rest or rolling.

        A rolling ball has (k,) speeds, in (k,) directions that are counted from the headings. One of the (k,) that
        slide has no spin yet, like one that was kicked, and is as much faster as sliding will cost it.
        """
        torso, zero = self.world.position(rows)[:, :2], np.zeros_like(heading)
        cosine, sine = np.cos(heading), np.sin(heading)
        ball = np.stack(
            [
                torso[:, 0] + cosine * ahead - sine * aside,
                torso[:, 1] + sine * ahead + cosine * aside,
                np.full(len(rows), self._radius),
            ],
            axis=1,
        )
        self._start[rows] = ball[:, :2]
        if velocity is None or way is None:
            self.world.place_ball(rows, ball)
            return
        moves = np.stack([velocity * np.cos(heading + way), velocity * np.sin(heading + way), zero], axis=1)
        spin = np.stack([-moves[:, 1], moves[:, 0], zero], axis=1) / self._radius
        if slides is not None:
            moves[slides] *= rolling.SLIDES
            spin[slides] = 0.0
        self.world.place_ball(rows, ball, moves, spin)

    def _last_step(self, row: int) -> dict[str, AnyArray]:
        """Return the walker's latest action and the torso's position before it, as an exported skill takes them."""
        # the perceived velocity is R^T (position - before) / time, with R of a truncated quaternion
        quaternion, only = self.world.perceived("torso_quat"), slice(row, row + 1)
        inverse = [turned(quaternion, constant(axis))(only)[0] for axis in np.eye(3).tolist()]
        moved = np.linalg.solve(inverse, self._entered.velocity(row)) * STEP_S
        position: FloatArray = self.world.perceptors["torso_pos"][row] - moved
        return {"action": self.world.actions[row].copy(), "position": position}

    def _falls(self) -> Store:
        """Return what is stored of falls."""
        low = self.world.true_position[2] < self._min_height
        return Store(source(self._fallen), begin=constant(0.0), update=low | (self.world.true_rotation[8] < UPRIGHT))


def components(heading: FloatArray, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the parts of (k, 2) displacements along (k,) headings, and to the left of them."""
    cosine, sine = np.cos(heading), np.sin(heading)
    return cosine * moved[:, 0] + sine * moved[:, 1], cosine * moved[:, 1] - sine * moved[:, 0]


def principal(angles: FloatArray) -> FloatArray:
    """Return angles in [-pi, pi)."""
    return np.asarray((angles + np.pi) % (2.0 * np.pi) - np.pi)
