"""``policy.npz``: the policy and the robot's tables as arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from naosim import robots
from naosim.robots.actuation import Actuation
from naosim.simulator import STEP_S

from naosprint.export import booster, nao
from naosprint.tasks.commands import CommandSettings
from naosprint.tasks.kick_settings import KickSettings

if TYPE_CHECKING:
    from naosprint.arrays import AnyArray, FloatArray
    from naosprint.rl.checkpoint import Manifest
    from naosprint.rl.policy import NetworkPolicy

FORMAT = 3
"""Version of the exported files."""


def policy_arrays(policy: NetworkPolicy, manifest: Manifest) -> dict[str, AnyArray]:
    """Return everything that an agent needs, by name.

    With A actions, J joints and the observations x of the policy, in radians and in the simulator's order and signs::

        z = clip((x - mean) * scale, -clip, clip)
        z = activations[i](weights_i @ z + bias_i) for each layer i: tanh, relu or linear
        targets = clip(middle_rad + reach_rad @ clip(z, -1, 1), low_rad, high_rad)

    ``joint_view`` (A, J) turns joint angles into those of the policy. :mod:`naosprint.export.nao` and
    :mod:`naosprint.export.booster` add what their servers need.
    """
    robot = robots.configured(manifest.stage_spec.robot)
    actuation = Actuation(robot)
    view = np.zeros((actuation.n_actions, actuation.n_joints))
    view[np.arange(actuation.n_actions), actuation.index] = actuation.sign
    arrays: dict[str, AnyArray] = {
        "format": np.array(FORMAT),
        "robot": np.array(robot.name),
        "cycle_s": np.array(STEP_S),
        "mean": policy.mean,
        "scale": policy.scale,
        "clip": np.array(policy.clip),
        "layers": np.array(len(policy.layers)),
        "activations": np.array(policy.activations),
        "observation_names": np.array(manifest.observations),
        "action_names": np.array(manifest.actions),
        "joint_names": np.array(robot.joint_names),
        "effector_names": np.array([joint.effector for joint in robot.joints]),
        "joint_view": view,
        "middle_rad": _middle(actuation) @ view + np.where(view.any(axis=0), 0.0, robot.nominal),
        "reach_rad": view.T * _reach(actuation),
        "low_rad": np.array([min(joint.low_rad, joint.high_rad) for joint in robot.joints]),
        "high_rad": np.array([max(joint.low_rad, joint.high_rad) for joint in robot.joints]),
        "max_speed": np.array([joint.max_speed for joint in robot.joints]),
        "start_pose_rad": robot.nominal,
        "standing_height_m": np.array(robot.standing_height_m),
    }
    for i, (weights, bias) in enumerate(policy.layers):
        arrays[f"weights_{i}"], arrays[f"bias_{i}"] = weights, bias
    if robot.family == nao.FAMILY:
        arrays.update(nao.arrays(robot, manifest.observations))
    elif robot.family == booster.FAMILY:
        arrays.update(booster.arrays(robot, manifest.spec.simulator))
    task = manifest.stage_spec.task
    if isinstance(task, KickSettings):
        arrays.update(booster.kick_arrays(task))
    if isinstance(task, CommandSettings):
        high = np.array([task.forward_max_mps, task.sideways_max_mps, task.turn_max_rad_s])
        arrays["command_low"], arrays["command_high"] = np.array([task.forward_min_mps, *-high[1:]]), high
    return arrays


def _middle(actuation: Actuation) -> FloatArray:
    """Return the (A,) angles of action 0, policy convention."""
    if actuation.robot.action_range_rad is not None:
        return actuation.nominal
    return (actuation.low_rad + actuation.high_rad) / 2.0


def _reach(actuation: Actuation) -> FloatArray:
    """Return the (A,) angles from action 0 to action 1."""
    ranges = actuation.robot.action_range_rad
    if ranges is not None:
        return np.array([ranges[name] for name in actuation.names])
    return (actuation.high_rad - actuation.low_rad) / 2.0
