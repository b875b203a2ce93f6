"""Scripted motions, along which training episodes may start."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np
from naosim.simulator import STEP_S

from naosprint.tasks.robot_defaults import robot_defaults

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from naosim.robots import Robot

    from naosprint.arrays import FloatArray


@dataclass(frozen=True)
class Motion:
    """Target angles, interpolated linearly between keyframes.

    Attributes:
        times_s: (K,) time of each keyframe after the start of the motion; before the first the robot has the nominal
            pose.
        angles_rad: (K,) angles by the name of a joint, or by its name without ``left_`` or ``right_`` if both sides
            move alike; with the left side's signs. Other joints have their nominal angle.
    """

    times_s: Sequence[float]
    angles_rad: Mapping[str, Sequence[float]]

    def targets(self, robot: Robot) -> FloatArray:
        """Return (T, J) target angles in radians, one row per step, simulator order and signs."""
        times = np.concatenate([[0.0], self.times_s])
        steps = np.arange(round(times[-1] / STEP_S)) * STEP_S
        targets = np.repeat(robot.nominal[None], len(steps), axis=0)
        for index, joint in enumerate(robot.joints):
            alike = joint.name.removeprefix("left_").removeprefix("right_")
            angles = self.angles_rad.get(joint.name, self.angles_rad.get(alike))
            if angles is not None:
                frames = np.concatenate([[robot.nominal[index]], joint.sign * np.asarray(angles)])
                targets[:, index] = np.interp(steps, times, frames)
        return targets

    def mirrored(self, robot: Robot) -> Motion:
        """Return the motion with left and right exchanged."""
        exchanged = {"left": "right", "right": "left"}
        signs = {joint.name: joint.mirror_sign for joint in robot.joints}
        angles = {}
        for name, values in self.angles_rad.items():
            side, _, end = name.partition("_")
            partner = f"{exchanged[side]}_{end}" if side in exchanged else name
            angles[partner] = [signs.get(name, 1.0) * value for value in values]
        return Motion(self.times_s, angles)


def motions(task: str, robot: Robot) -> Mapping[str, Motion]:
    """Return the motions of a robot for a task by name: those of its :class:`RobotDefaults`, or none."""
    try:
        name = robot_defaults(robot).motions
    except ValueError:
        return {}
    file = resources.files("naosprint.tasks") / "motion_data" / f"{task}-{name}.json"
    if not file.is_file():
        return {}
    return {name: Motion(**content) for name, content in json.loads(file.read_text(encoding="utf-8")).items()}
