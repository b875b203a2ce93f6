"""How balls roll: where they stop, how to launch them, and what they pass."""

from __future__ import annotations

import numpy as np
from naosim.mujoco.embedded import MujocoSimulator
from naosim.robots.booster import T1
from naosim.simulator import BALL, Scene, Starts
from naosprint.tasks import rolling
from naosprint.terms import source

RADIUS = T1.field.ball_radius_m


def test_rolls_are_those_of_the_exact_engine() -> None:
    """Rolling and sliding, along an axis and aside; a turn by 90 degrees changes nothing."""
    starts = [(1.0, 0.0, True), (1.0, 20.0, True), (2.0, 30.0, True), (1.5, 100.0, True), (1.5, -20.0, False)]
    simulator = MujocoSimulator(T1, len(starts), scene=Scene(ball=True))
    simulator.load_starts(Starts(T1.nominal[None], (0.0, 8.0)))
    rows, still = np.arange(len(starts)), np.zeros(len(starts), dtype=np.int64)
    simulator.start(rows, still)
    speed, angle = np.array([s for s, *_ in starts]), np.radians([a for _, a, _ in starts])
    velocity = np.stack([speed * np.cos(angle), speed * np.sin(angle), 0.0 * speed], axis=1)
    spin = np.stack([-velocity[:, 1], velocity[:, 0], 0.0 * speed], axis=1) / RADIUS
    spin[~np.array([rolls for *_, rolls in starts])] = 0.0
    simulator.place_ball(rows, np.tile((0.0, -4.0, RADIUS), (len(starts), 1)), velocity, spin)
    ball = simulator.truth.bodies[BALL]
    targets = np.tile(T1.nominal, (len(starts), 1))
    for _ in range(250):
        simulator.step(targets)
        if np.hypot(*ball.velocity[:, :2].T).max() < 0.01:
            break
    moved = ball.position[:, :2] - (0.0, -4.0)
    predicted = rolling.roll(source(velocity), source(spin), RADIUS)(slice(None))
    distance, direction = rolling.stop(np.hypot(*predicted.T), np.arctan2(predicted[:, 1], predicted[:, 0]))
    found = np.hypot(*moved.T)
    np.testing.assert_allclose(distance[:4], found[:4], rtol=0.02)
    assert 0.0 < found[4] - distance[4] < 0.15  # it slides at first
    turned = np.degrees(np.arctan2(moved[:, 1], moved[:, 0]) - direction)
    np.testing.assert_allclose(turned, 0.0, atol=1.0)


def test_a_launch_stops_where_it_is_aimed_at() -> None:
    rng = np.random.default_rng(0)
    distance, direction = rng.uniform(1.5, 10.0, 500), rng.uniform(-np.pi, np.pi, 500)
    reached, found = rolling.stop(*rolling.launch(distance, direction))
    np.testing.assert_allclose(reached, distance, rtol=0.01)
    np.testing.assert_allclose(np.cos(found - direction), 1.0, atol=1e-5)


def test_a_power_kick_is_aimed_nearer_to_the_axis_than_its_point() -> None:
    """Since it swerves toward a diagonal, which balls along an axis or a diagonal do not."""
    directions = np.radians([0.0, 20.0, -20.0, 45.0, 110.0])
    turned = np.degrees(directions - rolling.power_aim(directions))
    np.testing.assert_allclose(turned[[0, 3]], 0.0, atol=0.5)
    assert 2.0 < turned[1] < 6.0
    np.testing.assert_allclose(turned[[2, 4]], [-turned[1], turned[1]])


def test_a_launch_passes_what_it_is_aimed_at() -> None:
    """In the exact engine, although balls swerve by up to a metre on their way."""
    shots = [(4.0, 6.0, 2.5), (6.0, 9.0, -6.0), (3.0, 3.0, 2.0), (5.0, 8.0, 0.5)]
    shots += [(3.0, 4.0, 3.0), (5.0, 9.0, -5.0)]
    slides = np.arange(6) >= 4
    speed, ahead, aside = np.array(shots).T
    direction = rolling.aim(speed, ahead, aside, slides)
    speed[slides] *= rolling.SLIDES
    n = len(speed)
    simulator = MujocoSimulator(T1, n, scene=Scene(ball=True))
    simulator.load_starts(Starts(T1.nominal[None], (0.0, 8.0)))
    rows = np.arange(n)
    simulator.start(rows, np.zeros(n, dtype=np.int64))
    velocity = np.stack([speed * np.cos(direction), speed * np.sin(direction), 0.0 * speed], axis=1)
    spin = np.stack([-velocity[:, 1], velocity[:, 0], 0.0 * speed], axis=1) / RADIUS
    spin[slides] = 0.0
    simulator.place_ball(rows, np.tile((0.0, -4.0, RADIUS), (n, 1)), velocity, spin)
    ball, targets, passed = simulator.truth.bodies[BALL], np.tile(T1.nominal, (n, 1)), np.full(n, np.nan)
    while np.isnan(passed).any():
        before = ball.position[:, :2].copy()
        simulator.step(targets)
        assert (ball.velocity[:, 0] > 0.0).all()
        now = ball.position[:, :2]
        crosses = (before[:, 0] < ahead) & (now[:, 0] >= ahead)
        share = (ahead - before[:, 0]) / (now[:, 0] - before[:, 0])
        passed[crosses] = (before[:, 1] + share * (now[:, 1] - before[:, 1]) + 4.0)[crosses]
    np.testing.assert_allclose(passed[~slides], aside[~slides], atol=0.12)
    np.testing.assert_allclose(passed[slides], aside[slides], atol=0.3)
    assert np.abs(np.tan(direction[:3]) * ahead[:3] - aside[:3]).max() > 0.3  # straight they would have missed
