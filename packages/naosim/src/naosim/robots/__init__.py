"""Robots, found by name among the entry points of the group ``naosim.robots``."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from naosim.robots.description import (
    JointDescription,
    PerceptorDescription,
    Robot,
    RobotParameters,
    Shape,
    Side,
)

if TYPE_CHECKING:
    from naospec import Section

__all__ = [
    "JointDescription",
    "PerceptorDescription",
    "Robot",
    "RobotParameters",
    "Shape",
    "Side",
    "configured",
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

    return cast("Robot", plugins.load(plugins.ROBOTS, name))


def configured(section: Section) -> Robot:
    """Return the robot that a specification's section names, with its settings."""
    return get(section.name).with_parameters(section.model_dump())
