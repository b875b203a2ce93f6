from __future__ import annotations

import socket

import pytest
from naosim import cli
from naosim.simspark.protocol import ProtocolError
from naosim.simspark.server import ServerSettings
from naosim.simspark.server_game import TEAM_SIZE, Ball, Game
from naosim.simspark.server_robot import ServerRobot


def test_players_get_free_numbers_and_places_of_their_own() -> None:
    game, places = Game(), set()
    for k in range(1, TEAM_SIZE + 1):
        assert game.join("A", 0) == (1, k)
        (x, y, z), yaw = game.entry(1)
        places.add((x, y))
        assert -15 < x < 0
        assert -10 < y < 10
        assert (z, yaw) == (0.4, -90)
    assert len(places) == TEAM_SIZE
    with pytest.raises(ProtocolError, match="number 0 of team A is not available"):
        game.join("A", 0)
    game.leave(1, 4)
    assert game.join("A", 4) == (1, 4)
    assert game.join("B", 7) == (2, 7)
    assert game.entry(2)[1] == 90
    for team, number, reason in (
        ("B", 7, "number 7"),
        ("C", 1, "two teams"),
        ("B", 12, "number 12"),
        ("\xe9", 1, "ASCII"),
    ):
        with pytest.raises(ProtocolError, match=reason):
            game.join(team, number)


def test_a_ball_falls_bounces_and_comes_to_rest() -> None:
    ball = Ball()
    ball.position, ball.velocity = (0.0, 0.0, 2.0), (1.0, 0.0, 0.0)
    heights = []
    for _ in range(2000):
        ball.step()
        heights.append(ball.position[2])
    assert min(heights) >= 0.042
    assert max(heights[40:]) > 0.5, "it bounces"
    assert ball.velocity == (0.0, 0.0, 0.0)
    assert 0.5 < ball.position[0] < 3.0


def test_hearing_takes_every_other_cycle() -> None:
    robot = ServerRobot(0, digits=2, seed=1, noise=False)
    robot.join("A", 1, 1)
    heard = []
    for k in range(8):
        robot.hear("mate", "A", "12.00", f"m{k}")
        heard.append(b"(hear A 0.00 12.00 m" in robot.cycle((0, 0, 0), "BeforeKickOff", (0, 0)))
    assert sum(heard) == 4


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"agent_port": -1}, "agent_port"),
        ({"monitor_port": 70000}, "monitor_port"),
        ({"agent_port": 3100, "monitor_port": 3100}, "monitor_port"),
        ({"digits": 4}, "digits"),
        ({"max_agents": 0}, "max_agents"),
    ],
)
def test_bad_settings_are_named(arguments: dict[str, int], field: str) -> None:
    with pytest.raises(ValueError, match=f"^{field}: "):
        ServerSettings(**arguments)  # type: ignore[arg-type]


def test_the_command_line_tells_what_is_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["serve", "--agent-port", "99999"]) == 2
    assert "agent_port: must be from 0 to 65535, not 99999" in capsys.readouterr().err
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert cli.main(["serve", "--agent-port", "0", "--server-port", str(port), "--quiet"]) == 1
    assert f"127.0.0.1, ports 0, {port}: " in capsys.readouterr().err
