"""Decisions of the example player, in a world in which its robot moves exactly as commanded."""

from __future__ import annotations

import importlib.util
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from naosprint.matches.teams import find_team

if TYPE_CHECKING:
    from pathlib import Path

CYCLE_S = 0.02


@pytest.fixture(scope="module")
def code(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The example player's module, loaded from the folder that is written for a team."""
    folder: Path = tmp_path_factory.mktemp("team")
    find_team("example", folder)
    names = ("runner", "terms")
    sys.path.insert(0, str(folder))
    try:
        found = importlib.util.spec_from_file_location("example_player", folder / "player.py")
        assert found is not None and found.loader is not None
        module = importlib.util.module_from_spec(found)
        found.loader.exec_module(module)
    finally:
        sys.path.remove(str(folder))
        for name in names:
            sys.modules.pop(name, None)
    module.FOLDER = folder
    return module


@pytest.fixture
def player(code: Any) -> Any:
    """A player alone on the field, in play."""
    found = code.Player(code.FOLDER, "A", 2, 1)
    found.mode = found.world.mode = "PlayOn"
    found.world.side = 1.0
    return found


def place(player: Any, robot: tuple[float, float], yaw: float, ball: tuple[float, float], *, seen: bool = True) -> None:
    """Put robot and ball somewhere; a ball that is not seen is remembered there."""
    world = player.world
    world.position, world.yaw, world.now = np.array([*robot, 0.6]), yaw, 100.0
    world.ball, world.velocity, world.ball_at = np.array(ball), np.zeros(2), 100.0 if seen else 0.0


def pass_cycle(player: Any, *, seen: bool = True) -> None:
    """Have the player decide, and move its robot as it commands."""
    world = player.world
    player.cycles += 1
    player.play()
    forward, aside, turn = player.command
    c, s = np.cos(world.yaw), np.sin(world.yaw)
    world.position[:2] += CYCLE_S * np.array([c * forward - s * aside, s * forward + c * aside])
    world.yaw = (world.yaw + CYCLE_S * turn + np.pi) % (2 * np.pi) - np.pi
    world.now += CYCLE_S
    if seen:
        world.ball_at = world.now


def test_a_search_turns_all_the_way_round(player: Any) -> None:
    """Also past the place where the ball was, if it is no longer there."""
    place(player, (20.0, -5.0), 2.8, (0.0, 0.0), seen=False)
    turned = 0.0
    for _ in range(400):
        before = player.world.yaw
        pass_cycle(player, seen=False)
        turned += (player.world.yaw - before + np.pi) % (2 * np.pi) - np.pi
    assert abs(turned) == pytest.approx(16.0, rel=1e-6)


def test_the_striker_comes_to_kick_from_everywhere(code: Any, player: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Within ten seconds and without running into the ball from 3 m around, wherever it faces."""
    kicks: list[tuple[float, float]] = []
    monkeypatch.setattr(player, "change", lambda _skill, after, target: kicks.append(target))
    random = np.random.default_rng(3)
    for _ in range(60):
        ball = (random.uniform(-20.0, 26.5), random.uniform(-12.0, 12.0))
        way, far = random.uniform(-np.pi, np.pi), random.uniform(0.6, 3.0)
        place(player, (ball[0] + far * np.cos(way), ball[1] + far * np.sin(way)), random.uniform(-np.pi, np.pi), ball)
        kicks.clear()
        nearest = far
        for _ in range(round(10.0 / CYCLE_S)):
            pass_cycle(player)
            nearest = min(nearest, np.hypot(*(player.world.position[:2] - ball)))
            if kicks:
                break
        assert kicks, (ball, way, far)
        assert nearest > 0.35, (ball, way, far)
        assert abs(code.wrapped(kicks[0][0] - player.world.yaw)) < code.KICK_AIM


def test_commands_stay_in_the_range_that_the_walker_was_trained_for(player: Any) -> None:
    """Which is that of its training's settings; what is combined is shortened, and keeps its direction."""
    walk = player.walk
    assert (walk.command_low.tolist(), walk.command_high.tolist()) == ([-1.0, -1.0, -2.0], [3.0, 1.0, 2.0])
    player.walk_at(1.0, -0.3, 0.5)
    assert player.command.tolist() == [1.0, -0.3, 0.5]
    player.walk_at(9.0, 0.0, 0.0)
    assert player.command.tolist() == [3.0, 0.0, 0.0]
    player.walk_at(-0.6, 0.8, 0.0)
    assert player.command == pytest.approx([-0.6, 0.8, 0.0])
    player.walk_at(3.0, -1.0, 2.0)
    assert player.command == pytest.approx(np.array([3.0, -1.0, 2.0]) / np.sqrt(3.0))


@pytest.mark.parametrize(
    ("ball", "aim_deg", "distance_m"),
    [
        ((0.0, 0.0), 0.0, 30.5),
        ((24.5, 0.0), 0.0, 6.0),
        # the middle between the posts, not the goal's center
        ((25.0, 4.0), (np.degrees(np.arctan2(-2.17, 2.5)) + np.degrees(np.arctan2(-5.83, 2.5))) / 2, 7.717),
        # nearly on the goal line the ball goes before the goal
        ((26.5, 8.0), np.degrees(np.arctan2(-8.0, -2.5)), np.hypot(8.0, 2.5)),
    ],
)
def test_the_ball_goes_into_the_goal_or_before_it(
    player: Any, ball: tuple[float, float], aim_deg: float, distance_m: float
) -> None:
    place(player, (0.0, 0.0), 0.0, ball)
    assert np.degrees(player.aim()) == pytest.approx(aim_deg, abs=1e-6)
    assert np.hypot(*player.shot()) == pytest.approx(distance_m, abs=1e-3)


def test_a_keeper_keeps_shots_at_its_goal_only(code: Any) -> None:
    """And neither balls that pass the goal, nor those that lie or roll away, nor from beside the goal."""
    keeper = code.Player(code.FOLDER, "A", 1, 3)
    world = keeper.world
    keeper.mode = world.mode = "PlayOn"
    world.side = 1.0
    shots = (
        ((-26.5, 0.0), (-20.0, 1.0), (-4.0, -0.5), True),
        ((-26.5, 0.0), (-20.0, 1.0), (-4.0, 3.0), False),  # passes the goal
        ((-26.5, 0.0), (-20.0, 1.0), (0.0, 0.0), False),
        ((-26.5, 0.0), (-20.0, 1.0), (4.0, 0.0), False),
        ((-20.0, 0.0), (-14.0, 1.0), (-4.0, 0.0), False),
    )
    for robot, ball, velocity, comes in shots:
        place(keeper, robot, 0.0, ball)
        world.velocity = np.array(velocity)
        assert keeper.shot_comes() == comes, (robot, ball, velocity)
    place(keeper, (-26.5, 0.0), 0.0, (-20.0, 1.0))
    world.velocity = np.array((-4.0, 0.0))
    keeper.play()
    assert keeper.active is keeper.keep
    for _ in range(code.CALM_CYCLES - 1):
        world.velocity = np.zeros(2)
        assert not keeper.shot_is_over()
    assert keeper.shot_is_over()


@pytest.mark.parametrize(("far", "goes"), [(0.6, False), (6.0, True)], ids=["taken", "not taken in time"])
def test_who_takes_a_set_piece_does_not_touch_the_ball_next(code: Any, far: float, goes: bool) -> None:
    """A player that was still on its way when the time was over may."""
    player = code.Player(code.FOLDER, "A", 2, 2)
    player.world.side, player.mode, player.world.mode = 1.0, "KickIn_Left", "PlayOn"
    place(player, (5.0 - far, 0.0), 0.0, (5.0, 0.0))
    player.world.robots[True, 1] = (np.array([-26.0, 0.0]), player.world.now)
    player.note_set_piece()
    assert bool(player.is_striker()) == goes


def test_a_ball_that_the_referee_moves_has_no_velocity(code: Any, player: Any) -> None:
    world = player.world
    world.angles, world.position, world.rotation = np.zeros(len(player.joints)), np.array([0.0, 0.0, 0.6]), np.eye(3)
    for meters in (4.0, 3.9, 3.8, 14.0):
        world.now += 2 * CYCLE_S
        world.see(f"(B (pol {meters} 0 -5))")
        if meters == 3.8:
            assert world.velocity[0] < -0.5
    np.testing.assert_array_equal(world.velocity, 0.0)
