from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naosim.robots import nao_model
from naosim.simspark import _core, protocol
from naosim.simspark.protocol import Framer, ProtocolError, frame
from naosim.simspark.server_scene import Actor, describe

NAO = nao_model.model(0)
EFFECTORS = [joint.effector for joint in NAO.joints]


def reader() -> tuple[_core.CommandReader, np.ndarray]:
    return _core.CommandReader(EFFECTORS), np.zeros(len(EFFECTORS))


@given(st.lists(st.binary(max_size=200), max_size=10), st.integers(1, 50))
def test_messages_survive_any_cutting_of_the_stream(messages: list[bytes], step: int) -> None:
    stream = b"".join(frame(message) for message in messages)
    framer, found = Framer(200), []
    for k in range(0, len(stream), step):
        framer.feed(stream[k : k + step])
        found += list(framer)
    assert found == messages
    assert len(framer) == 0


def test_an_oversized_announcement_is_refused_before_its_body_comes() -> None:
    framer = Framer(8192)
    framer.feed(b"\x00\x00\x20\x01")
    with pytest.raises(ProtocolError, match="8193 bytes is announced, 8192 are allowed"):
        framer.pop()


def test_a_robot_tells_of_its_parts_in_the_order_of_the_server() -> None:
    names = [name for _, name, _ in protocol.percept_order(NAO)]
    arms = [f"{s}aj{k}" for s in "rl" for k in range(1, 5)]
    legs = [[*(f"{s}lj{k}" for k in range(1, 6)), f"{s}f", f"{s}lj6"] for s in "rl"]
    assert names == ["hj1", "hj2", "See", *arms, *legs[0], *legs[1]]
    toes = [name for _, name, _ in protocol.percept_order(nao_model.model(4))]
    assert toes[-4:] == ["lf", "llj6", "lf1", "llj7"]
    for kind in nao_model.ROBOT_TYPES:
        order = protocol.percept_order(nao_model.model(kind))
        assert sorted(k for what, _, k in order if what == "j") == list(range(len(nao_model.model(kind).joints)))


def test_commands_set_speeds_and_hand_back_the_rest() -> None:
    commands, speeds = reader()
    rest = commands.read(b"(he1 0.5) (lle3\t-6.139500)(init (unum 1)(teamname A))(syn)\x00", speeds)
    assert rest == [("init", ("unum", "1"), ("teamname", "A")), ("syn",)]
    assert speeds[EFFECTORS.index("he1")] == 0.5
    assert speeds[EFFECTORS.index("lle3")] == -6.1395
    assert np.count_nonzero(speeds) == 2


@pytest.mark.parametrize(
    "text",
    [
        *("(he1", "(he1 0.5", "(he1 0.5 (", "(he1 0.5))", ")", "hello", "(syn", "((((((", "(he1 0.5)(init (unum 1)"),
        *(
            "(he1 abc)",
            "(he1 nan)",
            "(he1 inf)",
            "(he1 1e99)",
            "(he1)",
            "(he1 )",
            "(he1 (1))",
            "(he1 0x10)",
            "(he1 1,5)",
        ),
        "(" * 5000 + ")" * 5000,
    ],
)
def test_broken_commands_are_refused_as_a_whole(text: str) -> None:
    commands, speeds = reader()
    with pytest.raises(ValueError, match=r"^byte \d+: "):
        commands.read(b"(lle3 1.0)" + text.encode(), speeds)
    assert not speeds.any(), "no command of a malformed message may be executed"


@settings(max_examples=300)
@given(st.binary(max_size=400) | st.text("()he1 .-5syn\x00", max_size=200).map(str.encode))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    commands, speeds = reader()
    try:
        commands.read(data, speeds)
    except ValueError:
        return
    assert np.isfinite(speeds).all()


def see(
    position: tuple[float, float, float], yaw_deg: float, *, noise: bool = False, seed: int = 1
) -> list[tuple[str, list[list[float]]]]:
    """Return what a level head at a position sees: names, each with its (distance, theta, phi)."""
    vision = _core.Vision(list(protocol.LANDMARKS), protocol.LINES, 3, seed, noise)
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    text = vision.see(np.array(position), rotation, [("B", (0.0, 0.0, 0.042))], "", []).decode()
    (items,) = _core.CommandReader([]).read(text.encode(), np.zeros(0))
    return [(item[0], [[float(x) for x in polar[1:]] for polar in item[1:]]) for item in items[1:]]


def place_of(polar: list[float], position: np.ndarray, yaw_deg: float) -> np.ndarray:
    """Return the position of a sighting on the field."""
    distance, theta, phi = polar[0], math.radians(polar[1]), math.radians(polar[2])
    ahead = np.array([-math.sin(theta) * math.cos(phi), math.cos(theta) * math.cos(phi), math.sin(phi)]) * distance
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    return np.asarray(position + np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ ahead)


@given(st.from_regex(r"\A[+-]?[0-9]{1,18}(\.[0-9]{0,18})?(e[+-]?[0-9]{1,2})?\Z"))
def test_every_number_is_read_as_the_nearest_double(word: str) -> None:
    """Short ones by a quotient of integers, others by the standard library."""
    scene = _core.SceneReader()
    scene.read(f"((time {word}))".encode())
    assert (scene.time, math.copysign(1.0, scene.time)) == (float(word), math.copysign(1.0, float(word)))


@pytest.mark.parametrize("yaw", [-90.0, 0.0, 37.0, 180.0])
def test_landmarks_are_where_they_are_seen(yaw: float) -> None:
    position = np.array([-10.0, 2.0, 0.5])
    known = {**dict(protocol.LANDMARKS), "B": (0.0, 0.0, 0.042)}
    seen = [(name, polars[0]) for name, polars in see((-10.0, 2.0, 0.5), yaw) if name != "L"]
    for name, polar in seen:
        assert place_of(polar, position, yaw) == pytest.approx(known[name], abs=0.01)
    c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    for name, at in known.items():
        offset = np.asarray(at) - position
        ahead, left = -s * offset[0] + c * offset[1], -c * offset[0] - s * offset[1]
        theta = math.degrees(math.atan2(left, ahead))
        if abs(abs(theta) - 60) > 1:
            assert (abs(theta) < 60) == (name in dict(seen)), name


def test_lines_are_cut_at_the_edge_of_the_view_and_lie_on_the_field() -> None:
    position = np.array([-10.0, 2.0, 0.5])
    lines = [polars for name, polars in see((-10.0, 2.0, 0.5), -90.0) if name == "L"]
    assert 1 <= len(lines) <= 30
    for ends in lines:
        places = [place_of(end, position, -90.0) for end in ends]
        for place, end in zip(places, ends, strict=True):
            assert abs(place[2]) < 0.02
            assert abs(end[1]) <= 60.01
        near = [
            np.linalg.norm(np.cross(line[3:] - line[:3], places[0] - line[:3])) / np.linalg.norm(line[3:] - line[:3])
            for line in protocol.LINES
        ]
        assert min(near) < 0.05


def test_vision_noise_has_the_size_of_the_real_one() -> None:
    exact = dict((name, polars[0]) for name, polars in see((-10.0, 2.0, 0.5), -90.0) if name != "L")
    errors = []
    for seed in range(300):
        for name, polars in see((-10.0, 2.0, 0.5), -90.0, noise=True, seed=seed):
            if name == "F1R":
                errors.append(np.subtract(polars[0], exact[name]))
    spread = np.std(errors, axis=0)
    distance = exact["F1R"][0]
    assert spread[0] == pytest.approx(math.hypot(0.0965 * distance / 100, 0.005 / math.sqrt(3)), rel=0.2)
    assert spread[1:] == pytest.approx([0.148, 0.1225], rel=0.2)


def test_a_head_that_looks_at_nothing_still_says_so() -> None:
    vision = _core.Vision([], np.zeros((0, 6)), 2, 1, False)
    assert vision.see(np.zeros(3), np.eye(3), [], "", []) == b"(See )"


def poses(actors: int, rng: np.random.Generator) -> np.ndarray:
    out = rng.normal(size=(1 + actors * len(NAO.bodies), 13))
    out[:, 3:7] /= np.linalg.norm(out[:, 3:7], axis=1, keepdims=True)
    return out


def rotation(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_the_scene_graph_gives_back_every_torso_through_full_and_incremental_frames() -> None:
    rng = np.random.default_rng(0)
    steps, rows = describe([Actor(NAO, 1, 7), Actor(NAO, 2, 3)])
    writer, scene = _core.SceneWriter(steps, rows), _core.SceneReader()
    position, turn = np.empty(3), np.empty((3, 3))
    now = poses(2, rng)
    for k in range(6):
        scene.read(writer.write(f"((time {k}))".encode(), k in (0, 4), now)[4:])
        assert scene.robots == 2
        assert scene.time == k
        for row, side, number in ((1, 1, 7), (1 + len(NAO.bodies), 2, 3)):
            assert scene.torso(side, number, position, turn)
            assert position == pytest.approx(now[row, :3], abs=0.0051, rel=1e-5)
            assert turn == pytest.approx(rotation(now[row, 3:7]), abs=0.0051)
        assert scene.ball(position)
        assert position == pytest.approx(now[0, :3], abs=0.0051, rel=1e-5)
        assert not scene.torso(1, 8, position, turn)
        if k % 2:
            now = poses(2, rng)
        else:
            now[:, :3] += 0.001  # too small to be sent
    unchanged = writer.write(b"((time 9))", False, now)
    assert len(writer.write(b"((time 9))", False, now)) <= len(unchanged)
    assert b"SLT" not in writer.write(b"((time 9))", False, now)


def test_a_full_frame_for_one_monitor_takes_no_motion_from_the_others() -> None:
    rng = np.random.default_rng(0)
    writer, position = _core.SceneWriter(*describe([Actor(NAO, 1, 7)])), np.empty(3)
    monitors = [_core.SceneReader(), _core.SceneReader()]
    now = poses(1, rng)
    for monitor in monitors:
        monitor.read(writer.write(b"((time 0))", True, now)[4:])
    monitors[0].read(writer.write(b"((time 1))", False, now)[4:])
    before, now = now, poses(1, rng)
    monitors[1].read(writer.write(b"((time 2))", True, now)[4:])
    for shown in (now, before):  # the robot stays where it is; it returns to where the first monitor saw it
        frame = writer.write(b"((time 3))", False, shown)[4:]
        for monitor in monitors:
            monitor.read(frame)
            assert monitor.torso(1, 7, position, np.empty((3, 3)))
            assert position == pytest.approx(shown[1, :3], abs=0.0051, rel=1e-5)


def test_brackets_of_a_frame_match_and_viewers_find_what_they_look_for() -> None:
    steps, rows = describe([Actor(NAO, 1, 7)])
    text = _core.SceneWriter(steps, rows).write(b"((time 0))", True, poses(1, np.random.default_rng(0)))[4:].decode()
    depth = list(itertools.accumulate({"(": 1, ")": -1}.get(c, 0) for c in text))
    assert min(depth) >= 0
    assert depth[-1] == 0
    for mesh in ("naobody0", "naohead", "rupperarm0", "lshank0", "rfoot", "soccerball", "naosoccerfield"):
        assert f"(load models/{mesh}.obj)" in text
    assert "(resetMaterials matNum7 matLeft matType0 naowhite)" in text


@pytest.mark.parametrize(
    "text",
    [
        *("", "(", "((time 1)", "hello", "((time 1))(RSG 0 1)", "((time 1))(XXX 0 1)()", "((time 1))(RSG 0 1)((nd TRF"),
        *("((time 1))(RSG 0 1)((nd TRF (SLT 1 2 3)))", "((time 1))(RSG 0 1)(" + "(nd TRF" * 100),
    ],
)
def test_broken_frames_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="byte"):
        _core.SceneReader().read(text.encode())


def test_an_incremental_frame_of_another_scene_is_refused() -> None:
    scene = _core.SceneReader()
    scene.read(b"((time 0))(RSG 0 1)((nd TRF (nd TRF))(nd TRF))")
    scene.read(b"((time 1))(RDS 0 1)((nd(nd))(nd))")
    for other in (b"(nd)", b"(nd(nd))(nd)(nd)", b"(nd)(nd(nd))"):
        with pytest.raises(ValueError, match="does not fit the last full one"):
            scene.read(b"((time 2))(RDS 0 1)(" + other + b")")


@settings(max_examples=200)
@given(st.data())
def test_damaged_frames_never_do_harm(data: st.DataObject) -> None:
    steps, rows = describe([Actor(NAO, 1, 7)])
    text = bytearray(_core.SceneWriter(steps, rows).write(b"((time 0))", True, poses(1, np.random.default_rng(1)))[4:])
    for _ in range(data.draw(st.integers(1, 5))):
        at = data.draw(st.integers(0, len(text) - 1))
        text[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3) | st.sampled_from([b"(", b")"]))
    scene = _core.SceneReader()
    position, turn = np.empty(3), np.empty((3, 3))
    try:
        scene.read(bytes(text))
    except ValueError:
        return
    scene.torso(1, 7, position, turn)
    scene.ball(position)
