"""Settings of the task ``kick``."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from naosprint.tasks.ball import NearBallSettings
from naosprint.tasks.fields import fraction, weight

_SIGHTS_APART = 2  # steps between two sights of the ball


class KickSettings(NearBallSettings):
    """Settings of the task ``kick``."""

    ranges = (("distance_min_m", "distance_max_m"),)

    aligned_fraction: float = fraction(
        0.65,
        "Aligned fraction",
        "Fraction of the episodes with an aim within 10 degrees, and a ball 0.45 to 0.9 m ahead and within "
        "6 cm of a foot's line.",
    )
    aim_max_deg: float = Field(
        default=30.0,
        ge=0.0,
        le=45.0,
        title="Largest aim",
        description="Largest angle between the robot's front and the commanded direction in the other episodes.",
        json_schema_extra={"unit": "deg"},
    )
    rolling_fraction: float = fraction(0.1, "Rolling fraction", "Fraction of the episodes with a rolling ball.")
    ball_speed_max_mps: float = Field(
        default=1.5,
        ge=0.0,
        le=1.5,
        title="Fastest ball",
        description="Largest speed of a rolling ball.",
        json_schema_extra={"unit": "m/s", "with": ["rolling_fraction"]},
    )
    distance_min_m: float = Field(
        default=1.5,
        ge=1.5,
        le=10.0,
        title="Shortest kick",
        description="Lower end of the commanded distance.",
        json_schema_extra={"unit": "m"},
    )
    distance_max_m: float = Field(
        default=10.0,
        ge=1.5,
        le=10.0,
        title="Longest kick",
        description="Upper end of the commanded distance.",
        json_schema_extra={"unit": "m"},
    )
    power_fraction: float = fraction(
        0.4, "Power kicks", "Fraction of the kicks that are to go as far as possible; their commanded distance is 10 m."
    )
    takeover_steps: int = Field(
        default=6,
        ge=0,
        le=1000,
        title="Takeover",
        description="Steps from the perceived kick until the walker takes over.",
        json_schema_extra={"unit": "steps"},
    )
    watch_steps: int = Field(
        default=45,
        ge=0,
        le=1000,
        title="Walker's steps",
        description="Steps that the walker acts before an episode ends.",
        json_schema_extra={"unit": "steps"},
    )
    kicked_m: float = Field(
        default=0.04,
        ge=0.01,
        le=1.0,
        title="Kicked from",
        description="Distance of the ball from where it was expected from which it counts as kicked, and the walker "
        "takes over. Too small, noise looks like a kick; too large, a soft kick goes unnoticed.",
        json_schema_extra={"unit": "m"},
    )
    sight_share: float = Field(
        default=1.0,
        gt=0.0,
        le=1.0,
        title="Share of a sight",
        description="Share of a new sight in the place from which the ball is expected to roll on; 1: the last sight "
        "alone. A smaller one evens out noise, and adds up what a soft kick moves the ball in several sights.",
    )
    least_share: float = fraction(
        0.0,
        "Weakest kick",
        "Smallest share of the way to its target that a kicked ball may roll, as the robot perceives it; "
        "after a weaker kick the robot kicks again. 0: it kicks once.",
    )
    approach_steps: int = Field(
        default=150,
        ge=10,
        le=10_000,
        title="Approach limit",
        description="Steps within which the ball has to be kicked.",
        json_schema_extra={"unit": "steps"},
    )
    earliest_touch_steps: int = Field(
        default=0,
        ge=0,
        le=1000,
        title="Earliest touch",
        description="Steps before which a touch costs what a miss costs, so that the robot places itself before it "
        "kicks.",
        json_schema_extra={"unit": "steps"},
    )
    whole_roll: bool = Field(
        default=False,
        title="Whole roll",
        description="Episodes end when the ball has stopped and 3 s have passed, as in evaluations.",
    )
    place_weight: float = weight(
        1.0, "Placement weight", "Reward for a first touch with the ball before the foot, whose yaw is that of the aim."
    )
    place_spread: float = Field(
        default=1.0,
        gt=0.0,
        le=10.0,
        title="Placement spread",
        description="Factor of the distances and angles at which the placement's reward has fallen to 1/e: 4 cm beside "
        "the foot's line, and 12 degrees of the foot.",
        json_schema_extra={"with": ["place_weight"]},
    )
    distance_spread: float = Field(
        default=0.35,
        ge=0.02,
        le=2.0,
        title="Distance spread",
        description="Logarithm of actual to commanded roll at which the distance's score has fallen to 1/e: of 0.35, "
        "a roll of 1.4 times the commanded one. A smaller one asks for more precise passes, once kicks are close.",
    )
    upright_weight: float = weight(1.0, "Upright weight", "Reward for an episode that ends upright.")
    miss_penalty: float = weight(1.0, "Miss penalty", "Penalty for an episode without a kick.")
    time_penalty: float = fraction(0.002, "Time penalty", "Penalty per step before the first touch.")

    @model_validator(mode="after")
    def _weighed(self) -> Self:
        if self.least_share > 0.0 and self.takeover_steps < _SIGHTS_APART:
            raise PydanticCustomError(
                "least_share",
                "least_share: a ball is seen in every second step, so how it rolls is not known after takeover_steps, "
                "{steps}; use {least} or more, or least_share 0",
                {"steps": self.takeover_steps, "least": _SIGHTS_APART},
            )
        return self

    def for_evaluation(self) -> Self:
        """Return the same settings without disturbances, and with episodes that last until the ball has stopped."""
        return super().for_evaluation().model_copy(update={"whole_roll": True})
