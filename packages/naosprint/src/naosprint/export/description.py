"""``policy.json``: inputs and outputs of a policy, for readers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from naosim import robots
from naosim.robots.actuation import Actuation
from naosim.simulator import STEP_S

from naosprint.export import booster, nao
from naosprint.export.arrays import FORMAT

if TYPE_CHECKING:
    from naosim.robots import Robot

    from naosprint.rl.checkpoint import Manifest
    from naosprint.rl.policy import NetworkPolicy


def describe(policy: NetworkPolicy, manifest: Manifest) -> dict[str, Any]:
    """Return the content of ``policy.json``: angles in degrees in the policy convention."""
    robot = robots.configured(manifest.stage_spec.robot)
    actuation = Actuation(robot)
    low, zero, high = (
        np.degrees(actuation.targets(np.full((1, actuation.n_actions), action))[0, actuation.index] * actuation.sign)
        for action in (-1.0, 0.0, 1.0)
    )
    return {
        "format": FORMAT,
        "checkpoint": {"step": manifest.steps, "spec_sha256": manifest.spec_sha256},
        "spec": manifest.spec.model_dump(mode="json"),
        "robot": robot.name,
        "step_s": STEP_S,
        "observations": list(manifest.observations),
        "actions": [
            {
                "joint": name,
                "minus_one_deg": round(float(a), 6),
                "zero_deg": round(float(b), 6),
                "plus_one_deg": round(float(c), 6),
                "sign": float(sign),
            }
            for name, a, b, c, sign in zip(manifest.actions, low, zero, high, actuation.sign, strict=True)
        ],
        "controller": _controller(robot),
        "network": {
            "input": ["N", len(policy.mean)],
            "output": ["N", policy.n_actions],
            "hidden": [len(bias) for _, bias in policy.layers[:-1]],
            "activation": policy.activation,
            "output_activation": policy.activations[-1],
        },
    }


def _controller(robot: Robot) -> dict[str, Any] | None:
    """Return the controller that converts target angles to motor commands; None for other robot families."""
    if robot.family == nao.FAMILY:
        return nao.controller()
    return booster.controller(robot) if robot.family == booster.FAMILY else None
