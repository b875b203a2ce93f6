from __future__ import annotations

import logging
import re
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naosim.robots import nao_model
from naosim.simspark import _core, protocol
from naosim.simspark.server import Server

from .wire import Player, Wire, senses, serving


def torso(monitor: Wire, scene: _core.SceneReader, number: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Read one frame; return where a robot of the left team is."""
    scene.read(monitor.receive().encode())
    position, rotation = np.empty(3), np.empty((3, 3))
    assert scene.torso(1, number, position, rotation)
    return position, rotation


def step_until_at(
    place: tuple[float, float], player: Player, monitor: Wire, scene: _core.SceneReader, number: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Step until a robot is where a trainer has put it; a trainer's command may arrive some cycles later."""
    for _ in range(100):
        player.step()
        position, rotation = torso(monitor, scene, number)
        if np.allclose(position[:2], place, atol=0.1):
            return position, rotation
    raise AssertionError(f"the robot is at {position}, not at {place}")


@pytest.mark.parametrize("robot_type", nao_model.ROBOT_TYPES)
def test_a_league_agent_is_answered_as_it_expects(server: Server, robot_type: int) -> None:
    player = Player(server.agent_port, "Nao", 7, robot_type)
    assert "(GS (unum 7) (team left) (sl 0) (sr 0) (t 0.00) (pm BeforeKickOff))" in "".join(player.greeting)
    model = nao_model.model(robot_type)
    zero = "".join(f"({joint.effector} 0.00000)" for joint in model.joints)
    seen = []
    for _ in range(60):
        message = player.step(zero)
        assert len(message) + 4 <= protocol.MAX_MESSAGE
        assert "((" not in message
        assert "()" not in message
        assert not re.search(r"\d[eE][-+]?\d|\+", message), "plain decimals only"
        found = senses(message)
        assert [tag[3:] for tag in found if tag.startswith("HJ")] == [
            name for kind, name, _ in protocol.percept_order(model) if kind == "j"
        ]
        assert re.fullmatch(r"\(now \d+\.\d\d\)", found["time"][0])
        assert re.fullmatch(r"\(n torso\) \(rt( -?\d+\.\d\d){3}\)", found["GYR torso"][0])
        assert re.fullmatch(r"\(n torso\) \(a( -?\d+\.\d\d){3}\)", found["ACC torso"][0])
        seen.append("See" in found)
    assert sum(seen) == 20
    assert seen[seen.index(True) :: 3] == [True] * len(seen[seen.index(True) :: 3]), "every third cycle"
    assert re.fullmatch(r"\(n lf\) \(c( -?\d+\.\d\d){3}\) \(f( -?\d+\.\d\d){3}\)", found["FRP lf"][0])
    assert ("FRP lf1" in found) == (robot_type == 4) or robot_type == 4
    assert message.index("(time") < message.index("(GS") < message.index("(GYR") < message.index("(ACC")
    player.close()


@pytest.mark.parametrize("at_once", [2, 3])
def test_messages_that_arrive_together_are_all_answered_and_so_is_the_next(server: Server, at_once: int) -> None:
    """A client that sends again before it was answered does not block the server."""
    player = Player(server.agent_port)
    player.socket.sendall(b"".join(protocol.frame(b"(syn)") for _ in range(at_once)))
    times = [senses(player.receive())["time"][0] for _ in range(at_once)]
    times.append(senses(player.step())["time"][0])
    assert len(set(times)) == at_once + 1
    player.close()


def test_a_walkers_sight_tells_where_it_stands(server: Server) -> None:
    player, monitor = Player(server.agent_port), Wire(server.monitor_port)
    monitor.send("(agent (unum 1)(team Left)(move -11.5 1.2 0.4 -90))")
    for _ in range(80):
        message = player.step("(he1 0.0)")
    while "(See" not in message:
        message = player.step("(he1 0.0)")
    (sight,) = senses(message)["See"]
    marks = {
        name: [float(x) for x in polar.split()]
        for name, polar in re.findall(r"\(([FG]\d[LR]|B) \(pol ([^()]*)\)\)", sight)
    }
    known = {**dict(protocol.LANDMARKS), "B": (0.0, 0.0, 0.042)}
    assert {"F1R", "F2R", "G1R", "G2R", "B"} <= set(marks)
    for name, (distance, theta, _) in marks.items():
        dx, dy = known[name][0] + 11.5, known[name][1] - 1.2
        assert distance == pytest.approx(np.hypot(dx, dy), abs=0.15)
        assert theta == pytest.approx(np.degrees(np.arctan2(dy, dx)), abs=1.5)
    assert 1 <= sight.count("(L ") <= 30
    assert "(P (team A) (id 1) (rlowerarm (pol " in sight


def test_a_trainer_rules_the_field(server: Server) -> None:
    player, monitor, scene = Player(server.agent_port), Wire(server.monitor_port), _core.SceneReader()
    monitor.send("(agent (unum 1)(team Left)(move 3 -2 0.5 45))")
    monitor.send("(playMode PlayOn)(time 100)(score (left 2)(right 1))(ball (pos 1 2 0.042)(vel 1 0 0))(reqfullstate)")
    arrived = False
    for _ in range(20):
        message = player.step()
        position, rotation = torso(monitor, scene)
        arrived |= np.allclose(position, [3, -2, 0.5], atol=0.05) and rotation[0, 1] < -0.7
    assert arrived
    assert re.search(r"\(GS \(sl 2\) \(sr 1\) \(t 100\.\d\d\) \(pm PlayOn\)\)", message)
    assert scene.play_mode == protocol.PLAY_MODES.index("PlayOn")
    assert scene.time == pytest.approx(100.2, abs=0.3)
    ball = np.empty(3)
    assert scene.ball(ball)
    assert ball[1:] == pytest.approx([2, 0.042], abs=0.01)
    assert ball[0] > 1.1, "it rolls"
    before, turned = torso(monitor, scene) if player.step() else (None, None)
    monitor.send("(agent (unum 1)(team Left)(pos -5 5 2))")
    position, rotation = step_until_at((-5, 5), player, monitor, scene)
    assert np.allclose(position, [-5, 5, 2], atol=0.1)
    assert rotation == pytest.approx(turned, abs=0.05), f"moved from {before}, not turned"
    monitor.send("(kill (unum 1)(team Left))")
    assert player.closed()
    monitor.send("(killsim)")
    assert monitor.closed()


def test_a_trainer_turns_selects_and_sends_off_players(server: Server) -> None:
    player, mate = Player(server.agent_port), Player(server.agent_port)
    monitor, scene = Wire(server.monitor_port), _core.SceneReader()
    monitor.send("(agent (unum 1)(team Left)(pos -2 0 1)(rot 20 0 90))(reqfullstate)")
    position, rotation = step_until_at((-2, 0), player, monitor, scene)
    tilt = np.radians(20)
    turned = np.array([[0, -1, 0], [np.cos(tilt), 0, -np.sin(tilt)], [np.sin(tilt), 0, np.cos(tilt)]])
    np.testing.assert_allclose(rotation, turned, atol=0.02)
    assert np.allclose(position, [-2, 0, 1], atol=0.02)
    monitor.send("(select)(select)(repos)(select (unum 1)(team Left))")
    position, _ = step_until_at((-3, -10.5), mate, monitor, scene, 2)
    assert np.allclose(position, [-3, -10.5, 1], atol=0.02), "outside the field, on the side away from the ball"
    monitor.send("(kill)")
    assert player.closed()
    assert "(time" in mate.step()


def test_a_trainer_restarts_the_game(server: Server) -> None:
    player, monitor = Player(server.agent_port), Wire(server.monitor_port)
    assert "RSG" in monitor.receive()
    for command, modes in (
        ("(kickOff Right)", {"KickOff_Right"}),
        ("(kickOff None)", {"KickOff_Left", "KickOff_Right"}),
        ("(ball (pos 3 12 1)(vel 1 1 1))(dropBall)", {"PlayOn"}),
    ):
        monitor.send(command)
        mode = re.search(r"\(pm (\w+)\)", [player.step() for _ in range(3)][-1])
        assert mode is not None
        assert mode[1] in modes
    assert server.game.ball.position == pytest.approx((3, 10 - 0.042, 0.042))


def test_wrong_trainer_commands_change_nothing(server: Server, caplog: pytest.LogCaptureFixture) -> None:
    player, monitor, scene = Player(server.agent_port), Wire(server.monitor_port), _core.SceneReader()
    for command in (
        *(
            "(playMode Nonsense)",
            "(kickOff)",
            "(agent (unum 1)(team Left)(rot 1))",
            "(time -1)",
            "(time abc)",
            "(ball (pos 1 nan 3))",
            "(ball (pos 1 2))",
            "(dance)",
        ),
        *(
            "(agent (unum 9)(team Left)(move 0 0 1 0))",
            "(agent (unum 1)(team Left)(move 1e9 0 1 0))",
            "(score)",
            "(agent)",
        ),
    ):
        monitor.send(command)
    monitor.send("(reqfullstate)")
    for _ in range(5):
        message = player.step()
        position, _ = torso(monitor, scene)
    assert "(t 0.00) (pm BeforeKickOff)" in message
    assert np.allclose(position[:2], [-14.2, 9.2], atol=0.1)
    text = caplog.text
    for reason in (
        "'Nonsense' is unknown",
        "'nan' is not a number",
        "3 numbers are needed, not 2",
        "3 numbers are needed, not 1",
        "must be Left, Right or None, not ''",
        "no robot 9 of team Left",
    ):
        assert reason in text


def test_beams_work_before_kick_off_only(server: Server) -> None:
    player, monitor, scene = Player(server.agent_port), Wire(server.monitor_port), _core.SceneReader()
    for _ in range(3):
        player.step("(beam -3 2 0)")
        position, rotation = torso(monitor, scene)
    assert np.allclose(position[:2], [-3, 2], atol=0.06)
    assert rotation[0, 1] > 0.98, "it faces the other goal"
    monitor.send("(playMode PlayOn)")
    for _ in range(5):
        player.step()
        torso(monitor, scene)
    player.step("(beam -9 0 0)")
    position, _ = torso(monitor, scene)
    assert np.allclose(position[:2], [-3, 2], atol=0.06)


def test_players_hear_each_other(server: Server) -> None:
    first, mate, rival = Player(server.agent_port), Player(server.agent_port), Player(server.agent_port, "B")
    assert "(unum 2) (team left)" in "".join(mate.greeting)
    assert "(unum 1) (team right)" in "".join(rival.greeting)
    first.step("(say hello)")
    assert re.search(r"\(hear A 0\.00 self hello\)", first.step())
    # a message that is heard in a cycle is in the next reply
    for other in (mate, rival):
        assert re.search(r"\(hear A 0\.00 -?\d+\.\d\d hello\)", other.step() + other.step())
        assert "hear" not in other.step()
    first.step("(say " + "x" * 21 + ")")
    assert "hear" not in mate.step() + mate.step(), "too long to be heard"


def test_agents_do_not_wait_for_each_other(server: Server) -> None:
    quiet, busy = Player(server.agent_port), Player(server.agent_port)
    for _ in range(50):
        busy.step()
    assert "(now 1.0" in busy.step() or "(now 1.1" in busy.step()
    assert "(now 0.1" in quiet.step()


def test_two_full_teams_play_on_one_server(server: Server) -> None:
    """22 robots, each with its own number and joints; a trainer's monitor shows them all, and there is no 23rd."""
    watcher, scene = Wire(server.monitor_port), _core.SceneReader()
    players = [Player(server.agent_port, team, 0) for team in ("A", "B") for _ in range(11)]
    sides = [re.search(r"\(unum (\d+)\) \(team (\w+)\)", "".join(player.greeting)) for player in players]
    found = [(side[2], int(side[1])) for side in sides if side]
    assert sorted(found) == [(team, number) for team in ("left", "right") for number in range(1, 12)]
    for _ in range(10):
        for k, player in enumerate(players):
            player.step(f"(he1 {0.1 * (k + 1):.1f})")
    for k, player in enumerate(players):
        # an angle is a cycle old: nine cycles of 20 ms
        angle = float(senses(player.step())["HJ hj1"][0].split()[-1].rstrip(")"))
        assert angle == pytest.approx(np.rad2deg(0.1 * (k + 1) * 0.02 * 10), abs=0.3 + 0.02 * angle)
    watcher.send("(reqfullstate)")
    while scene.robots < 22:
        scene.read(watcher.receive().encode())
    extra = Wire(server.agent_port)
    with pytest.raises((ConnectionError, OSError)):
        extra.ask("(scene rsg/agent/nao/nao.rsg)")
        for _ in range(3):
            extra.ask("(init (unum 0)(teamname A))(syn)")
    assert "(time" in players[0].step(), "the others play on"


def test_real_time_mode_sends_fifty_messages_a_second() -> None:
    with serving(realtime=True) as server:
        wire = Wire(server.agent_port)
        wire.ask("(scene rsg/agent/nao/nao.rsg)")
        wire.receive()
        begin = time.monotonic()
        for _ in range(25):
            wire.receive()
        assert 0.4 < time.monotonic() - begin < 5.0


BAD = {
    "oversized": (b"\x7f\xff\xff\xff", "2147483647 bytes is announced"),
    "truncated": (protocol.frame(b"(he1 0.5"), "he1: the expression is not closed"),
    "unbalanced": (protocol.frame(b"(syn))"), "'(' expected"),
    "unknown effector": (protocol.frame(b"(fly 1.0)"), "unknown effector 'fly'"),
    "no number": (protocol.frame(b"(he1 fast)"), "he1: the speed is not a number"),
    "not a number": (protocol.frame(b"(he1 nan)"), "he1: the speed is not a number"),
    "infinite": (protocol.frame(b"(he1 1e400)"), "he1: the speed is not a number"),
    "too deep": (protocol.frame(b"(" * 4000), "nest too deeply"),
    "second team member": (protocol.frame(b"(init (unum 1)(teamname A))"), "has a team already"),
    "bytes": (protocol.frame(bytes(range(256))), "'(' expected"),
}


@pytest.mark.parametrize("what", BAD)
def test_whoever_breaks_the_rules_is_cut_off_alone(server: Server, caplog: pytest.LogCaptureFixture, what: str) -> None:
    data, reason = BAD[what]
    bystander, offender = Player(server.agent_port, "A"), Player(server.agent_port, "B")
    offender.socket.sendall(data)
    assert offender.closed()
    assert "(time" in bystander.step("(he1 1.0)")
    assert any(reason in record.getMessage() for record in caplog.records if record.levelno == logging.WARNING)


@pytest.mark.parametrize(
    ("scene", "reason"),
    [
        ("(scene rsg/agent/nao/nao_hetero.rsg 9)", "robot type '9' is unknown"),
        ("(scene /etc/passwd)", "use rsg/agent/nao"),
        ("(init (unum 1)(teamname A))", "send (scene ...) first"),
    ],
)
def test_wrong_greetings_are_refused(server: Server, caplog: pytest.LogCaptureFixture, scene: str, reason: str) -> None:
    wire = Wire(server.agent_port)
    wire.send(scene)
    assert wire.closed()
    assert reason in caplog.text


def test_silent_clients_are_dropped(caplog: pytest.LogCaptureFixture) -> None:
    with serving(handshake_s=0.1, silence_s=0.3) as server:
        stranger, player, monitor = Wire(server.agent_port), Player(server.agent_port), Wire(server.monitor_port)
        assert stranger.closed()
        assert player.closed()
        assert "no scene requested within 0.1 s" in caplog.text
        assert "silent for 0.3 s" in caplog.text
        assert "RSG" in monitor.receive(), "a monitor may be silent for ever"


def test_a_thousand_connections_disturb_nobody(caplog: pytest.LogCaptureFixture) -> None:
    with serving(max_connections=50) as server:
        player = Player(server.agent_port)
        crowd = []
        for k in range(1000):
            wire = Wire(server.agent_port if k % 2 else server.monitor_port)
            crowd.append(wire)
            if len(crowd) > 200:
                crowd.pop(0).close()
            if k % 50 == 0:
                assert "(time" in player.step()
        for wire in crowd:
            wire.close()
        assert "too many connections" in caplog.text
        assert "(time" in player.step()


def test_a_monitor_that_never_reads_blocks_nobody_and_catches_up(server: Server) -> None:
    player, monitor = Player(server.agent_port), Wire(server.monitor_port)
    wave = "".join(f"({joint.effector} {{0}})" for joint in nao_model.model(0).joints)
    for k in range(2500):
        player.step(wave.format("2.0" if k % 40 < 20 else "-2.0"))
    (unread,) = (c for c in server._connections if c.kind == "monitor")
    assert unread.backlog < 2 << 20, "memory is bounded"
    scene, kinds = _core.SceneReader(), []
    for _ in range(100000):
        player.step()
        frame = monitor.receive()
        kinds.append("(RSG " in frame)
        scene.read(frame.encode())
        if unread.backlog == 0 and kinds[-1]:
            break
    assert kinds[0]
    assert kinds[-1], "after missed frames a full one comes"


def test_an_agent_that_never_reads_is_not_read_either(server: Server) -> None:
    player, greedy = Player(server.agent_port), Player(server.agent_port)
    greedy.socket.settimeout(1.0)
    with pytest.raises(TimeoutError):
        for _ in range(200):
            greedy.socket.sendall(protocol.frame(b"(syn)") * 10000)
    assert "(time" in player.step()
    backlogs = [connection.backlog + len(connection._framer) for connection in server._connections]
    assert max(backlogs) < 1 << 20


STREAMS = st.lists(
    st.binary(max_size=60)
    | st.text("()synhe1agentmovball .-0123", max_size=60).map(lambda s: protocol.frame(s.encode()))
    | st.sampled_from(
        [
            *(b"(syn)", b"(he1 1)(syn)", b"(scene rsg/agent/nao/nao.rsg)", b"(init (unum 0)(teamname X))", b"(say x)"),
            *(
                b"(agent (unum 1)(team Left)(move 0 0 1 0))",
                b"(ball (pos 0 0 0))",
                b"(playMode PlayOn)",
                b"(reqfullstate)",
            ),
            *(
                b"(beam 0 0 0)",
                b"(time 3)",
                b"(agent (unum)(team))",
                b"(score (left)(right 1))",
                b"(init unum)",
                b"(())",
            ),
        ]
    ).map(protocol.frame),
    max_size=8,
)


def test_no_stream_of_bytes_brings_the_server_down() -> None:
    with serving(seed=1, max_agents=4) as server:
        player = Player(server.agent_port, "Team", 11)

        @settings(max_examples=120)
        @given(STREAMS, st.booleans())
        def attack(stream: list[bytes], monitor: bool) -> None:
            wire = Wire(server.monitor_port if monitor else server.agent_port)
            try:
                wire.socket.sendall(b"".join(stream))
            except OSError:
                pass
            finally:
                wire.close()
            assert "(time" in player.step("(he1 0.1)")

        attack()
