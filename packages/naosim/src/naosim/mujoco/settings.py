"""Settings of the simulators of the Booster family."""

from __future__ import annotations

from typing import Literal

from naospec import SimulatorSettings
from pydantic import Field

_SETTLE_STEPS = Field(
    default=40,
    ge=1,
    le=500,
    title="Settling time",
    description="Steps of 20 ms between the beam and the start of an episode; the motors hold the start pose.",
)


Engine = Literal["fast", "mujoco"]
"""What steps the embedded worlds: the engine of trainings, or MuJoCo as the server does."""


class BoosterEmbeddedParameters(SimulatorSettings):
    """Settings of Booster robots in MuJoCo worlds of this process."""

    engine: Engine = Field(
        default="fast",
        title="Engine",
        description=(
            "`mujoco` matches the server bit for bit, and is what evaluations take. `fast` steps several robots at "
            "once, about ten times as fast, and differs only by rounding."
        ),
    )
    truncate: bool = Field(
        default=True,
        title="Truncated perceptors",
        description="Truncate perceptors to the decimals that the server prints.",
    )
    action_delay: int = Field(
        default=1,
        ge=0,
        le=1,
        title="Action delay",
        description="Delay of commands in steps; 1 in the server's parallel loop, which competitions use.",
    )
    settle_steps: int = _SETTLE_STEPS

    def for_evaluation(self) -> BoosterEmbeddedParameters:
        """Return the same settings with MuJoCo as the engine."""
        return self.model_copy(update={"engine": "mujoco"})

    @classmethod
    def replacement(cls, name: str, value: object) -> str:
        """Return what replaces ``exact``."""
        return f"engine: {'mujoco' if value in (True, 'true') else 'fast'}" if name == "exact" else ""


class BoosterServerParameters(SimulatorSettings):
    """Settings of Booster robots on servers."""

    settle_steps: int = _SETTLE_STEPS
