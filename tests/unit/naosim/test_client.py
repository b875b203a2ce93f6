from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from naosim.launchers import Address
from naosim.mujoco._mujoco import Exchange as MujocoExchange
from naosim.robots import nao_model
from naosim.simspark import RemoteBatch, _core, protocol

NAO = nao_model.model(0)
ONLY = np.ones(1, dtype=np.uint8)
GOOD = b"(time (now 1.20))(GS (unum 4) (team left) (t 3.50) (pm PlayOn) (k none) (ti ((1 none 0))))" + b"".join(
    f"(HJ (n {name})  (ax {k}.25))".encode() for k, name in enumerate(NAO.joint_names)
)


class Server:
    """Hold the server's ends of an exchange with one row."""

    def __init__(self) -> None:
        self.agent, agent = socket.socketpair()
        self.monitor, monitor = socket.socketpair()
        self.exchange = _core.Exchange(1, list(NAO.joint_names), [joint.effector for joint in NAO.joints], [])
        self.exchange.attach(0, agent.detach(), monitor.detach())
        self.views = self.exchange.views()

    def answer(self, message: bytes, timeout_s: float = 5.0) -> str:
        self.agent.sendall(protocol.frame(message))
        self.exchange.collect(ONLY, 1, 0, timeout_s)
        return self.exchange.failure(0)

    def step(self, speeds: np.ndarray) -> None:
        self.exchange.dispatch(speeds, None)
        self.exchange.gather(None, 5.0, False)

    def close(self) -> None:
        self.agent.close()
        self.monitor.close()
        self.exchange.detach(0)


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.close()


def test_a_message_is_read_whatever_else_it_holds(server: Server) -> None:
    sight = (
        b"(See (L (pol 1 2 3) (pol 4 5 6)) (P (team A) (id 1) (head (pol 1 2 3))))(hear A 1.0 self hello)(New (x (y)))"
    )
    senses = b"(GYR (n torso) (rt 1.5 -2 nan))(ACC (n torso) (a 0.1 0.2 9.81))(FRP (n lf) (c 0 1 2) (f 3 4 5))"
    assert server.answer(GOOD + sight + senses) == ""
    v = server.views
    assert v["joint_angles"][0] == pytest.approx(np.arange(22) + 0.25)
    assert v["gyro"][0] == pytest.approx([1.5, -2, np.nan], nan_ok=True)
    assert v["accel"][0] == pytest.approx([0.1, 0.2, 9.81])
    assert v["foot_left"][0] == pytest.approx([0, 1, 2, 3, 4, 5])
    assert np.isnan(v["foot_right"]).all()
    assert (v["time"][0], v["game_time"][0]) == (1.2, 3.5)
    assert server.exchange.game(0) == (1, 4, "PlayOn")
    assert server.answer(GOOD) == ""
    assert np.isnan(v["foot_left"]).all(), "a foot that is not in the message has no contact"


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (b"(HJ (n hj1) (ax abc))", "a joint angle cannot be read"),
        (b"(HJ (n hj1) (ax 1.0)", "the end of an expression cannot be read"),
        (b"(ACC (n torso) (a 1 2))", "ACC cannot be read"),
        (b"junk", "an expression cannot be read"),
    ],
)
def test_a_malformed_reply_is_told(server: Server, message: bytes, reason: str) -> None:
    assert reason in server.answer(message)


def test_an_absurd_length_is_told(server: Server) -> None:
    server.agent.sendall(b"\xff\xff\xff\xff")
    server.exchange.collect(ONLY, 1, 0, 5.0)
    assert "a message of 4294967295 bytes is announced" in server.exchange.failure(0)


def test_a_silent_server_is_told(server: Server) -> None:
    server.exchange.collect(ONLY, 1, 1, 0.05)
    assert server.exchange.failure(0) == "agent port: no reply within 0.1 s"


def test_a_server_that_hangs_up_is_told(server: Server) -> None:
    server.agent.close()
    server.step(np.zeros((1, 22)))
    assert "agent port: " in server.exchange.failure(0)


def test_a_robot_with_other_joints_is_told(server: Server) -> None:
    server.agent.sendall(protocol.frame(b"(HJ (n hj1) (ax 1.0))"))
    server.monitor.sendall(protocol.frame(b"((time 0))"))
    server.step(np.zeros((1, 22)))
    assert server.exchange.failure(0) == "malformed reply: 1 of 22 joint angles came"


@pytest.mark.parametrize(
    "sense", [b"(HJ (n hj1) (ax nan))", b"(GYR (n torso) (rt 0 -inf 0))", b"(ACC (n torso) (a 0 0 nan))"]
)
def test_a_robot_whose_world_has_diverged_is_told(server: Server, sense: bytes) -> None:
    """The server is lost and replaced; a command that follows from such a perceptor would be refused for all robots."""
    server.agent.sendall(protocol.frame(GOOD + sense))
    server.monitor.sendall(protocol.frame(b"((time 0))"))
    server.step(np.zeros((1, 22)))
    assert server.exchange.failure(0) == "malformed reply: a perceptor or the torso's pose is not a finite number"


@pytest.mark.parametrize(("angle", "expected"), [(b"1.5", ""), (b"nan", "is not a finite number")])
def test_a_booster_whose_world_has_diverged_is_told(angle: bytes, expected: str) -> None:
    ours, theirs = socket.socketpair()
    exchange = MujocoExchange(1, ["q_he1"], ["he1"], [1.0], [1.0], False)
    exchange.attach(0, theirs.detach(), -1)
    pose = b"(time (now 0.1))(quat (n torso)(q 1 0 0 0))(pos (n torso)(p 0 0 0.6))(GYR (rt 0 0 0))(ACC (a 0 0 9.81))"
    with ours:
        exchange.dispatch(np.zeros((1, 1)), None)
        ours.sendall(protocol.frame(pose + b"(HJ (n q_he1)(ax %s)(vx 0))" % angle))
        assert exchange.gather(None, 5.0, False) == bool(expected)
        assert expected in exchange.failure(0)
        exchange.detach(0)


def test_a_frame_that_has_come_already_answers_no_later_command(server: Server) -> None:
    """Unrequested messages, as in the cycles of a greeting, must not shift the answers."""
    server.agent.sendall(protocol.frame(GOOD))
    server.monitor.sendall(protocol.frame(b"((time 0))"))
    server.exchange.drain(0, 0.05, 5.0)
    server.exchange.dispatch(np.zeros((1, 22)), None)
    server.agent.sendall(protocol.frame(GOOD.replace(b"1.20", b"1.22")))
    server.monitor.sendall(protocol.frame(b"((time 0))"))
    assert server.exchange.gather(None, 5.0, False) == 0
    assert server.views["time"][0] == 1.22


def test_a_server_that_does_not_wait_is_told(server: Server) -> None:
    """At the handshake it may have been too slow to be noticed."""
    server.exchange.admit(0)
    server.exchange.dispatch(np.zeros((1, 22)), None)
    server.monitor.sendall(protocol.frame(b"((time 0))"))
    server.agent.sendall(protocol.frame(GOOD))
    assert server.exchange.gather(None, 5.0, False) == 0
    server.agent.sendall(protocol.frame(GOOD))
    server.exchange.drain(0, 0.05, 5.0)
    assert server.exchange.failure(0) == "a message came that answers no command: it must run in sync mode"


def test_acknowledgements_are_not_delayed() -> None:
    """Otherwise rcssserver3d delays each frame by 40 ms after a trainer's command."""
    server = Server()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        client = socket.create_connection(listener.getsockname())
        far, _ = listener.accept()
    agent, near = socket.socketpair()
    with far, agent:
        server.exchange.attach(0, near.detach(), client.detach())
        began = time.monotonic()
        for cycle in range(50):
            if cycle % 2:
                server.exchange.post(0, True, b"(time 0)")
                far.recv(4096)
            server.exchange.dispatch(np.zeros((1, 22)), None)
            agent.recv(4096)
            agent.sendall(protocol.frame(GOOD))
            far.sendall(protocol.frame(b"((time 0))"))
            assert server.exchange.gather(None, 5.0, False) == 0
        assert time.monotonic() - began < 0.5, "frames are held back"
    server.close()


@given(st.floats(-10, 10, width=32))
def test_a_speed_arrives_to_the_last_bit(speed: float) -> None:
    server = Server()
    try:
        server.agent.sendall(protocol.frame(GOOD))
        server.monitor.sendall(protocol.frame(b"((time 0))"))
        server.step(np.full((1, 22), speed))
        message = server.agent.recv(65536)[4:]
    finally:
        server.close()
    speeds = np.zeros(22)
    commands = _core.CommandReader([joint.effector for joint in NAO.joints])
    assert commands.read(message, speeds) == [("syn",)]
    assert (speeds.astype(np.float32) == np.float32(speed)).all()
    assert b"e-" not in message.replace(b"le", b"").replace(b"ae", b"").replace(b"he", b"")


@settings(max_examples=100, suppress_health_check=[HealthCheck.too_slow])
@given(st.binary(max_size=300), st.integers(0, len(GOOD)))
def test_damaged_messages_never_do_harm(junk: bytes, at: int) -> None:
    server = Server()
    try:
        server.answer(GOOD[:at] + junk + GOOD[at + len(junk) :])
        assert server.views["joint_angles"].shape == (1, 22)
    finally:
        server.close()


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"n": 3}, "n: must equal the number of addresses, 1, not 3"),
        ({"robot_type": 9}, "robot_type"),
        ({"team": "a b"}, "team"),
        ({"uniform_number": 0}, "uniform_number"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, object], field: str) -> None:
    with pytest.raises(ValueError, match=field):
        RemoteBatch([Address("127.0.0.1", 1, 2)], **arguments)  # type: ignore[arg-type]
