"""Falls: the torso height below which an episode ends, shared by tasks in which a robot has to stay on its feet."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from naospec import TaskSettings
from pydantic import Field

from naosprint.tasks.base import End
from naosprint.tasks.episodes import rate_metric

if TYPE_CHECKING:
    from naosim.robots import Robot

FALL = End("fallen", "Fall", failure=True)
"""End of an episode whose torso sinks below the minimum height."""

FALL_RATE = rate_metric("fall_rate", "Falls", "Fraction of episodes that ended by a fall.", "lower")


class FallSettings(TaskSettings):
    """Settings of tasks that end with a fall."""

    min_height_m: float | None = Field(
        default=None,
        gt=0.0,
        le=10.0,
        title="Minimum torso height",
        description="Torso height below which an episode ends as a fall; left out: the robot's own.",
        json_schema_extra={"unit": "m"},
    )


Settings = TypeVar("Settings", bound=FallSettings)


def with_min_height(parameters: Settings, robot: Robot, usual_m: float) -> Settings:
    """Return the settings with ``usual_m`` as the minimum height if none is given.

    Raises:
        ValueError: if the robot cannot stand above that height.
    """
    height = usual_m if parameters.min_height_m is None else parameters.min_height_m
    if height >= robot.standing_height_m:
        raise ValueError(
            f"task.min_height_m: {height:g} m is not below the standing height of robot {robot.name}, "
            f"{robot.standing_height_m:.3f} m; use a smaller min_height_m"
        )
    return parameters.model_copy(update={"min_height_m": height})
