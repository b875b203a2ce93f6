"""Messages of agents, which the server gets whole and once they have been checked."""

from __future__ import annotations

import math
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import rcsssmj
from naosim import robots
from naosprint.matches import relay
from naosprint.matches.relay import EFFECTORS, MOST_AHEAD, MOST_MESSAGE_BYTES, REFUSAL, RefusalError, check, messages
from rcsssmj.games.soccer.server.soccer_action_parser import SoccerActionParser

T1 = EFFECTORS["T1"]
LEFT = (("left", "1"), ("left", "2"))
TEXTS = [b"(syn)", b"", b"(he1 0 0 20 1 0)" * 30]


def framed(*texts: bytes) -> bytes:
    return b"".join(len(text).to_bytes(4, "big") + text for text in texts)


@pytest.mark.parametrize("size", [1, 3, 4, 5, 64, 1000])
def test_messages_are_whole_however_they_are_split(size: int) -> None:
    data = framed(*TEXTS)
    assert list(messages(data[i : i + size] for i in range(0, len(data), size))) == TEXTS


def test_a_message_without_its_end_is_none() -> None:
    assert list(messages([framed(b"(syn)", b"(syn)")[:-1]])) == [b"(syn)"]


def test_a_length_is_refused_before_its_message_comes() -> None:
    most = b"x" * MOST_MESSAGE_BYTES
    found = messages([framed(most), (2**31 - 1).to_bytes(4, "big")], MOST_MESSAGE_BYTES)
    assert next(found) == most
    with pytest.raises(RefusalError, match="a message of 2147483647 bytes; the most are 16384"):
        next(found)
    with pytest.raises(RefusalError):
        next(messages([framed(most + b"x")[:4]], MOST_MESSAGE_BYTES))


WRONG = [
    "nan",
    "NaN",
    "-nan",
    "+NAN",
    "inf",
    "-Infinity",
    "1e999",
    "-1E+400",
    "9" * 400,
    "1_0e9_99",
    "nan\n",
    "\tinf",
    "1e11",
]
ACTIONS = {"(he1 {} {} {} {} {})": 5, "(beam {} {} {})": 3, "(SPK say {} TWVzc2FnZQ==)": 1}


@pytest.mark.parametrize("number", WRONG)
def test_a_number_that_the_simulation_does_not_survive_is_refused_in_each_position(number: str) -> None:
    for action, count in ACTIONS.items():
        for position in range(count):
            words = ["0"] * count
            words[position] = number
            text = f"(syn)(lle3 1 2 3 4 5){action.format(*words)}".encode()
            assert len(SoccerActionParser().parse_action(text, "")) == 2, "the server accepts it"
            with pytest.raises(RefusalError, match=r"numbers are finite and at most 1e\+09, not in '(he1|beam|SPK) "):
                check(text, T1)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "(syn)",
        "(he1 -1.5 +.5 1_000 1e3 0)(te1  0 0 0 0 0)(beam -9 0.1 180)",
        "(SPK say 100 Infinity)(SPK say 100 1e999999)",
        "(init T1 nan 1)(team Nan United)",
        "(syn nan nan nan nan nan)",
        "(he1 0 0 0 0 \N{FULLWIDTH DIGIT ONE})(he1 0 0 0 0 x)(he1 0 0 0 0)(beam nan nan)",
        "()(((((nothing",
    ],
)
def test_what_is_not_a_number_to_the_server_passes(text: str) -> None:
    check(text.encode(), T1)
    for action in SoccerActionParser().parse_action(text.encode(), ""):
        numbers = [value for value in vars(action).values() if isinstance(value, float)]
        assert all(math.isfinite(number) for number in numbers)


@pytest.mark.parametrize("name", ["xyz", "he3", "te1", "beam", "he1\t", "\N{SNOWMAN}"])
def test_an_effector_that_the_robot_does_not_have_is_refused(name: str) -> None:
    """The server's simulation ends at it."""
    text = f"(he1 0 0 0 0 0)({name} 0 0 0 0 0)".encode()
    with pytest.raises(RefusalError, match="the robot has no joint"):
        check(text, EFFECTORS["K1"])
    check(text, frozenset())


def test_the_effectors_are_those_of_the_servers_robots() -> None:
    for model in ("T1", "K1"):
        assert {joint.effector.encode() for joint in robots.get(model.lower()).joints} == EFFECTORS[model]
    for folder in (Path(rcsssmj.__file__).parent / "resources" / "robots").iterdir():
        if (folder / "robot.xml").exists():
            text = (folder / "robot.xml").read_text(encoding="utf-8")
            assert {name.encode() for name in re.findall(r'name="(\w+)_tau"', text)} == EFFECTORS[folder.name]


@pytest.fixture
def player(tmp_path: Path) -> Iterator[tuple[socket.socket, socket.socket]]:
    """The agent's and the server's side of the endpoint of left 1, once it has entered."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(30)
        command = [sys.executable, "-I", "-S", relay.__file__, f"tcp:127.0.0.1:{listener.getsockname()[1]}"]
        with subprocess.Popen(
            [*command, "tcp:127.0.0.1:0", "left", "1"], stdout=subprocess.PIPE, cwd=tmp_path
        ) as process:
            assert process.stdout is not None
            port = int(process.stdout.readline().split()[-1])
            with socket.create_connection(("127.0.0.1", port), 30) as agent:
                agent.sendall(framed(b"(init T1 left 1)"))
                server, _ = listener.accept()
                with server:
                    agent.settimeout(None)
                    assert server.recv(20, socket.MSG_WAITALL) == framed(b"(init T1 left 1)")
                    yield agent, server
            process.kill()


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ((2**31 - 1).to_bytes(4, "big"), "a message of 2147483647 bytes; the most are 16384"),
        (framed(b"(lle3 0 0 nan 1 0)"), "numbers are finite and at most 1e+09, not in 'lle3 0 0 nan 1 0'"),
        (framed(b"(xyz 0 0 0 0 0)"), "the robot has no joint 'xyz'"),
    ],
    ids=["length", "number", "effector"],
)
def test_the_server_gets_nothing_of_a_message_that_is_refused(
    wrong: bytes, reason: str, player: tuple[socket.socket, socket.socket], tmp_path: Path
) -> None:
    agent, server = player
    agent.sendall(framed(b"(syn)") + wrong + framed(b"(syn)"))
    assert server.recv(100, socket.MSG_WAITALL) == framed(b"(syn)")
    assert (tmp_path / REFUSAL.format("left", 1)).read_text(encoding="ascii") == reason


def test_an_agent_is_closed_that_sends_without_waiting_for_the_server(
    player: tuple[socket.socket, socket.socket], tmp_path: Path
) -> None:
    agent, server = player
    for _ in range(2):  # as many as it gets, it may send again
        agent.sendall(framed(b"(syn)") * MOST_AHEAD)
        assert server.recv(9 * MOST_AHEAD, socket.MSG_WAITALL) == framed(b"(syn)") * MOST_AHEAD
        server.sendall(framed(b"(time)") * MOST_AHEAD)
        assert agent.recv(10 * MOST_AHEAD, socket.MSG_WAITALL) == framed(b"(time)") * MOST_AHEAD
    agent.sendall(framed(b"(syn)") * (MOST_AHEAD + 1))
    assert server.recv(10 * MOST_AHEAD, socket.MSG_WAITALL) == framed(b"(syn)") * MOST_AHEAD
    reason = (tmp_path / REFUSAL.format("left", 1)).read_text(encoding="ascii")
    assert reason == "more than 250 messages before their cycles; send one a cycle"


def test_the_game_waits_only_so_long_for_a_team_in_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From each message of the server to the next of an agent; what it sends early, or with others, costs nothing more.

    Agents that delay the game one after another are closed one after another, and not those of the other team.
    """
    monkeypatch.chdir(tmp_path)
    now_s = 100.0
    monkeypatch.setattr(relay.time, "monotonic", lambda: now_s)
    text, waits = framed(b"(syn)"), {"left": relay._Team(), "right": relay._Team()}
    players = [relay._Player("T1", team, number, waits[team]) for team, number in (*LEFT, ("right", "1"))]
    asked = [player.received(iter(lambda: framed(b"(time)"), None)) for player in players]
    answered = [player.sent(iter(lambda: text, None)) for player in players]
    for each in answered:
        next(each)
        now_s += 2.0 * relay.MOST_WAIT_S  # nothing is asked
        assert next(each) == text
    for late in range(2):
        for each in asked:
            next(each)
            next(each)
        assert next(answered[1 - late]) == text
        now_s += relay.MOST_WAIT_S / 2.0
        assert [next(answered[each]) for each in (late, 2)] == [text, text]
    for each in asked:
        next(each)
    assert next(answered[2]) == text
    now_s += 0.1
    assert [next(each, None) for each in answered[:2]] == [None, None]
    for team, number in LEFT:
        reason = Path(REFUSAL.format(team, number)).read_text(encoding="ascii")
        assert reason == "the game has waited 1800 s for its team; answer sooner"
    assert not Path(REFUSAL.format("right", "1")).exists()


def test_an_agent_is_closed_that_does_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The server would wait for it, and all others with it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(relay, "_UNREAD_S", 1)
    agent, client = socket.socketpair()
    with agent, socket.create_server(("127.0.0.1", 0)) as listener:
        target = f"tcp:127.0.0.1:{listener.getsockname()[1]}"
        thread = threading.Thread(
            target=relay._pass, args=(client, target, relay._Player("T1", "left", "1", relay._Team()))
        )
        thread.start()
        server, _ = listener.accept()
        with server, pytest.raises(ConnectionError):
            while True:
                server.sendall(framed(b"(time)") * 1000)
        thread.join()
    assert Path(REFUSAL.format("left", 1)).read_text(encoding="ascii") == "it has not read for 1 s what waits for it"
