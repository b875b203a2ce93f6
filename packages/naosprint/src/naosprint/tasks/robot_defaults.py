"""What tasks use of a robot unless their settings differ: its observations, and the heights below which it has fallen.

A robot has those of its family. A package that adds a family, or a robot that needs others, offers a function from
:class:`~naosim.robots.Robot` to :class:`RobotDefaults` under the robot's or the family's name::

    [project.entry-points."naosprint.robots"]
    walker = "my_walker:defaults"
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from naospec import plugins

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from naosim.robots import Robot


@dataclass(frozen=True)
class RobotDefaults:
    """Observations of a robot and heights of its falls."""

    observations: tuple[str, ...]
    """Names of the observation blocks of its policies, in order."""
    fall_height_m: float
    """Torso height below which an episode counts as a fall."""
    erect_height_m: float
    """The same for tasks that require an upright run."""
    privileged: tuple[str, ...] = ()
    """Names of the blocks that only critics observe, because the robot does not perceive them."""
    knows_position: bool = True
    """Whether the robot is told where it is; tasks with a ball need that."""
    foot_line_m: float = 0.1
    """Distance of a foot's line from the robot's, metres: a ball that is to be kicked lies on it."""
    motions: str | None = None
    """Name of its scripted motions in ``naosprint/tasks/motion_data``; None without any."""


_NAO: tuple[str, ...] = (
    *("step", "joint_angles", "yaw", "height", "centre_of_mass", "gyro", "accel"),
    *("left_foot_origin", "left_foot_force", "right_foot_origin", "right_foot_force", "foot_counters"),
)
_BOOSTER = ("gravity", "gyro", "velocity", "height", "heading", "joint_angles", "joint_speeds", "last_action")
_BOOSTER_WORLD = ("velocity", "height")  # from the position that only a simulator knows
_BOOSTER_HEIGHTS_M = {"T1": (0.45, 0.57), "K1": (0.37, 0.47)}
_BOOSTER_FOOT_LINES_M = {"T1": 0.106, "K1": 0.096}


def _nao(robot: Robot) -> RobotDefaults:
    """Return the paper's observations and heights; an onboard robot estimates its yaw and height.

    Only critics and teachers are told these and its velocity then.
    """
    names = _NAO
    onboard = bool(getattr(robot.parameters, "onboard_sensing", False))
    if onboard:
        names = tuple("onboard_pose" if name == "yaw" else name for name in _NAO if name != "height")
    if getattr(robot.parameters, "ground_velocity", False):
        names = (*names, "ground_velocity")
    hidden = ("told_pose", "ground_velocity") if onboard else ()
    return RobotDefaults(names, 0.27, 0.33, hidden, knows_position=not onboard)


def _booster(robot: Robot) -> RobotDefaults:
    """Return what T1 and K1 perceive, and heights and motions of the robot's model."""
    model = robot.data["model"]
    onboard = bool(getattr(robot.parameters, "onboard_sensing", False))
    hidden = _BOOSTER_WORLD if onboard else ()
    perceived = tuple(name for name in _BOOSTER if name not in hidden)
    return RobotDefaults(
        perceived,
        *_BOOSTER_HEIGHTS_M[model],
        hidden,
        knows_position=not onboard,
        foot_line_m=_BOOSTER_FOOT_LINES_M[model],
        motions=model.lower(),
    )


_FAMILIES: Mapping[str, Callable[[Robot], RobotDefaults]] = {"nao": _nao, "booster": _booster}


def robot_defaults(robot: Robot) -> RobotDefaults:
    """Return what tasks use of this robot: by its own name, else by its family's.

    Raises:
        naospec.plugins.BrokenPluginError: if a package offers something else.
        ValueError: if there are none.
    """
    offered = plugins.names(plugins.ROBOT_DEFAULTS)
    name = next((name for name in (robot.name, robot.family) if name in offered), None)
    find = _FAMILIES.get(robot.family) if name is None else plugins.load(plugins.ROBOT_DEFAULTS, name)
    if find is None:
        raise ValueError(
            f"robot: no package states observations and fall heights of {robot.name}; offer them as {robot.name!r} or "
            f"{robot.family!r} in the entry-point group {plugins.ROBOT_DEFAULTS}"
        )
    defaults = find(robot)
    if not isinstance(defaults, RobotDefaults):
        raise plugins.BrokenPluginError(f"{name}: the entry point must return naosprint.tasks.RobotDefaults")
    return defaults
