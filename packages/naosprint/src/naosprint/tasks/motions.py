"""Scripted motions, along which training episodes may start."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np
from naosim.simulator import STEP_S

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from naosim.robots import Robot

    from naosprint.arrays import FloatArray


@dataclass(frozen=True)
class Motion:
    """Target angles, interpolated linearly between keyframes, equal on both sides.

    Attributes:
        times_s: (K,) time of each keyframe after the start of the motion; before the first the robot has the nominal
            pose.
        angles_rad: (K,) angles by the end of a joint's name, of the left side; other joints have their nominal angle.
    """

    times_s: Sequence[float]
    angles_rad: Mapping[str, Sequence[float]]

    def targets(self, robot: Robot) -> FloatArray:
        """Return (T, J) target angles in radians, one row per step, simulator order and signs."""
        times = np.concatenate([[0.0], self.times_s])
        steps = np.arange(round(times[-1] / STEP_S)) * STEP_S
        targets = np.repeat(robot.nominal[None], len(steps), axis=0)
        for index, joint in enumerate(robot.joints):
            for end, angles in self.angles_rad.items():
                if joint.name.removeprefix("left_").removeprefix("right_") == end:
                    frames = np.concatenate([[robot.nominal[index]], joint.sign * np.asarray(angles)])
                    targets[:, index] = np.interp(steps, times, frames)
        return targets


def motions(task: str, robot: str) -> Mapping[str, Motion]:
    """Return the motions of a robot for a task by name; none if nobody has written any."""
    file = resources.files("naosprint.tasks") / "motion_data" / f"{task}-{robot}.json"
    if not file.is_file():
        return {}
    return {name: Motion(**content) for name, content in json.loads(file.read_text()).items()}
