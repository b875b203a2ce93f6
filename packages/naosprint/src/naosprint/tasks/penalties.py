"""Penalties that several tasks share: on motor torque, on changes of the action, on the action itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from naosprint.tasks.base import RewardTerm
from naosprint.tasks.compiled import Operation
from naosprint.tasks.disturbances import DisturbanceSettings

if TYPE_CHECKING:
    from naosprint.arrays import FloatArray
    from naosprint.tasks.base import World


class PenaltySettings(DisturbanceSettings):
    """Weights of the shared penalties, in units of the task's reward before ``reward_scale``."""

    torque_penalty: float = Field(
        default=0.0,
        ge=0.0,
        le=1000.0,
        title="Torque penalty",
        description="Penalty per step for the mean square of the motors' torques as shares of their limits.",
    )
    smoothness_penalty: float = Field(
        default=0.0,
        ge=0.0,
        le=1000.0,
        title="Smoothness penalty",
        description="Penalty per step for the mean square change of the action.",
    )
    action_penalty: float = Field(
        default=0.0,
        ge=0.0,
        le=1000.0,
        title="Action penalty",
        description="Penalty per step for the mean square of the action.",
    )


def penalties(world: World, settings: PenaltySettings) -> tuple[RewardTerm, ...]:
    """Return the shared penalties as reward terms.

    Raises:
        ValueError: if torque is penalized and the simulator does not report motor torques.
    """
    if settings.torque_penalty:
        world.torque_share(slice(0, 1))

    def smoothness(rows: slice) -> FloatArray:
        return np.asarray(np.square(world.actions[rows] - world.previous_actions[rows]).mean(axis=1))

    def action(rows: slice) -> FloatArray:
        return np.asarray(np.square(world.actions[rows]).mean(axis=1))

    return (
        RewardTerm("torque", -settings.torque_penalty, world.torque_share),
        RewardTerm(
            "smoothness",
            -settings.smoothness_penalty,
            smoothness,
            Operation("mean_square", {"values": world.actions, "less": world.previous_actions}),
        ),
        RewardTerm("action", -settings.action_penalty, action, Operation("mean_square", {"values": world.actions})),
    )
