"""Penalties that several tasks share: on torque, on changes of the action, on the action itself, and on hopping."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from naosim.simulator import Ability
from naospec import TaskSettings
from naospec.abilities import perceptor

from naosprint.tasks.base import RewardTerm
from naosprint.tasks.fields import weight
from naosprint.terms import constant, maximum, mean, square, total

if TYPE_CHECKING:
    from naosprint.tasks.world import World

HOP_FLOOR_DEG_S = 30.0
"""Joint speed far below which no motion counts as hopping, deg/s."""


class PenaltySettings(TaskSettings):
    """Weights of the shared penalties, in units of the task's reward before ``reward_scale``."""

    torque_penalty: float = weight(
        0.0,
        "Torque penalty",
        "Penalty per step for the mean square of the motors' torques as shares of their limits.",
        needs=Ability.TORQUES,
    )
    smoothness_penalty: float = weight(
        0.0, "Smoothness penalty", "Penalty per step for the mean square change of the action."
    )
    action_penalty: float = weight(0.0, "Action penalty", "Penalty per step for the mean square of the action.")
    hop_penalty: float = weight(
        0.0,
        "Hop penalty",
        "Penalty per step for left and right joints that move alike, as when hopping on both feet.",
        needs=perceptor("joint_speeds"),
    )


def penalties(world: World, settings: PenaltySettings) -> tuple[RewardTerm, ...]:
    """Return the shared penalties as reward terms.

    Raises:
        ValueError: if torque is penalized and the simulator does not report motor torques.
    """
    hop = (hopping(world, settings.hop_penalty),) if settings.hop_penalty else ()
    torque = mean(square(world.torque_shares)) if settings.torque_penalty else constant(0.0)

    return (
        RewardTerm("torque", -settings.torque_penalty, torque),
        RewardTerm("smoothness", -settings.smoothness_penalty, mean(square(world.action - world.previous_action))),
        RewardTerm("action", -settings.action_penalty, mean(square(world.action))),
        *hop,
    )


def hopping(world: World, weight: float) -> RewardTerm:
    """Return the penalty for left and right joints that move alike.

    With l and r the speeds of a left joint and its mirror image, in mirrored directions, and sums over the pairs with
    the motors' maximum torques as weights, or equal ones if a motor has no maximum, it is
    sum(l r) / (sum(l^2 + r^2) / 2 + floor), or 0 where that is negative. A policy that treats left and right alike,
    from a start that is nearly symmetric, can learn to hop on both feet; it is then slower than one that steps.

    Raises:
        ValueError: if the robot has no actuated joints on the left and right.
    """
    joints = {joint.name: (number, joint) for number, joint in enumerate(world.robot.joints)}
    pairs = [
        (number, *joints[joint.mirror]) for number, joint in joints.values() if joint.actuated and joint.side == "left"
    ]
    if not pairs:
        raise ValueError(
            f"task.hop_penalty: robot {world.robot.name} has no actuated joints on the left and right; set it to 0"
        )
    left, right = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    signs = np.array([world.robot.joints[a].sign * other.sign for a, _, other in pairs])
    torques = np.array([other.max_torque for _, _, other in pairs])
    if not np.isfinite(torques).all():
        torques = np.ones(len(pairs))
    shares = torques / torques.sum()
    speeds = world.perceived("joint_speeds")
    a, b = speeds[left], speeds[right]
    products = total(a * b * (signs * shares).tolist())
    squares = total((a * a + b * b) * (0.5 * shares).tolist())
    return RewardTerm("hop", -weight, maximum(products / (squares + HOP_FLOOR_DEG_S**2), 0.0))
