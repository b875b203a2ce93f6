"""Fields of the leagues: sizes, lines and goals, in metres; the origin is the middle, goals are at both ends of x."""

from __future__ import annotations

from dataclasses import dataclass

Line = tuple[float, float, float, float]
"""Straight line on the ground: x and y of both ends."""


@dataclass(frozen=True)
class Goal:
    """Goal behind the middle of a goal line.

    Attributes:
        width_m: distance between the posts' centres.
        height_m: height of the crossbar's centre.
        depth_m: distance from the goal line to the back.
        post_radius_m: radius of posts and bars.
    """

    width_m: float
    height_m: float
    depth_m: float
    post_radius_m: float


@dataclass(frozen=True)
class Field:
    """Field of a league.

    Attributes:
        name: server that has it.
        length_m, width_m: distance between goal lines, between touch lines.
        border_m: width of the ground around it on which robots are put down.
        line_width_m: width of a line.
        circle_radius_m: radius of the circle in the middle.
        areas_m: depth and width of each area before a goal.
        penalty_spot_m: distance of the penalty spot from the goal line; 0 without one.
        goal: the goals.
        ball_radius_m: radius of the league's ball.
    """

    name: str
    length_m: float
    width_m: float
    border_m: float
    line_width_m: float
    circle_radius_m: float
    areas_m: tuple[tuple[float, float], ...]
    penalty_spot_m: float
    goal: Goal
    ball_radius_m: float

    def lines(self) -> tuple[Line, ...]:
        """Return the straight lines."""
        x, y = self.length_m / 2, self.width_m / 2
        found = [(-x, y, x, y), (-x, -y, x, -y), (-x, -y, -x, y), (x, -y, x, y), (0.0, -y, 0.0, y)]
        for depth, width in self.areas_m:
            for end in (-x, x):
                front, side = end - depth if end > 0 else end + depth, width / 2
                found.append((front, -side, front, side))
                found += [(min(front, end), s, max(front, end), s) for s in (-side, side)]
        return tuple(found)


RCSSSERVER3D = Field(
    name="rcssserver3d",
    length_m=30.0,
    width_m=20.0,
    border_m=0.0,
    line_width_m=0.05,
    circle_radius_m=2.0,
    areas_m=((1.8, 6.0),),
    penalty_spot_m=0.0,
    goal=Goal(width_m=2.1, height_m=0.8, depth_m=0.6, post_radius_m=0.03),
    ball_radius_m=0.042,
)
"""Field of the NAO."""

RCSSSERVERMJ = Field(
    name="rcssservermj",
    length_m=55.0,
    width_m=36.0,
    border_m=3.0,
    line_width_m=0.1,
    circle_radius_m=5.5,
    areas_m=((4.0, 7.3), (9.0, 16.5)),
    penalty_spot_m=7.32,
    goal=Goal(width_m=3.66, height_m=1.83, depth_m=1.0, post_radius_m=0.05),
    ball_radius_m=0.11,
)
"""Field of the T1 and the K1: the ``fifa7vs7`` field of its rule books ``ssim`` and ``ssim26``."""
