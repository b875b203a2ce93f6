"""Messages with which one agent would end, stop or change a match on a real rcssservermj."""

from __future__ import annotations

import json
import socket
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from naosim.launchers import Address
from naosprint.matches import game
from naosprint.matches.endpoints import AgentEndpoints
from naosprint.matches.game import GameSettings, Moment, ServerFailedError, play_game
from naosprint.matches.stream import Player
from naosprint.matches.teams import Team, read_team

pytestmark = pytest.mark.timeout(600)  # seconds of play on a server that shares a busy machine

STANDING = """
import json, socket, sys
host, port, team, number = sys.argv[1:]
server = socket.create_connection((host, int(port)))
def send(text):
    server.sendall(len(text).to_bytes(4, "big") + text.encode())
send(f"(init T1 {team} {number})")
when, wrong = json.load(open("wrong.json")).get(team, (None, None))
received = played = 0
while size := int.from_bytes(server.recv(4, socket.MSG_WAITALL), "big"):
    played += b"BeforeKickOff" not in server.recv(size, socket.MSG_WAITALL)
    received += 1
    send("(beam -7 3 0)" if received == 5 else "(syn)")
    if when == "in play" and played == 10 or when == "before" and received == 60:
        when = None
        server.sendall(wrong.to_bytes(4, "big")) if isinstance(wrong, int) else send(wrong)
"""
SETTINGS = GameSettings(players=1, half_s=1.0)


def standing(folder: Path, **wrong: tuple[str, str | int]) -> Team:
    """Return a team whose robot stands on the field and sends on each side one message, or only its length."""
    folder.mkdir()
    (folder / "player.py").write_text(STANDING)
    (folder / "wrong.json").write_text(json.dumps(wrong))
    command = ["{python}", "player.py", "{host}", "{port}", "{team}", "{number}"]
    (folder / "team.json").write_text(json.dumps({"command": command}))
    return read_team(folder)


@pytest.mark.parametrize(
    ("wrong", "reasons"),
    [
        (
            {"left": ("in play", "(lle3 0 0 nan 1 0)"), "right": ("before", "(beam nan nan nan)")},
            ["numbers are finite and at most 1e+09, not in 'lle3 0 0 nan 1 0'", "not in 'beam nan nan nan'"],
        ),
        (
            {"left": ("before", 2**31 - 1), "right": ("in play", "(xyz 0 0 0 0 0)")},
            ["a message of 2147483647 bytes; the most are 16384", "the robot has no joint 'xyz'"],
        ),
    ],
    ids=["numbers", "length and effector"],
)
def test_a_message_loses_its_player_and_changes_nothing_else(
    wrong: Mapping[str, tuple[str, str | int]], reasons: list[str], tmp_path: Path
) -> None:
    log = play_game((standing(tmp_path / "wrong", **wrong), standing(tmp_path / "other")), ("a", "b"), 0, SETTINGS)
    other = log.robots.index((1, 1))
    for number, (half, reason) in enumerate(zip(log.notes["halves"], reasons, strict=True)):
        (lost,) = half["lost"]
        assert (lost["team"], lost["number"]) == (0, 1)
        assert lost["reason"].startswith("its endpoint closed the connection: ") and lost["reason"].endswith(reason)
        assert 0.0 <= lost["clock_s"] <= SETTINGS.half_s
        rows = log.half == number
        assert log.clock_s[rows][-1] == pytest.approx(SETTINGS.half_s, abs=0.1)
        assert not log.present[rows][-1, 1 - other] and log.present[rows][:, other].all()
        assert np.abs(np.abs(log.torso_m[rows][:, other, :2]) - (7.0, 3.0)).max() < 1.0, "where it has been beamed to"


def test_a_simulation_that_starts_again_ends_the_half(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As MuJoCo does where a position is not finite, here that of the ball."""
    monitors: list[tuple[str, int]] = []

    class Opened(AgentEndpoints):
        def __init__(self, server: Address, players: Mapping[Player, bool]) -> None:
            super().__init__(server, players)
            monitors.append((server.host, server.monitor_port))

    def place(_: Moment) -> None:
        with socket.create_connection(monitors[0]) as monitor:
            text = b"(ball (pos nan nan nan))"
            monitor.sendall(len(text).to_bytes(4, "big") + text)

    monkeypatch.setattr(game, "AgentEndpoints", Opened)
    teams = standing(tmp_path / "a"), standing(tmp_path / "b")
    with pytest.raises(ServerFailedError, match="the server's simulation started again: its time is 0"):
        play_game(teams, ("a", "b"), 0, SETTINGS, on_moment=place)
