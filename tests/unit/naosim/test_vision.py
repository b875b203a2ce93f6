"""What many robots see at once is what the server shows each of them."""

from __future__ import annotations

import re

import numpy as np
import pytest
from naosim import robots
from naosim.robots.nao import NaoParameters
from naosim.simspark import EmbeddedSimulator, _core, protocol, vision
from naosim.simspark.vision import LandmarkVision
from naosim.simulator import Starts

HEADS = np.array(
    [
        [-14.0, 1.0, 0.5, 0.8, 0.0, 0.0, -0.6],
        [2.0, -4.0, 0.5, 0.9, 0.1, 0.2, -0.3],
        [9.0, 6.0, 0.4, 0.3, 0.0, 0.1, 1.0],
    ]
)
HEADS[:, 3:] /= np.linalg.norm(HEADS[:, 3:], axis=1, keepdims=True)
ROWS = np.arange(len(HEADS))


def rotation(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def shown(head: np.ndarray) -> np.ndarray:
    """Return what the server's own vision prints without noise."""
    server = _core.Vision(list(protocol.LANDMARKS), protocol.LINES, 2, 0, False)
    text = server.see(np.ascontiguousarray(head[:3]), rotation(head[3:]), [], "", []).decode()
    found = dict(re.findall(r"\(([FG]\d[LR]) \(pol ([^)]+)\)", text))
    missing = "nan nan nan"
    return np.array([[float(number) for number in found.get(name, missing).split()] for name, _ in protocol.LANDMARKS])


def test_without_noise_it_shows_what_the_server_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vision, "DISTANCE_SPREAD", 0.0)
    monkeypatch.setattr(vision, "ANGLE_SPREADS_DEG", (0.0, 0.0))
    monkeypatch.setattr(vision, "OFFSET_M", 0.0)
    eyes = LandmarkVision(len(HEADS), 2)
    eyes.see(ROWS, HEADS)
    expected = np.array([shown(head) for head in HEADS])
    np.testing.assert_allclose(eyes.seen.reshape(expected.shape), expected, rtol=0, atol=0.0101)
    assert (~np.isnan(expected[..., 0])).sum(axis=1).tolist() == [4, 3, 4]


def test_the_noise_has_the_servers_size() -> None:
    eyes = LandmarkVision(1, None)
    expected = shown(HEADS[0])
    drawn, offsets = [], []
    for _ in range(300):
        eyes.begin(ROWS[:1])
        for _ in range(20):
            eyes.due(ROWS[:1])
            eyes.see(ROWS[:1], HEADS[:1])
            drawn.append(eyes.seen.reshape(expected.shape) - expected)
        offsets.append(np.mean(drawn[-20:], axis=0)[:, 0])
    errors = np.array(drawn)[:, ~np.isnan(expected[:, 0])]
    distance = expected[~np.isnan(expected[:, 0]), 0]
    spread = errors.std(axis=0)
    # a run's offset of at most 5 mm is small beside the noise of landmarks at 29 m
    np.testing.assert_allclose(spread[:, 0], 0.000965 * distance, rtol=0.05)
    np.testing.assert_allclose(spread[:, 1], 0.1480, rtol=0.05)
    np.testing.assert_allclose(spread[:, 2], 0.1225, rtol=0.05)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=0.012)


def test_a_run_has_a_fixed_offset() -> None:
    near = np.array([[14.0, 0.0, 0.8, np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)]])  # a metre before the goal, facing it
    means = []
    for _ in range(40):
        eyes = LandmarkVision(1, None)
        eyes.counters[0, 1] = len(means)
        seen = []
        for _ in range(300):
            eyes.due(ROWS[:1])
            eyes.see(ROWS[:1], near)
            seen.append(eyes.seen[0].reshape(-1, 3)[:, 0].copy())
        means.append(np.mean(seen, axis=0))
    means = np.array(means)
    spread = means[:, ~np.isnan(means[0])].std(axis=0)
    # uniform from -5 to 5 mm along each axis
    assert spread == pytest.approx(np.full(2, 0.005 / np.sqrt(3)), rel=0.3)


def test_a_robot_sees_in_every_third_step_what_its_own_noise_makes_of_it() -> None:
    robot = robots.get("nao-0").with_parameters({"onboard_sensing": True})
    simulator = EmbeddedSimulator(robot, 4)
    simulator.load_starts(Starts(robot.nominal[None], (-14.0, 0.0)))
    simulator.start(np.arange(4), np.zeros(4, np.int64))
    assert np.isnan(simulator.perceptors["vision"]).all()
    seen = []
    for _ in range(9):
        simulator.step(np.repeat(robot.nominal[None], 4, axis=0))
        seen.append(simulator.perceptors["vision"].copy())
    sighted = ~np.isnan(np.array(seen)).all(axis=2)
    assert sighted.sum(axis=0).tolist() == [3] * 4
    assert len({tuple(row) for row in sighted.T.tolist()}) == 3, "not all of them see in the same step"
    assert not (sighted[1:] & sighted[:-1]).any()
    values = [np.array(seen)[sighted[:, row], row] for row in range(4)]
    assert len({value.tobytes() for value in values}) == 4


def test_only_an_onboard_robot_has_vision() -> None:
    plain, onboard = robots.get("nao-3"), robots.get("nao-3").with_parameters({"onboard_sensing": True})
    assert onboard.parameters == NaoParameters(onboard_sensing=True)
    assert [each.name for each in onboard.perceptors][:-1] == [each.name for each in plain.perceptors]
    assert onboard.with_parameters({}) == plain
