"""Peaks of a policy's motion beside those of its robot standing.

A policy that exploits the solver shows here: joints faster than motors turn, or soles deep in the ground.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from naosim.mujoco.embedded import MujocoSimulator
from naosim.robots.booster import FAMILY
from naospec import EvaluationSpec

from naosprint.rl.policy import load_policy
from naosprint.tasks.base import Task
from naosprint.tasks.environment import Environment, open_environment

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from naosprint.arrays import FloatArray

ROWS = (
    ("Largest joint speed", "joint_speed_rad_s", "rad/s"),
    ("Largest force on a foot", "foot_force_n", "N"),
    ("Deepest contact", "contact_depth_mm", "mm"),
)
"""Title, key and unit of each peak."""

_EPISODES, _STEPS, _SEED = 16, 500, 4242
_AT_LIMIT, _FALLEN = 0.99, 0.6


def motion(checkpoint: Path, threads: int = 2) -> dict[str, dict[str, float]]:
    """Return the peaks of 16 episodes without a fall, `running`, and of the robot `standing`.

    Beside the peaks each has the share of time that motors are at their torque limit, `torque_at_limit`. Robots whose
    simulator does not report forces and contacts have no peaks.
    """
    policy, manifest = load_policy(checkpoint)
    if manifest.stage_spec.family != FAMILY:
        return {}
    # contacts are read from MuJoCo's data, which neither the fast engine nor a server fills
    spec = EvaluationSpec(simulator="embedded").applied_to(manifest.stage_spec)
    environment = open_environment(spec, _EPISODES, threads=threads, seed=_SEED)
    try:
        task, noise_deg = environment.task, spec.task.start_noise_deg
        everyone = np.arange(_EPISODES)
        still = np.zeros((_EPISODES, environment.actuation.n_actions))
        found = {}
        for name, drawn, act in (
            ("running", task.starts, lambda: policy.act(environment.observations, None)),
            ("standing", partial(Task.starts, task), lambda: still),
        ):
            starts = drawn(_EPISODES, _SEED, noise_deg)
            environment.load_starts(starts)
            environment.restart(everyone, everyone % len(starts))
            found[name] = _peaks(environment, act, standing=name == "standing")
    finally:
        environment.close()
    return found


def _peaks(environment: Environment, act: Callable[[], FloatArray], *, standing: bool) -> dict[str, float]:
    simulator = environment.simulator
    assert isinstance(simulator, MujocoSimulator)
    active, fell = np.ones(environment.n, dtype=np.bool_), np.zeros(environment.n, dtype=np.bool_)
    peaks = np.zeros((len(ROWS), environment.n))
    limited = samples = 0.0
    for _ in range(_STEPS):
        environment.step(act(), active)
        fell |= active & environment.failed
        active &= ~environment.terminated & ~environment.truncated
        if standing:  # of the tasks, getup does not end with a fall
            active &= simulator.truth.torso_position[:, 2] > _FALLEN * simulator.robot.standing_height_m
        if not active.any():
            break
        depths = [-data.contact.dist.min(initial=0.0) for data in simulator.batch.data]
        now = np.stack(
            [
                np.radians(np.abs(environment.world.perceptors["joint_speeds"]).max(axis=1)),
                simulator.foot_frames().max(axis=(1, 2)),
                1000.0 * np.array(depths),
            ]
        )
        peaks[:, active] = np.maximum(peaks, now)[:, active]
        shares = np.abs(simulator.torque_shares(slice(0, environment.n))[active])
        limited += float((shares > _AT_LIMIT).sum())
        samples += shares.size
    of_upright = peaks[:, ~fell].max(axis=1, initial=0.0).tolist()
    return {
        **{key: round(peak, 1) for (_, key, _), peak in zip(ROWS, of_upright, strict=True)},
        "torque_at_limit": round(limited / max(samples, 1.0), 3),
    }
