"""Following a commanded velocity: forward, sideways, and turning."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

import numpy as np
from naosim.simulator import STEP_S
from naospec.metrics import Chart, Presentation, Result, ResultTable
from pydantic import Field

from naosprint.tasks.base import RewardTerm, Task
from naosprint.tasks.commands import CommandGrowth, CommandSettings, approached, commanded
from naosprint.tasks.disturbance_settings import DisturbanceSettings
from naosprint.tasks.falls import FALL, FALL_RATE, FallSettings, with_min_height
from naosprint.tasks.fields import fraction, weight
from naosprint.tasks.frozen import FrozenPolicy, require_entries
from naosprint.tasks.handover import Entries, EntrySettings, joined, record_own
from naosprint.tasks.measurements import StoredNumbers
from naosprint.tasks.observations import ObservationBlock, blocks, seen_yaw
from naosprint.tasks.penalties import PenaltySettings, penalties
from naosprint.tasks.robot_defaults import robot_defaults
from naosprint.tasks.velocity_results import ERROR, RESULTS, SPEED, followed
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
    hypot,
    minimum,
    sin,
    source,
    sqrt,
    square,
    stack,
    total,
    uniform,
    where,
    wrapped,
)
from naosprint.terms.geometry import along
from naosprint.terms.randomness import uniform as uniform_numbers

if TYPE_CHECKING:
    from collections.abc import Sequence

    from naosim.robots import Robot
    from naosim.simulator import Starts

    from naosprint.arrays import BoolArray, FloatArray, IntArray
    from naosprint.tasks.episodes import Episodes, Statistics

_ENTRIES = 0x3E7A  # keeps the draws of entries apart from those of commands

TRACKING_SCALE = 0.25
"""Squared error at which the narrow part of a tracking reward has fallen to 1/e, (m/s)^2 or (rad/s)^2."""

FLIGHT_SPEED_MPS = 1.0
"""Commanded forward speed from which flight is rewarded, m/s."""

OFFSET_LIMIT_M = 0.5
"""Largest distance from the commanded path that is observed and penalized, metres."""


class VelocitySettings(FallSettings, PenaltySettings, DisturbanceSettings, CommandSettings, EntrySettings):
    """Settings of the task ``velocity``."""

    entry_fraction: float = fraction(
        0.5,
        "Entry fraction",
        "Fraction of the episodes of trainings that begin with a state of the entry policies, if there are any.",
        **{"with": ["entry_policies"]},
    )

    episode_steps: int = Field(
        default=1000,
        ge=10,
        le=100_000,
        title="Episode length",
        description="Length limit of an episode.",
        json_schema_extra={"unit": "steps"},
    )
    turn_weight: float = weight(0.5, "Turn weight", "Weight of the turn rate's tracking reward.")
    speed_weight: float = Field(
        default=0.0,
        ge=0.0,
        le=100.0,
        title="Speed weight",
        description="What every meter per second of the commanded speed adds to the weight of the velocity's tracking "
        "reward, which is 1 for standing. Fast commands are hard and rare; without it a robot rather misses them than "
        "risks a fall.",
    )
    flight_weight: float = weight(
        0.0,
        "Flight weight",
        f"Reward per step with both feet off the ground at commands of {FLIGHT_SPEED_MPS:g} m/s and more.",
    )
    path_penalty: float = weight(1.0, "Path penalty", "Penalty per step and meter of distance from the commanded path.")
    heading_penalty: float = weight(
        0.5, "Heading penalty", "Penalty per step for 1 - cos of the angle between torso and commanded heading."
    )
    tilt_penalty: float = weight(0.2, "Tilt penalty", "Penalty per step for the squared sine of the torso's tilt.")
    fall_penalty: float = weight(
        0.0,
        "Fall penalty",
        "Penalty for a fall. Where rewards are normalized, what is ten standard deviations of a return or "
        "more counts as ten.",
    )

    def for_evaluation(self) -> Self:
        """Return the settings without disturbances, from a stand, with all commands, in episodes of the usual length.

        What falls seldom falls less often in shorter episodes.
        """
        length = type(self).model_fields["episode_steps"].get_default()
        return super().for_evaluation().model_copy(update={"entry_policies": (), "episode_steps": length})


class Velocity(Task[VelocitySettings]):
    """Follow a commanded velocity.

    The command is a forward and a sideways speed in m/s, relative to the commanded heading, and a turn rate in rad/s,
    positive to the left. It is redrawn during the episode. The commanded heading begins as the torso's own and turns
    with the commanded rate; the commanded path begins where the torso is. Both begin again with every new command.
    With accelerations among the settings the robot is to approach the command: it observes, and is rewarded for, the
    velocity on the way, and results compare it with the command itself.
    """

    name = "velocity"
    summary = "Follow a commanded velocity: forward, sideways, and turning."
    Parameters = VelocitySettings
    metrics = (ERROR, FALL_RATE, SPEED)
    results = RESULTS
    ends = (FALL,)
    trace = (
        "forward_mps",
        "sideways_mps",
        "turn_rad_s",
        "command_forward",
        "command_sideways",
        "command_turn",
        "offset_m",
        "flight",
    )
    presentation = Presentation(
        skill="Follow a velocity",
        charts=(
            Chart("Velocity error", ("velocity_error_mps",)),
            Chart("Falls", ("fall_rate",)),
            Chart("Reward", ("reward",)),
            Chart("Episode length", ("episode_length",)),
        ),
        listed=("velocity_error_mps", "fall_rate", "forward_mps"),
        headline=("rmse_mps", "forward_settled_mps", "drift_m", "upright_rate", "flight_rate"),
    )

    @classmethod
    def supports(cls, robot: Robot) -> bool:
        """Return whether the robot perceives where it is."""
        return any(perceptor.name == "torso_pos" for perceptor in robot.perceptors)

    @classmethod
    def resolve(cls, parameters: VelocitySettings, robot: Robot) -> VelocitySettings:
        """Return the settings with the robot's own minimum height where none is given."""
        super().resolve(parameters, robot)
        require_entries(parameters.entry_policies, robot, cls.scene)
        return with_min_height(parameters, robot, robot_defaults(robot).fall_height_m)

    def __init__(self, parameters: VelocitySettings, world: World, seed: int = 0) -> None:
        super().__init__(parameters, world, seed)
        n = self.n
        self.max_steps = parameters.episode_steps
        self.command: FloatArray = self.add_array("command", 3)
        self._draws: IntArray = self.add_array("draws", fill=0)
        self.add_array("position", 2)
        self.add_array("yaw")
        self.add_array("perceived_position", 2)
        self._heading: FloatArray = self.add_array("heading")
        self._offset: FloatArray = self.add_array("offset")
        self._errors: FloatArray = self.add_array("errors")
        self._advance_m: FloatArray = self.add_array("advance")
        if any(parameters.accelerations):
            self.add_array("reference", 3)  # the velocity on the way to the command
        self.velocity: FloatArray = np.zeros((n, 3))  # forward, sideways, turn rate
        self._heading_error: FloatArray = np.zeros(n)
        self._tilt: FloatArray = np.zeros(n)
        self._fallen: BoolArray = np.zeros(n, dtype=np.bool_)
        self._entered = Entries(world) if parameters.entry_policies else None
        entry = []
        if self._entered is not None:
            self.arrays["state"] = self._entered.numbers
            entry = self._entered.last_actions()
        self._growth = CommandGrowth(parameters, n) if parameters.command_growth else None
        if self._growth:
            self.arrays |= self._growth.arrays
        self.measurements = (StoredNumbers([*entry, *self._follow(parameters.min_height_m or 0.0), *self._redraw()]),)
        self.flags = (self._fallen,)

    @property
    def _wanted(self) -> Number:
        """The velocity that a robot is to have now."""
        return self.stored("reference" if "reference" in self.arrays else "command")

    def _follow(self, min_height_m: float) -> list[Store]:
        """Return what measures a step against the command; ``resolve`` has filled in the minimum height."""
        world, wanted, heading = self.world, self._wanted, self.stored("heading")
        position, before = world.true_position[:2], self.stored("position")
        yaw, yaw_before = world.true_yaw, self.stored("yaw")
        perceived, perceived_before = world.perceived("torso_pos")[:2], self.stored("perceived_position")
        velocity, offset = source(self.velocity), self.stored("offset")
        errors, advance = self.stored("errors"), self.stored("advance")
        moved = along(heading, position - before)
        forward = moved[0]
        missed = velocity[:2] - self.stored("command")[:2]
        # path and heading are observed, so they follow what the robot perceives
        aside = along(heading, perceived - perceived_before)[1]
        zero = constant(0.0)
        return [
            Store(velocity, update=stack(moved, wrapped(yaw - yaw_before)) / STEP_S),
            Store(advance, begin=zero, update=advance + forward),
            Store(errors, begin=zero, update=errors + hypot(missed[0], missed[1])),
            Store(offset, update=offset + aside - wanted[1] * STEP_S),
            Store(heading, update=wrapped(heading + wanted[2] * STEP_S)),
            Store(self._error, update=wrapped(seen_yaw(world) - heading)),
            Store(before, begin=position, update=position),
            Store(yaw_before, begin=yaw, update=yaw),
            Store(perceived_before, begin=perceived, update=perceived),
            Store(source(self._tilt), update=1.0 - square(world.true_rotation[8])),
            Store(source(self._fallen), begin=zero, update=world.true_position[2] < min_height_m),
        ]

    def _redraw(self) -> list[Store]:
        """Return what draws new commands: at the start, and with the same chance in every step.

        A policy cannot foresee a change then. Heading and path begin again with every command.
        """
        settings, world = self.parameters, self.world
        streams, draws = source(world.streams), self.stored("draws")
        chance = uniform(self.seed + 1, streams, world.step + 100_003 * draws, 1)
        fresh = source(np.zeros(self.n, dtype=np.bool_))
        renewed = given("new_command", fresh)
        scale = self._growth.scale if self._growth else None
        target = given("command", commanded(settings, uniform(self.seed, streams, draws, 5), scale))
        yaw, zero = seen_yaw(world), constant(0.0)
        command, heading, offset = (self.stored(name) for name in ("command", "heading", "offset"))
        return [
            Store(fresh, update=chance < 1.0 / settings.command_steps),
            *(
                self._growth.stores(self._wanted, source(self.velocity), fresh, source(self._fallen))
                if self._growth
                else ()
            ),
            Store(command, begin=target, update=where(renewed, target, command)),
            *self._approach(),
            Store(heading, begin=yaw, update=where(renewed, yaw, heading)),
            Store(self._error, begin=zero, update=where(renewed, 0.0, self._error)),
            Store(offset, begin=zero, update=where(renewed, 0.0, offset)),
            Store(draws, begin=draws + 1.0, update=draws + fresh),
        ]

    def _approach(self) -> list[Store]:
        """Return what brings the velocity that a robot is to have now nearer to the command, if that takes time."""
        if "reference" not in self.arrays:
            return []
        reference, command = self.stored("reference"), self.stored("command")
        return [Store(reference, begin=command * 0.0, update=approached(self.parameters, reference, command))]

    @property
    def _error(self) -> Number:
        """Angle from the commanded heading to the perceived one."""
        return source(self._heading_error, "task.heading_error")

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return the robot's usual observations without its heading in the world, and those of the command."""
        observed = [name for name in self.world.defaults.observations if name != "heading"]
        usual = dict(zip(observed, blocks(self.world, observed), strict=True))
        begun = []
        if self._entered is not None and "velocity" in usual:
            begun.append(self._entered.moving(usual["velocity"]))
        if "reference" in self.arrays and "velocity" in usual:
            # a robot that takes over from another skill is in motion
            moving = source(usual["velocity"].arrays["velocity"], "velocity")
            begun.append(Store(self.stored("reference"), begin=stack(moving[0], moving[1], 0.0)))
        names = ("command_forward", "command_sideways", "command_turn")
        command = ObservationBlock(names, self._wanted, signs=(1.0, -1.0, -1.0), stores=begun)
        # named as in the sprint tasks, so that training can start from a policy that runs straight
        error = self._error
        heading = ObservationBlock(("heading_sin", "heading_cos"), stack(sin(error), cos(error)), signs=(-1.0, 1.0))
        path = [self._path(), heading] if self.world.defaults.knows_position else [heading]
        return [*usual.values(), command, *path]

    def critic_blocks(self) -> Sequence[ObservationBlock]:
        """Return the distance from the path where the robot does not perceive it."""
        own = [] if self.world.defaults.knows_position else [self._path()]
        return [*super().critic_blocks(), *own]

    def _path(self) -> ObservationBlock:
        offset = clip(self.stored("offset"), -OFFSET_LIMIT_M, OFFSET_LIMIT_M)
        return ObservationBlock(("line_offset",), offset, signs=(-1.0,))

    def starts(self, count: int, seed: int, noise_deg: float) -> Starts:
        """Return start poses, and record the states that episodes begin with."""
        if self._entered is not None:
            several = [FrozenPolicy(name) for name in self.parameters.entry_policies]
            states = max(1, min(self.parameters.handover_states, 4 * count) // len(several))
            longer = {Velocity.name: {"episode_steps": 100_000}}
            self._entered.states = joined(
                [
                    record_own(self.world.simulator, policy, states, seed, **longer.get(policy.spec.task.name, {}))
                    for policy in several
                ]
            )
        return super().starts(count, seed, noise_deg)

    def place(self, rows: IntArray) -> None:
        """Put some of the robots into a state of another policy."""
        if self._entered is None:
            return
        draws = uniform_numbers(self.seed + _ENTRIES, self.world.streams[rows], self._draws[rows], 2)
        self._entered.stand(rows)
        enters = draws[:, 0] < self.parameters.entry_fraction
        numbers = (draws[enters, 1] * len(self._entered.states)).astype(np.int64)
        self._entered.put(rows[enters], numbers, np.repeat([[*self.start_position(), 0.0]], len(numbers), axis=0))

    def start_position(self) -> tuple[float, float]:
        """Return a start in the robot's lane, where it has room in every direction."""
        return (0.0, float(self.robot.data.get("lane_y_m", 0.0)))

    def reward_terms(self) -> Sequence[RewardTerm]:
        """Return the tracking rewards and the penalties."""
        settings = self.parameters

        wanted, velocity = self._wanted, source(self.velocity)
        squared = total(square(velocity[:2] - wanted[:2]))
        off = absolute(self.stored("offset"))
        # the Gaussian alone has no gradient for a robot that stands and should run at 2 m/s
        tracking = 0.5 * exp(squared * -1.0 / TRACKING_SCALE) + 0.5 / (1.0 + sqrt(squared))
        if settings.speed_weight:
            tracking = tracking * (1.0 + settings.speed_weight * hypot(wanted[0], wanted[1]))
        return (
            RewardTerm("track_velocity", 1.0, tracking),
            RewardTerm(
                "track_turn",
                settings.turn_weight,
                exp(square(velocity[2] - wanted[2]) * -1.0 / TRACKING_SCALE),
            ),
            RewardTerm("flight", settings.flight_weight, self.world.flight & (wanted[0] >= FLIGHT_SPEED_MPS)),
            RewardTerm("path", -settings.path_penalty, minimum(off, OFFSET_LIMIT_M)),
            RewardTerm("heading", -settings.heading_penalty, 1.0 - cos(self._error)),
            RewardTerm("tilt", -settings.tilt_penalty, source(self._tilt)),
            RewardTerm("fall", -settings.fall_penalty, source(self._fallen)),
            *penalties(self.world, settings),
        )

    @property
    def growth(self) -> float | None:
        """How far the range of commands has grown."""
        return self._growth.mean if self._growth else None

    def set_command(self, rows: IntArray, command: FloatArray) -> None:
        """Give robots new commands, (k, 3) in m/s and rad/s; heading and path begin again."""
        self.command[rows] = command
        self._heading[rows] = seen_yaw(self.world)(rows)[:, 0]
        self._heading_error[rows] = 0.0
        self._offset[rows] = 0.0

    def measure(self, rows: IntArray) -> FloatArray:
        """Return mean velocity error, fall, and mean forward speed."""
        steps = self.world.steps[rows]
        return np.stack(
            [self._errors[rows] / steps, self._fallen[rows], self._advance_m[rows] / (steps * STEP_S)], axis=1
        )

    def trace_row(self, rows: IntArray) -> FloatArray:
        """Return velocity, command, distance from the path, and whether the robot flew."""
        flight = self.world.simulator.flight()[rows]
        return np.column_stack([self.velocity[rows], self.command[rows], self._offset[rows], flight])

    def summarize(self, episodes: Episodes, statistics: Statistics) -> tuple[Sequence[Result], Sequence[ResultTable]]:
        """Return how well the command was followed."""
        return followed(episodes, statistics), ()
