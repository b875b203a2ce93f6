"""Commanded velocities: their range, how they are drawn, and a range that grows with success."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from naosim.simulator import STEP_S
from naospec import TaskSettings
from pydantic import Field

from naosprint.tasks.fields import Ranges, RangeSettings, between, fraction
from naosprint.terms import Number, Store, clip, constant, hypot, maximum, source, sqrt, square, stack, total, where

if TYPE_CHECKING:
    from naosprint.arrays import AnyArray, FloatArray

SETTLING_S = 1.0
"""Time after a new command from which a robot is expected to follow it, seconds."""

FIRST_RANGE = 0.3
"""Part of the commands' range with which growing begins."""

_AVERAGED_S = 0.5  # the error of a command that ends is a mean whose weights fall to 1/e in this time


ACCELERATIONS = ("forward_acceleration_mps2", "sideways_acceleration_mps2", "turn_acceleration_rad_s2")
"""Settings of how fast a robot approaches a command."""


def _acceleration(name: str, unit: str) -> Any:
    return Field(
        default=None,
        gt=0.0,
        le=100.0,
        title=f"{name.capitalize()} acceleration",
        description=f"How fast the {name} speed that a robot is to have now approaches the commanded one: from 0 at "
        "the start of an episode, before a ball from the speed that the robot has. The policy observes it in place of "
        "the command. No robot changes its speed at once; one that is rewarded for trying falls. Left out: commands "
        "apply at once, before a ball as in the walker's training.",
        json_schema_extra={"unit": unit},
    )


class AccelerationSettings(TaskSettings):
    """Settings of how fast a robot approaches a commanded velocity."""

    forward_acceleration_mps2: float | None = _acceleration("forward", "m/s^2")
    sideways_acceleration_mps2: float | None = _acceleration("sideways", "m/s^2")
    turn_acceleration_rad_s2: float | None = _acceleration("turn", "rad/s^2")

    @property
    def accelerations(self) -> tuple[float | None, ...]:
        """Accelerations of the forward, sideways and turning speed; None: the commanded one applies at once."""
        return tuple(getattr(self, name) for name in ACCELERATIONS)


class CommandSettings(AccelerationSettings, RangeSettings):
    """Settings of tasks that command a velocity."""

    ranges: ClassVar[Ranges] = (("forward_min_mps", "forward_max_mps"),)

    forward_min_mps: float = Field(
        default=-0.5,
        ge=-5.0,
        le=5.0,
        title="Slowest forward",
        description="Lower end of the commanded forward speed.",
        json_schema_extra={"unit": "m/s"},
    )
    forward_max_mps: float = Field(
        default=2.0,
        ge=-5.0,
        le=5.0,
        title="Fastest forward",
        description="Upper end of the commanded forward speed.",
        json_schema_extra={"unit": "m/s"},
    )
    sideways_max_mps: float = Field(
        default=0.5,
        ge=0.0,
        le=3.0,
        title="Fastest sideways",
        description="Largest commanded speed to either side.",
        json_schema_extra={"unit": "m/s"},
    )
    turn_max_rad_s: float = Field(
        default=1.0,
        ge=0.0,
        le=5.0,
        title="Fastest turn",
        description="Largest commanded turn rate in either direction.",
        json_schema_extra={"unit": "rad/s"},
    )
    stand_fraction: float = fraction(0.1, "Standing fraction", "Fraction of the commands that are to stand still.")
    straight_fraction: float = fraction(
        0.3, "Straight fraction", "Fraction of the moving commands without sideways speed and turning."
    )
    command_steps: int = Field(
        default=250,
        ge=1,
        le=100_000,
        title="Command length",
        description="Steps after which a new command is drawn, on average.",
        json_schema_extra={"unit": "steps"},
    )
    command_ellipsoid: bool = Field(
        default=False,
        title="Ellipsoid of commands",
        description="Whether commands that combine speeds stay within the ellipsoid of the three largest ones: what "
        "is drawn outside is shortened to it. Hardly any robot can turn, sidestep and run at its fastest at once. "
        "Straight commands are drawn alike and lose only their other parts, so few of them are near the fastest.",
    )
    command_growth: float = fraction(
        0.0,
        "Growth of commands",
        f"A robot's commands begin within {FIRST_RANGE:.0%} of their range; every command that it follows "
        "for a second adds this fraction of the rest, and every one that it misses, and every fall, takes it away. "
        "0: the whole range from the start.",
        training_only=True,
    )
    command_error_mps: float = Field(
        default=0.3,
        gt=0.0,
        le=5.0,
        title="Error of a followed command",
        description="Error of the velocity, at the end of a command, below which the command counts as followed.",
        json_schema_extra={"unit": "m/s", "with": ["command_growth"]},
    )

    def for_evaluation(self) -> Self:
        """Return the same settings with the whole range of commands from the start."""
        return super().for_evaluation().model_copy(update={"command_growth": 0.0})


def commanded(settings: CommandSettings, drawn: Number, scale: Number | None) -> Number:
    """Return commands of forward, sideways and turning speed.

    Args:
        settings: their range.
        drawn: five numbers from 0 to 1.
        scale: part of the range that they come from; all of it if None.
    """
    low, high = settings.forward_min_mps, settings.forward_max_mps
    moving = stack(
        between(low, high, drawn[0]),
        settings.sideways_max_mps * (2.0 * drawn[1] - 1.0),
        settings.turn_max_rad_s * (2.0 * drawn[2] - 1.0),
    )
    if settings.command_ellipsoid:
        # length in units of the ellipsoid's axes; backward and forward have an axis each, and one of no length counts 0
        axes = [max(high, 0.0), max(-low, 0.0), settings.sideways_max_mps, settings.turn_max_rad_s]
        ahead, back, side, turn = (1.0 / axis if axis else 0.0 for axis in axes)
        length = sqrt(
            square(moving[0] * where(moving[0] > 0.0, ahead, back))
            + square(moving[1] * side)
            + square(moving[2] * turn)
        )
        moving = moving / maximum(length, 1.0)
    if scale is not None:
        moving = moving * scale
    straight = where(drawn[3] < settings.straight_fraction, stack(moving[0], 0.0, 0.0), moving)
    return where(drawn[4] < settings.stand_fraction, 0.0, straight)


def approached(settings: AccelerationSettings, reference: Number, command: Number) -> Number:
    """Return the velocity that a robot is to have in the next step.

    Args:
        settings: the accelerations.
        reference: the velocity that it is to have now: forward, sideways and turning speed.
        command: the velocity that it is to have in the end.
    """
    if not any(settings.accelerations):
        return command
    parts = []
    for number, acceleration in enumerate(settings.accelerations):
        missing = command[number] - reference[number]
        most = (acceleration or 0.0) * STEP_S
        parts.append(reference[number] + clip(missing, -most, most) if acceleration else command[number])
    return stack(*parts)


class CommandGrowth:
    """How far the range of each robot's commands has grown.

    Args:
        settings: by how much, and when.
        n: number of robots.

    Attributes:
        arrays: what the next step depends on; part of checkpoints.
    """

    def __init__(self, settings: CommandSettings, n: int) -> None:
        self._settings = settings
        self._grown: FloatArray = np.zeros(n)
        self.arrays: dict[str, AnyArray] = {
            "grown": self._grown,
            "command_steps": np.zeros(n, dtype=np.int64),
            "command_error": np.zeros(n),
        }

    @property
    def scale(self) -> Number:
        """Part of the whole range that commands come from now."""
        return FIRST_RANGE + (1.0 - FIRST_RANGE) * source(self._grown)

    @property
    def mean(self) -> float:
        """Mean growth of all robots, from 0 to 1."""
        return float(self._grown.mean())

    def stores(self, command: Number, velocity: Number, renewed: Number, fallen: Number) -> list[Store]:
        """Return what rates a step.

        Args:
            command: the command that has applied in it.
            velocity: the robots' forward, sideways and turning speed in it.
            renewed: whether the command ends now.
            fallen: whether the robot fell.
        """
        growth, zero = self._settings.command_growth, constant(0.0)
        steps, error = source(self.arrays["command_steps"]), source(self.arrays["command_error"])
        missed = velocity[:2] - command[:2]
        weight = STEP_S / _AVERAGED_S
        # standing is no success: it says nothing about the range
        rated = renewed & (steps >= SETTLING_S / STEP_S) & (total(square(command)) > 0.0)
        change = where(error < self._settings.command_error_mps, growth, -growth)
        return [
            Store(steps, begin=zero, update=steps + 1.0),
            Store(error, begin=zero, update=error + weight * (hypot(missed[0], missed[1]) - error)),
            Store(
                source(self._grown),
                update=clip(source(self._grown) + where(fallen, -growth, where(rated, change, 0.0)), 0.0, 1.0),
            ),
            Store(steps, update=where(renewed, 0.0, steps)),
        ]
