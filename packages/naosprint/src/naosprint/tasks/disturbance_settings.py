"""Settings of the disturbances of the ideal world.

Evaluations have none unless they are set for the evaluation itself.
"""

from __future__ import annotations

from typing import ClassVar, Self

from naosim.simulator import Ability
from naospec import TaskSettings
from pydantic import Field

from naosprint.tasks.fields import Ranges, RangeSettings, fraction

_WORLD = (
    "mass_variation",
    "gain_variation",
    "centre_of_mass_m",
    "friction_min",
    "friction_max",
    "stiffness_min",
    "stiffness_max",
    "gravity_min",
)
_REST = ("push_mps", "extra_delay", "extra_delay_max", "sensor_noise", "ball_noise_m")


class DisturbanceSettings(RangeSettings):
    """Settings of tasks that can be disturbed."""

    ranges: ClassVar[Ranges] = (
        ("friction_min", "friction_max"),
        ("stiffness_min", "stiffness_max"),
        ("extra_delay", "extra_delay_max"),
    )

    push_mps: float = Field(
        default=0.0,
        ge=0.0,
        le=5.0,
        title="Pushes",
        description="Largest change of the torso's horizontal velocity by a push.",
        json_schema_extra={"unit": "m/s", "needs": Ability.PUSHES},
    )
    push_steps: int = Field(
        default=100,
        ge=1,
        le=100_000,
        title="Steps between pushes",
        description="Steps between two pushes, on average.",
        json_schema_extra={"unit": "steps", "with": ["push_mps"]},
    )
    mass_variation: float = Field(
        default=0.0,
        ge=0.0,
        le=0.5,
        title="Mass variation",
        description="Each body's mass differs by up to this fraction, drawn for each robot.",
        json_schema_extra={"needs": Ability.MASSES},
    )
    gain_variation: float = Field(
        default=0.0,
        ge=0.0,
        le=0.5,
        title="Gain variation",
        description="Stiffness and damping of each motor differ by up to this fraction, drawn for each robot.",
        json_schema_extra={"needs": Ability.GAINS},
    )
    centre_of_mass_m: float = Field(
        default=0.0,
        ge=0.0,
        le=0.1,
        title="Centre of mass",
        description="The torso's center of mass is shifted by up to this distance along each axis, drawn for each "
        "robot.",
        json_schema_extra={"unit": "m", "needs": Ability.CENTRES},
    )
    friction_min: float = Field(
        default=1.0,
        gt=0.0,
        le=3.0,
        title="Lowest friction",
        description="Lower end of the factor of the friction of the robot with the ground, the ball and itself, drawn "
        "for each robot.",
        json_schema_extra={"needs": Ability.FRICTION, "off": 1.0},
    )
    friction_max: float = Field(
        default=1.0,
        gt=0.0,
        le=3.0,
        title="Highest friction",
        description="Upper end of that factor.",
        json_schema_extra={"needs": Ability.FRICTION, "off": 1.0},
    )
    stiffness_min: float = Field(
        default=1.0,
        ge=0.05,
        le=4.0,
        title="Softest contacts",
        description="Lower end of the factor of the stiffness of the robot's contacts with the ground and itself, "
        "drawn for each robot; their damping has its root as a factor.",
        json_schema_extra={"needs": Ability.STIFFNESS, "off": 1.0},
    )
    stiffness_max: float = Field(
        default=1.0,
        ge=0.05,
        le=4.0,
        title="Stiffest contacts",
        description="Upper end of that factor; at most 4 for a T1 and 1 for a K1, by the steps of MuJoCo.",
        json_schema_extra={"needs": Ability.STIFFER, "off": 1.0},
    )
    gravity_min: float = fraction(
        1.0,
        "Lowest gravity",
        "Gravity of the first robot as a fraction of normal gravity, rising evenly to 1 for the last. "
        "Light robots find a motion first, from which the others learn.",
        needs=Ability.GRAVITY,
        off=1.0,
    )
    extra_delay: int = Field(
        default=0,
        ge=0,
        le=5,
        title="Extra delay",
        description="Steps by which every command acts later than the simulator's own delay.",
        json_schema_extra={"unit": "steps"},
    )
    extra_delay_max: int | None = Field(
        default=None,
        ge=0,
        le=5,
        title="Most extra delay",
        description="Upper end of the extra delay, drawn for each episode; left out: equal to the lower end.",
        json_schema_extra={"unit": "steps"},
    )
    sensor_noise: float = Field(
        default=0.0,
        ge=0.0,
        le=10.0,
        title="Sensor noise",
        description="Factor of the perceptors' noise; 1 means 0.5 degrees for joint angles and 5 deg/s for the gyro.",
    )
    undisturbed_fraction: float = Field(
        default=0.0,
        ge=0.0,
        le=0.9,
        title="Undisturbed fraction",
        description="Fraction of the robots without disturbances, so that a policy stays fast in the ideal world.",
        json_schema_extra={"with": [*_WORLD, *_REST]},
    )
    disturbance_probability: float = Field(
        default=1.0,
        gt=0.0,
        le=1.0,
        title="Probability of a disturbance",
        description="Probability with which a disturbed robot has each kind of disturbance: pushes; masses, motors and "
        "center of mass; friction; stiffness; delay; noise. 1: all of them at once. With less, more robots learn from "
        "one kind alone.",
        json_schema_extra={"with": [*_WORLD, *_REST]},
    )
    disturbance_growth: float = fraction(
        0.0,
        "Growth of disturbances",
        "A robot's disturbances begin without strength; every episode that succeeds adds this "
        "fraction of their full strength, and every other one takes it away. 0: full strength from the start. The "
        "extra delay's lower end and gravity do not grow.",
        **{"training_only": True, "with": [*_WORLD, *_REST]},
    )
    episode_worlds: bool = Field(
        default=False,
        title="World of each episode",
        description="Whether bodies, motors, friction and stiffness are drawn for every episode, as they always are "
        "when disturbances grow; otherwise once for each robot.",
        json_schema_extra={"with": [*_WORLD]},
    )

    def for_evaluation(self) -> Self:
        """Return the same settings without disturbances."""
        ideal = {name: DisturbanceSettings.model_fields[name].default for name in _NAMES}
        return super().for_evaluation().model_copy(update=ideal)


class BallNoiseSettings(TaskSettings):
    """Settings of tasks whose ball can be seen with noise."""

    ball_noise_m: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        title="Noise on the ball",
        description="Standard deviation of where a robot sees the ball, in each direction, besides the simulator's own "
        "rounding.",
        json_schema_extra={"unit": "m"},
    )

    def for_evaluation(self) -> Self:
        """Return the same settings with a ball that is seen where it is."""
        return super().for_evaluation().model_copy(update={"ball_noise_m": 0.0})


_NAMES = tuple(name for name in DisturbanceSettings.model_fields if name not in TaskSettings.model_fields)
