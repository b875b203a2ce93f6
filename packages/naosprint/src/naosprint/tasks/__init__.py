"""Tasks: what robots learn. Importing this package loads no PyTorch, so API and command line can describe tasks.

Every part of the bundled tasks can be imported from here: settings to inherit from, measurements, reward terms,
observation blocks, starts and random numbers; expressions are in :mod:`naosprint.terms`.
"""

from __future__ import annotations

from naospec import TaskSettings
from naospec.metrics import Chart, FieldLine, Metric, Presentation, Reference, Result, ResultTable

from naosprint.tasks.base import End, RewardTerm, Task, get, names, seconds
from naosprint.tasks.disturbance_settings import BallNoiseSettings, DisturbanceSettings
from naosprint.tasks.episodes import Episodes, Statistics
from naosprint.tasks.falls import FALL, FALL_RATE, FallSettings, with_min_height
from naosprint.tasks.measurements import Below, Beyond, Deviation, Displacement, Measurement, StoredNumbers
from naosprint.tasks.motions import Motion, motions
from naosprint.tasks.observations import ObservationBlock, blocks
from naosprint.tasks.penalties import PenaltySettings, penalties
from naosprint.tasks.robot_defaults import RobotDefaults, robot_defaults
from naosprint.tasks.starts import draw_start_poses
from naosprint.tasks.world import World
from naosprint.terms.randomness import normal, uniform

__all__ = [
    "FALL",
    "FALL_RATE",
    "BallNoiseSettings",
    "Below",
    "Beyond",
    "Chart",
    "Deviation",
    "Displacement",
    "DisturbanceSettings",
    "End",
    "Episodes",
    "FallSettings",
    "FieldLine",
    "Measurement",
    "Metric",
    "Motion",
    "ObservationBlock",
    "PenaltySettings",
    "Presentation",
    "Reference",
    "Result",
    "ResultTable",
    "RewardTerm",
    "RobotDefaults",
    "Statistics",
    "StoredNumbers",
    "Task",
    "TaskSettings",
    "World",
    "blocks",
    "draw_start_poses",
    "get",
    "motions",
    "names",
    "normal",
    "penalties",
    "robot_defaults",
    "seconds",
    "uniform",
    "with_min_height",
]
