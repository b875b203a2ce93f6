"""Fields are those of the servers, and every robot is on its league's."""

from __future__ import annotations

import numpy as np
import pytest
from naosim import robots
from naosim.fields import RCSSSERVER3D, RCSSSERVERMJ, Field
from naosim.simspark import protocol


@pytest.mark.parametrize("name", robots.names())
def test_robots_are_on_the_field_of_their_league(name: str) -> None:
    robot = robots.get(name)
    assert robot.field is (RCSSSERVER3D if robot.family == "nao" else RCSSSERVERMJ)


def test_the_booster_field_is_the_one_of_the_server() -> None:
    soccer_fields = pytest.importorskip("rcsssmj.games.soccer.soccer_fields")
    theirs = soccer_fields.create_soccer_field("fifa7vs7")
    ours = RCSSSERVERMJ
    assert (ours.length_m, ours.width_m) == theirs.field_dim[:2]
    assert (ours.goal.depth_m, ours.goal.width_m, ours.goal.height_m) == theirs.goal_dim
    assert ours.goal.post_radius_m == theirs.goal_post_radius
    assert ours.areas_m == (theirs.goalie_area_dim, theirs.penalty_area_dim)
    assert (ours.border_m, ours.line_width_m) == (theirs.field_border, theirs.line_width)
    assert (ours.penalty_spot_m, ours.circle_radius_m) == (theirs.penalty_spot_distance, theirs.center_circle_radius)


@pytest.mark.parametrize("field", [RCSSSERVER3D, RCSSSERVERMJ], ids=lambda field: field.name)
def test_lines_are_symmetric_and_on_the_field(field: Field) -> None:
    lines = np.array(field.lines())
    assert len(lines) == 5 + 6 * len(field.areas_m)
    assert (np.abs(lines[:, [0, 2]]) <= field.length_m / 2).all() and (
        np.abs(lines[:, [1, 3]]) <= field.width_m / 2
    ).all()
    assert (lines[:, :2] <= lines[:, 2:]).all(), "from the lower end to the higher"
    found = {tuple(line) for line in (lines + 0.0).tolist()}
    turned = {tuple(line) for line in (-lines[:, [2, 3, 0, 1]] + 0.0).tolist()}
    assert found == turned


def test_players_of_the_nao_see_these_lines() -> None:
    lines = {tuple(sorted([(a, b), (c, d)])) for a, b, _, c, d, _ in protocol.LINES.tolist()}
    assert {tuple(sorted([(a, b), (c, d)])) for a, b, c, d in RCSSSERVER3D.lines()} <= lines
