"""Robots, found by name among the entry points of the group ``naosim.robots``."""

from __future__ import annotations

from naosim.robots.description import (
    JointDescription,
    PerceptorDescription,
    Robot,
    RobotParameters,
    Shape,
    Side,
)

__all__ = [
    "JointDescription",
    "PerceptorDescription",
    "Robot",
    "RobotParameters",
    "Shape",
    "Side",
    "get",
    "names",
]


def names() -> tuple[str, ...]:
    """Return the names of all robots that installed packages offer, sorted."""
    from naospec import plugins

    return plugins.names(plugins.ROBOTS)


def get(name: str) -> Robot:
    """Return the robot of this name.

    Raises:
        naospec.plugins.UnknownPluginError: if no package offers it; the message lists the available ones.
        naospec.plugins.BrokenPluginError: if it cannot be loaded, or is not a Robot of that name.
    """
    from naospec import plugins

    robot: Robot = plugins.load(plugins.ROBOTS, name)
    return robot
