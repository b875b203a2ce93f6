"""Data for agents on rcssserver3d besides the policy: joint controller, start, centre of mass."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from naosim.robots.nao import FAMILY, model_of
from naosim.simspark.control import DROP_M, GAIN, SETTLING_CYCLES
from naosim.simspark.protocol import LANDMARKS
from naosim.simulator import STEP_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from naosim.robots import Robot
    from naosim.robots.nao_model import RobotModel

    from naosprint.arrays import AnyArray

__all__ = ["FAMILY", "arrays", "controller", "kinematics"]


def controller() -> dict[str, float]:
    """Return the controller that drives a NAO's joints: speed = gain times (target - perceived angle)."""
    return {"gain_per_s": GAIN, "cycle_s": STEP_S}


def arrays(robot: Robot, observations: Sequence[str]) -> dict[str, AnyArray]:
    """Return the arrays that only NAOs have.

    ``observation_index`` permutes the values of all observations that have rates, followed by these rates, into the
    policy's order.
    """
    features = [name for name in observations if f"{name}_rate" in observations]
    both = [*features, *(f"{name}_rate" for name in features)]
    model, sees = model_of(robot), any(each.name == "vision" for each in robot.perceptors)
    return {
        "robot_type": np.array(model.robot_type),
        "gain": np.array(GAIN),
        "drop_m": np.array(DROP_M),
        "settling_cycles": np.array(SETTLING_CYCLES),
        "observation_index": np.array([both.index(name) for name in observations if name in both]),
        "sees_velocity": np.array("forward_velocity" in observations),
        **kinematics(model),
        **({"onboard_landmarks": np.array([place for _, place in LANDMARKS])} if sees else {}),
    }


def kinematics(model: RobotModel) -> dict[str, Any]:
    """Return the tables that a NAO's centre of mass is computed from.

    ``chain`` has a row per joint, parents first: which joint turns which body against which other, the joint's position
    in the frames of both (``offset`` in the parent's, ``anchor`` in the body's), metres, and its axis.
    """
    place, offsets = model.body_index, np.array([body.offset for body in model.bodies])
    numbers, vectors = ("joint", "body", "parent"), ("offset", "anchor", "axis")
    kinds = [*((name, "i8") for name in numbers), *((name, "f8", 3) for name in vectors)]
    rows = []
    for k, joint in sorted(enumerate(model.joints), key=lambda item: place[item[1].body]):
        body, parent, anchor = place[joint.body], place[joint.parent], np.array(joint.anchor, dtype=np.float64)
        rows.append((k, body, parent, offsets[body] - offsets[parent] + anchor, anchor, joint.axis))
    return {"body_mass": np.array([body.mass for body in model.bodies]), "chain": np.array(rows, dtype=kinds)}
