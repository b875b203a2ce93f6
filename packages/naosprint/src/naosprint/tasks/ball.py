"""What tasks with a ball share: starts in the stride of a walker, the ball as a player perceives it, and the feet.

A walker brings the robot to the ball, so episodes begin with one of its states (:mod:`naosprint.tasks.handover`). Its
inputs are observed, with the commands of a simple approach: a training that starts from the walker's policy begins with
a walk through the ball. What acts knows only what a player perceives; rewards and results use the truth.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Generic, Self, cast

import numpy as np
from naosim.simulator import BALL, STEP_S, Ability, Scene, Starts
from naospec.sections import PlainName
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError
from typing_extensions import TypeVar

from naosprint.tasks.base import Task
from naosprint.tasks.disturbances import DisturbanceSettings
from naosprint.tasks.falls import FallSettings, with_min_height
from naosprint.tasks.frozen import FrozenPolicy, bundled, require_policy
from naosprint.tasks.handover import HandOver, record
from naosprint.tasks.observations import ObservationBlock, blocks, perceived_yaw, turned
from naosprint.tasks.penalties import PenaltySettings
from naosprint.tasks.robot_defaults import robot_defaults
from naosprint.tasks.velocity import Velocity, VelocitySettings
from naosprint.tasks.world import World

if TYPE_CHECKING:
    from collections.abc import Sequence

    from naosim.robots import Robot

    from naosprint.arrays import AnyArray, BoolArray, FloatArray, IntArray

UPRIGHT = 0.6
"""Upward component of the torso's axis below which a robot has fallen."""

FOOT_M = 0.106
"""Distance of a foot's line from the robot's, metres."""


class BallSettings(FallSettings, PenaltySettings, DisturbanceSettings):
    """Settings of tasks with a ball."""

    ranges: ClassVar[tuple[tuple[str, str], ...]] = (("ball_near_m", "ball_far_m"),)
    """Settings that are the lower and the upper end of a range."""

    walker: PlainName = Field(
        default="t1-run",
        title="Walker",
        description="Bundled policy that approaches the ball, and takes over after a kick.",
    )
    handover_states: int = Field(
        default=1024,
        ge=8,
        le=100_000,
        title="Hand-over states",
        description="States of the walker that episodes begin with; recorded when a training or evaluation begins.",
    )
    entry_speed_mps: float = Field(
        default=1.1,
        ge=0.0,
        le=3.0,
        title="Entry speed",
        description="Fastest commanded speed of the walker in these states.",
        json_schema_extra={"unit": "m/s"},
    )
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
    fall_penalty: float = Field(default=6.0, ge=0.0, le=1000.0, title="Fall penalty", description="Penalty for a fall.")

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        for low, high in self.ranges:
            if getattr(self, low) > getattr(self, high):
                raise PydanticCustomError(
                    "range",
                    "{low}: {least} is above {high}, {most}; exchange them",
                    {"low": low, "least": getattr(self, low), "high": high, "most": getattr(self, high)},
                )
        return self


Settings = TypeVar("Settings", bound=BallSettings, default=BallSettings, covariant=True)


class BallTask(Task[Settings], Generic[Settings]):
    """A task with a ball that begins in a walker's stride.

    Subclasses place robot and ball with :meth:`_put`, command a direction in :attr:`_aim`, and a walk in
    :attr:`_command`.
    """

    scene = Scene(ball=True)
    needs = frozenset({Ability.MOVING})

    @classmethod
    def supports(cls, robot: Robot) -> bool:
        """Return whether the robot has a camera, and a bundled policy walks it."""
        return robot.camera is not None and bool(bundled(robot.name, Velocity.name))

    @classmethod
    def resolve(cls, parameters: Settings, robot: Robot) -> Settings:  # type: ignore[misc] # a task gets its own
        """Return the settings with the robot's own minimum height where none is given."""
        super().resolve(parameters, robot)
        require_policy("task.walker", parameters.walker, robot.name, Velocity.name)
        return with_min_height(parameters, robot, robot_defaults(robot).fall_height_m)

    def __init__(self, parameters: Settings, world: World, seed: int = 0) -> None:
        super().__init__(parameters, world, seed)
        n = self.n
        self._min_height = float(parameters.min_height_m or 0.0)  # resolve has filled it in
        self._walker = FrozenPolicy(parameters.walker)
        self._radius = self.robot.field.ball_radius_m
        self._command: FloatArray = np.zeros((n, 3))  # the walker's: forward, sideways, turn
        self._draws: IntArray = np.zeros(n, dtype=np.int64)
        self._aim: FloatArray = np.zeros(n)  # direction in which the ball has to leave
        self._state: IntArray = np.zeros(n, dtype=np.int64)
        self._sighted: FloatArray = np.zeros((n, 2))  # where the ball was last seen
        self._expected: FloatArray = np.zeros((n, 2))  # its velocity
        self._sightings: IntArray = np.zeros(n, dtype=np.int64)
        self._unseen: IntArray = np.zeros(n, dtype=np.int64)  # steps since
        self._start: FloatArray = np.zeros((n, 2))
        self.arrays = {
            "command": self._command,
            "draws": self._draws,
            "aim": self._aim,
            "state": self._state,
            "sighted": self._sighted,
            "expected": self._expected,
            "sightings": self._sightings,
            "unseen": self._unseen,
            "start": self._start,
        }
        self._fallen: BoolArray = np.zeros(n, dtype=np.bool_)
        self.entries: IntArray = np.full(n, -1)  # of the next episode: number of its state, -1 to draw one
        usual = [name for name in world.defaults.observations if name != "heading"]
        self._usual = dict(zip(usual, blocks(world, usual), strict=True))
        (self._sight,) = blocks(world, ("ball",))
        self._seen_at = cast("FloatArray", self._sight.arrays["ball_place"])
        self._age = cast("FloatArray", self._sight.arrays["ball_seen"])  # steps since it was seen

    # what is observed

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return the walker's observations, the ball as it is perceived, and the walker's command."""
        command = ObservationBlock(
            ("command_forward", "command_sideways", "command_turn"),
            lambda rows: self._command[rows],
            signs=(1.0, -1.0, -1.0),
            begin=self._look_first,
            update=self._look,
        )
        path = ObservationBlock(
            ("line_offset", "heading_sin", "heading_cos"),
            lambda rows: np.tile((0.0, 0.0, 1.0), (len(self._command[rows]), 1)),
            signs=(-1.0, -1.0, 1.0),
        )
        return [*self._usual.values(), self._sight, command, path]

    def _foot_blocks(self) -> list[ObservationBlock]:
        """Return where the ball truly is before each foot, for critics."""
        return [
            ObservationBlock(
                tuple(f"{side}_foot_{name}" for name in ("ball_ahead", "ball_aside", "height", "yaw")),
                lambda rows, side=side: self._foot(side, rows),  # type: ignore[misc]
                partners=tuple(f"{other}_foot_{name}" for name in ("ball_ahead", "ball_aside", "height", "yaw")),
                signs=(1.0, -1.0, 1.0, -1.0),
            )
            for side, other in (("left", "right"), ("right", "left"))
        ]

    def _turn(self, rows: slice | IntArray) -> FloatArray:
        """Return the angles from the perceived front to the aim."""
        return wrapped(self._aim[rows] - perceived_yaw(self.world, rows))

    def _behind(self, rows: slice | IntArray) -> tuple[FloatArray, FloatArray]:
        """Return how far ahead in the aim's direction, and to its left, the ball is perceived; 0 if it never was."""
        apart = self._seen_at[rows] - self.world.perceptors["torso_pos"][rows, :2]
        ahead, aside = along(self._aim[rows], apart)
        known = self._sightings[rows] > 0
        return np.clip(ahead, -1.0, 3.0) * known, np.clip(aside, -2.0, 2.0) * known

    def _foot(self, side: str, rows: slice | IntArray) -> FloatArray:
        """Return the ball before and left of an ankle in the foot's direction, its height, and its yaw from the aim."""
        foot = self.world.bodies[f"{side}_foot"]
        yaw = np.arctan2(foot.rotation[rows, 1, 0], foot.rotation[rows, 0, 0])
        ahead, aside = along(yaw, self.world.bodies[BALL].position[rows, :2] - foot.position[rows, :2])
        columns = [np.clip(ahead, -1.0, 1.5), np.clip(aside, -1.0, 1.0), foot.position[rows, 2]]
        return np.stack([*columns, wrapped(yaw - self._aim[rows])], axis=1)

    # what the ball does, as it is perceived

    def _look_first(self, rows: IntArray) -> None:
        """Take in what is perceived at the start of an episode."""
        if "velocity" in self._usual:
            self._usual["velocity"].arrays["velocity"][rows] = self._states.velocity[self._state[rows]]
        self._sightings[rows] = 0
        self._unseen[rows] = 0
        self._expected[rows] = 0.0
        self._see(rows[self._age[rows] == 0.0])
        self._steer(rows)

    def _look(self, rows: slice) -> None:
        """Take in what is perceived after a step."""
        everyone = np.arange(self.n)[rows]
        self._unseen[rows] += 1
        self._see(everyone[self._age[rows] == 0.0])
        self._steer(everyone)

    def _see(self, rows: IntArray) -> None:
        """Take in that robots see the ball: where, and how it moves, averaged over sightings."""
        place, count = self._seen_at[rows], self._sightings[rows]
        elapsed = np.maximum(self._unseen[rows], 1)[:, None] * STEP_S
        moved = place - self._sighted[rows]
        self._notice(rows, moved, elapsed)
        share = np.where(count == 0, 0.0, np.where(count == 1, 1.0, self._velocity_share()))[:, None]
        self._expected[rows] += share * (moved / elapsed - self._expected[rows])
        self._sighted[rows] = place
        self._sightings[rows] += 1
        self._unseen[rows] = 0
        if len(rows[count == 0]):
            self._first_seen(rows[count == 0])

    def _velocity_share(self) -> float:
        """Return the share of a new velocity in the average."""
        raise NotImplementedError

    def _notice(self, rows: IntArray, moved: FloatArray, elapsed: FloatArray) -> None:
        """Take in how the ball has (k, 2) moved in (k, 1) seconds between two sightings."""
        del rows, moved, elapsed

    def _first_seen(self, rows: IntArray) -> None:
        """Take in that robots see the ball for the first time in an episode."""
        del rows

    def _steer(self, rows: IntArray) -> None:
        """Command the walker."""
        raise NotImplementedError

    # starts

    def starts(self, count: int, seed: int, noise_deg: float) -> Starts:
        """Record the states of the walker that episodes begin with, and return a pose to replace by them."""
        settings = self.parameters
        walk = VelocitySettings(
            name=Velocity.name,
            start_noise_deg=noise_deg,
            forward_min_mps=min(0.4, settings.entry_speed_mps),
            forward_max_mps=settings.entry_speed_mps,
            sideways_max_mps=0.3,
            turn_max_rad_s=0.5,
            straight_fraction=0.4,
            stand_fraction=0.2,
            command_steps=100,
            episode_steps=100_000,
        )
        states = min(settings.handover_states, 4 * count)
        return self.enter(record(self.world.simulator, self._walker, Velocity, walk, states, seed))

    def enter(self, states: HandOver) -> Starts:
        """Begin episodes with these states, and return a pose to replace by them."""
        self._states = states
        # two alike: in one the camera reports in odd steps, in the other in even ones
        return Starts(np.repeat(self.robot.nominal[None], 2, axis=0))

    def _put(self, rows: IntArray, state: FloatArray, heading: FloatArray) -> None:
        """Put robots into the walker's states, numbered from 0 to 1, at the origin with (k,) headings."""
        drawn = (state * len(self._states)).astype(np.int64)
        self._state[rows] = np.where(self.entries[rows] < 0, drawn, self.entries[rows])
        zero = np.zeros_like(heading)
        self._states.begin(self.world, rows, self._state[rows], np.stack([zero, zero, heading], axis=1))

    def _put_ball(
        self,
        rows: IntArray,
        heading: FloatArray,
        ahead: FloatArray,
        aside: FloatArray,
        velocity: FloatArray | None = None,
        way: FloatArray | None = None,
    ) -> None:
        """Put the ball (k,) metres ahead and aside of robots with (k,) headings, at rest or rolling.

        A rolling ball has (k,) speeds, in (k,) directions that are counted from the headings.
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
        self.world.place_ball(rows, ball, moves, spin)

    def begin(self, rows: IntArray) -> None:
        """Restore the walker's latest action."""
        self.world.actions[rows] = self.world.previous_actions[rows] = self._states.actions[self._state[rows]]
        self._fallen[rows] = False

    def _last_step(self, row: int) -> dict[str, AnyArray]:
        """Return the walker's latest action and the torso's position before it, as an exported skill takes them."""
        # the perceived velocity is R^T (position - before) / time, with R of a truncated quaternion
        inverse = turned(self.world.perceptors["torso_quat"][row : row + 1], np.eye(3))
        moved = np.linalg.solve(inverse, self._states.velocity[self._state[row]]) * STEP_S
        position: FloatArray = self.world.perceptors["torso_pos"][row] - moved
        return {"action": self.world.actions[row].copy(), "position": position}

    def _measure_falls(self, rows: slice) -> None:
        """Measure which robots have fallen."""
        up = self.world.rotation(rows)[:, 2, 2]
        self._fallen[rows] = (self.world.position(rows)[:, 2] < self._min_height) | (up < UPRIGHT)


def along(heading: FloatArray, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the parts of (k, 2) displacements along (k,) headings, and to the left of them."""
    cosine, sine = np.cos(heading), np.sin(heading)
    return cosine * moved[:, 0] + sine * moved[:, 1], cosine * moved[:, 1] - sine * moved[:, 0]


def wrapped(angles: FloatArray) -> FloatArray:
    """Return angles in [-pi, pi)."""
    return np.asarray((angles + np.pi) % (2.0 * np.pi) - np.pi)
