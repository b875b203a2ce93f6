"""Matches on real rcssservermj processes, with the example team and with agents that fail."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from naosim.launchers import Address
from naosprint.__main__ import main
from naosprint.matches import game
from naosprint.matches.endpoints import AgentEndpoints
from naosprint.matches.game import GameSettings, Moment, ServerFailedError, TeamFailedError, play_game
from naosprint.matches.log import GameLog
from naosprint.matches.match import play_match
from naosprint.matches.results import match_results
from naosprint.matches.stream import PLAY_MODES, Player
from naosprint.matches.teams import Team, read_team

pytestmark = pytest.mark.timeout(600)  # seconds of play on servers that share a busy machine

FAILING = """
import signal, socket, sys
host, port, team, number, *ending = sys.argv[1:]
def send(text):
    server.sendall(len(text).to_bytes(4, "big") + text.encode())
server = socket.create_connection((host, int(port)))
send(f"(init T1 {team} {number})")
played = 0
while True:
    size = int.from_bytes(server.recv(4, socket.MSG_WAITALL), "big")
    played += b"BeforeKickOff" not in server.recv(size, socket.MSG_WAITALL)
    if number == "2" and played == 50:
        exec(ending[0])
    send("(he1 0 0 20 1 0)")
"""


def test_a_match_of_the_example_team_and_its_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "logs"
    teams = ["example", "example:walk=t1-run-robust"]
    numbers = ["--games", "1", "--players", "1", "--seconds", "3", "--json", "--output", str(folder)]
    assert main(["match", *teams, *numbers]) == 0
    played = capsys.readouterr()
    results = json.loads(played.out)
    assert main(["match", "report", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == results
    log = GameLog.load(folder / "game-001.npz")
    assert log.teams == tuple(teams)
    assert log.sides == [0, 1]
    for half in range(2):
        rows = log.half == half
        assert PLAY_MODES[log.mode[rows][0]] == "KickOff_Left"
        assert PLAY_MODES[log.mode[rows][-1]] == "GameOver"
        assert log.clock_s[rows][-1] == pytest.approx(3.0, abs=0.1)
    # the team with the kick-off has walked to the ball
    walker = 0
    assert log.torso_m[log.half == 0][-1, walker, 0] > log.torso_m[log.half == 0][0, walker, 0] + 0.3
    assert results["means"][0]["cpu_ms"] > 0.0
    assert results["means"][0]["lost_players"] == 0.0


def write_team(folder: Path, program: str, *more: str) -> Path:
    folder.mkdir()
    (folder / "player.py").write_text(program)
    command = ["{python}", "player.py", "{host}", "{port}", "{team}", "{number}", *more]
    (folder / "team.json").write_text(json.dumps({"command": command}))
    return folder


ENTERING = """
import socket, sys
host, port, team, number, *first = sys.argv[1:]
def enter(text):
    server = socket.create_connection((host, int(port)))
    def send(text):
        server.sendall(len(text).to_bytes(4, "big") + text.encode())
    send(text)
    while size := int.from_bytes(server.recv(4, socket.MSG_WAITALL), "big"):
        server.recv(size, socket.MSG_WAITALL)
        send("(syn)")
for player in first or [f"{team} {number}"]:
    try:
        enter(f"(init T1 {player})")
    except ConnectionError:
        pass
"""


def entering(folder: Path, *first: str) -> Team:
    """Return a team whose agents stand, and enter first as other players if some are named."""
    return read_team(write_team(folder, ENTERING, *first))


def test_an_agent_enters_as_its_own_player_alone(tmp_path: Path) -> None:
    """Not in place of an opponent, and not as one more of its team."""
    cheat, honest = entering(tmp_path / "cheat", "right 1", "left 2", "{team} {number}"), entering(tmp_path / "honest")
    (log,) = play_match((cheat, honest), ("a", "b"), 1, GameSettings(players=1, half_s=1.0), tmp_path / "logs")
    assert log.robots == [(0, 1), (1, 1)]
    assert log.present.all() and log.notes["halves"][0]["lost"] == []


def test_a_game_waits_for_slow_players_of_the_team_that_is_started_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its second player enters only when all of the other team are on the field."""
    wait = "if sys.argv[3:5] == ['left', '2']:\n    open('go').close()"
    folder = write_team(tmp_path / "slow", f"import sys\n{wait}\n{ENTERING}")
    teams = read_team(folder), entering(tmp_path / "other")
    go = folder / "go"
    os.mkfifo(go)  # whose ends are opened together: the player's, and this process's

    class Opened(AgentEndpoints):
        def entered(self) -> set[Player]:
            found = super().entered()
            if {("right", 1), ("right", 2)} <= found and go.exists():
                go.open("w").close()
                go.unlink()
            return found

    monkeypatch.setattr(game, "AgentEndpoints", Opened)
    log = play_game(teams, ("a", "b"), 0, GameSettings(players=2, half_s=1.0))
    assert [half["lost"] for half in log.notes["halves"]] == [[], []]
    assert log.present.all()


def test_a_team_that_enters_under_another_name_is_told_what_to_send(tmp_path: Path) -> None:
    team = entering(tmp_path / "misnamed", "red 1")
    with pytest.raises(TeamFailedError, match=r"it began with '\(init T1 red 1\)', not with \(init MODEL left 1\)"):
        play_game((team, team), ("a", "b"), 0, GameSettings(players=1, half_s=1.0))


@pytest.mark.parametrize(("player", "team"), [("left 2", "team A: player 2"), ("red 1", "team 'red' of no agent: ")])
def test_a_robot_that_is_no_agents_ends_the_game(
    player: str, team: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has come past the endpoints, as a program can where the kernel does not keep it from the server's port."""
    words = [sys.executable, "-P", "-c", ENTERING]
    began: list[subprocess.Popen[bytes]] = []

    class Opened(AgentEndpoints):
        def __init__(self, server: Address, players: Mapping[Player, bool]) -> None:
            super().__init__(server, players)
            self._program = [*words, server.host, str(server.agent_port), "", "", player]

        def address(self, player: Player) -> Address:
            if not began:  # not sooner: an agent that enters before the first frame ends the server
                began.append(subprocess.Popen(self._program))
            return super().address(player)

    monkeypatch.setattr(game, "AgentEndpoints", Opened)
    standing = entering(tmp_path / "standing")
    try:
        with pytest.raises(TeamFailedError, match=f"{team}.* entered the field past the endpoints of the agents"):
            play_game((standing, standing), ("a", "b"), 0, GameSettings(players=1, half_s=1.0))
    finally:
        codes = [program.wait(30) for program in began]
    assert codes == [0]


@pytest.mark.parametrize("during", ["entry", "play"])
def test_a_relay_that_is_killed_ends_the_game_and_blames_no_team(
    during: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Opened] = []

    class Opened(AgentEndpoints):
        def __init__(self, server: Address, players: Mapping[Player, bool]) -> None:
            super().__init__(server, players)
            opened.append(self)

        def kill(self) -> None:
            self._process.process.kill()
            self._process.process.wait(30)

        def address(self, player: Player) -> Address:
            if during == "entry":
                self.kill()
            return super().address(player)

    def kill(moment: Moment) -> None:
        if moment.mode != "BeforeKickOff":
            opened[0].kill()

    monkeypatch.setattr(game, "AgentEndpoints", Opened)
    monkeypatch.setattr(game, "_LOOK_S", 0.0)
    standing = entering(tmp_path / "standing")
    settings = GameSettings(players=1, half_s=8.0)
    with pytest.raises(ServerFailedError, match="the relay of the agents ended: exit code -9"):
        play_game((standing, standing), ("a", "b"), 0, settings, on_moment=kill)


@pytest.mark.parametrize(
    ("ending", "reason", "half_s", "look_s"),
    [
        ("raise RuntimeError('the knee is broken')", "the knee is broken", 4.0, game._LOOK_S),
        # the half is over before the next look at the players
        ("signal.pause()", "dropped by the server after 5 s without a message", 2.0, 1e9),
    ],
    ids=["crash", "hang"],
)
def test_an_agent_that_fails_loses_its_player_and_not_the_match(
    ending: str, reason: str, half_s: float, look_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(game, "_LOOK_S", look_s)
    team = read_team(write_team(tmp_path / "failing", FAILING, ending))
    settings = GameSettings(players=2, half_s=half_s)
    (log,) = play_match((team, team), ("a", "a"), 1, settings, tmp_path / "logs")
    results = match_results([log])
    assert results["teams"] == ["a 1", "a 2"]
    assert [means["lost_players"] for means in results["means"]] == [1.0, 1.0]
    half = log.notes["halves"][0]
    assert {each["number"] for each in half["lost"]} == {2}
    assert all(reason in each["reason"] for each in half["lost"])
    assert {"cpu", "memory", "file size", "open files"} <= set(half["enforced"])
    robot = log.robots.index((0, 2))
    assert log.present[0, robot]
    assert not log.present[log.half == 0][-1, robot]


@pytest.mark.parametrize("gone", ["left", "right"])
def test_a_team_that_stays_away_after_half_time_has_no_players_and_ends_no_game(tmp_path: Path, gone: str) -> None:
    """Else a team that is behind could save itself by that."""
    program = f"import sys\nif {gone!r} in sys.argv: raise SystemExit('enough')\n{ENTERING}"
    leaver = read_team(write_team(tmp_path / "leaver", program))
    teams = (leaver, entering(tmp_path / "other"))
    first_left = int(gone == "left")  # so that it comes in the first half
    log = play_game(teams, ("a", "b"), first_left, GameSettings(players=1, half_s=1.0))
    lost = [half["lost"] for half in log.notes["halves"]]
    assert lost[0] == [] and [(each["team"], "enough" in each["reason"]) for each in lost[1]] == [(0, True)]
    second = log.half == 1
    assert log.present[~second].all() and (log.present[second] == [False, True]).all()
    assert log.sides == [first_left, 1]  # alone on the field, the other is on the left
    assert [team["lost_players"] for team in match_results([log])["means"]] == [1.0, 0.0]
    log.save(tmp_path / "game-001.npz")
    assert main(["match", "film", str(tmp_path / "game-001.npz"), "--output", str(tmp_path / "film.mp4")]) == 0


def test_a_team_that_does_not_come_is_named_with_its_words(tmp_path: Path) -> None:
    team = read_team(write_team(tmp_path / "absent", "raise SystemExit('no licence')"))
    with pytest.raises(TeamFailedError, match=r"team A: no player entered the field; player 1: .*no licence"):
        play_match((team, team), ("a", "b"), 1, GameSettings(players=1, half_s=2.0), tmp_path / "logs")


def test_a_known_team_that_does_not_come_has_no_players(tmp_path: Path) -> None:
    absent = read_team(write_team(tmp_path / "absent", "raise SystemExit('no licence')"))
    settings = GameSettings(players=1, half_s=1.0)
    log = play_game((absent, entering(tmp_path / "other")), ("a", "b"), 0, settings, known=True)
    assert not log.present[:, 0].any() and log.present[:, 1].all()
    with pytest.raises(TeamFailedError, match=r"team B: no player entered the field; player 1: .*no licence"):
        play_game((absent, absent), ("a", "b"), 0, settings, known=True)
