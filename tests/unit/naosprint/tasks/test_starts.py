"""How starts are drawn, settled and chosen."""

from __future__ import annotations

import numpy as np
import pytest
from naosim import kinds, robots
from naosim.robots import nao_model
from naosim.robots.actuation import Actuation
from naosim.simspark import BatchSimulator, EmbeddedSimulator
from naosim.simspark.control import DROP_M
from naosim.simulator import RuntimeOptions, Starts
from naosprint.tasks.starts import choose_starts, draw_start_poses

NAO = robots.get("nao-0")
START = (-14.0, 0.0)


def test_without_noise_there_is_one_start() -> None:
    """The standard pose, once."""
    actuation = Actuation(NAO)
    poses = draw_start_poses(actuation, 50, 0.0, seed=1)
    assert np.array_equal(poses, NAO.nominal[None])


def test_noise_is_bounded_seeded_and_spares_the_neck() -> None:
    """Each joint moves by at most the noise; the seed decides."""
    actuation = Actuation(NAO)
    poses = draw_start_poses(actuation, 200, 2.0, seed=1)
    offsets = np.rad2deg(poses - NAO.nominal)
    assert np.abs(offsets).max() <= 2.0
    assert np.abs(offsets[:, 2:]).max(axis=0).min() > 1.5
    assert (offsets[:, :2] == 0.0).all()
    assert np.array_equal(poses, draw_start_poses(actuation, 200, 2.0, seed=1))
    assert not np.array_equal(poses, draw_start_poses(actuation, 200, 2.0, seed=2))


def test_choice_depends_on_nothing_but_seed_environment_and_episode() -> None:
    """A choice does not depend on the other environments in the call."""
    everyone = choose_starts(7, 256, np.arange(64), np.full(64, 3))
    alone = choose_starts(7, 256, np.array([20]), np.array([3]))
    assert everyone[20] == alone[0]
    assert ((everyone >= 0) & (everyone < 256)).all()


def test_choice_spreads_over_all_starts() -> None:
    """No start is much more frequent than another, over environments and over episodes."""
    for environments, episodes in (
        (np.arange(25_600), np.zeros(25_600, int)),
        (np.zeros(25_600, int), np.arange(25_600)),
    ):
        counts = np.bincount(choose_starts(0, 256, environments, episodes), minlength=256)
        assert counts.min() > 50
        assert counts.max() < 160


def test_restored_start_is_the_state_after_sixty_cycles() -> None:
    """Restoring a settled snapshot and simulating 60 cycles into the start pose give the same state, bit for bit."""
    model = nao_model.model(0)
    poses = draw_start_poses(Actuation(NAO), 3, 2.0, seed=5)

    simulated = BatchSimulator(3, robot_type=0)
    simulated.reset()
    simulated.beam(np.array([*START, model.standing_height + DROP_M]), -90.0)
    for _ in range(60):
        error = poses - np.deg2rad(simulated.perceptors.joint_angles)
        simulated.step(np.clip(7.0 * error, -model.max_speed, model.max_speed))

    restored = EmbeddedSimulator(NAO, 4)
    restored.load_starts(Starts(poses, START))
    rng = np.random.default_rng(0)
    for _ in range(20):
        restored.step(rng.uniform(-1, 1, (4, 22)))
    restored.start(np.array([3, 0, 1]), np.array([2, 0, 1]))
    assert np.array_equal(restored.snapshot()[[0, 1, 3]], simulated.snapshot())
    assert np.array_equal(restored.perceptors["joint_angles"][[0, 1, 3]], simulated.perceptors.joint_angles)
    assert np.array_equal(restored.truth.torso_position[[0, 1, 3]], simulated.truth.torso_position)


@pytest.mark.parametrize("robot_type", range(5))
def test_robots_stand_at_the_start_facing_the_finish(robot_type: int) -> None:
    """Every type settles upright at x = -14, feet on the ground, front towards +x."""
    robot = robots.get(f"nao-{robot_type}")
    simulator = EmbeddedSimulator(robot, 8)
    simulator.load_starts(Starts(draw_start_poses(Actuation(robot), 8, 2.0, seed=0), START))
    simulator.start(np.arange(8), np.arange(8))
    position, rotation = simulator.truth.torso_position, simulator.truth.torso_rotation
    assert np.abs(position[:, :2] - [-14.0, 0.0]).max() < 0.1
    assert position[:, 2].min() > 0.33
    assert rotation[:, 2, 2].min() > 0.97
    assert rotation[:, 0, 1].min() > 0.97
    assert not np.isnan(simulator.perceptors["foot_left"]).any()
    assert not np.isnan(simulator.perceptors["foot_right"]).any()


def test_start_before_the_poses_are_known_is_refused() -> None:
    """The message states what to do."""
    simulator = EmbeddedSimulator(NAO, 1)
    with pytest.raises(RuntimeError, match="load_starts"):
        simulator.start(np.array([0]), np.array([0]))


def test_missing_server_program_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message names the setting and what to do."""
    monkeypatch.setenv("NAOSPRINT_SIMSERVER", "/nowhere/rcssserver3d")
    server = kinds.get("server")
    with pytest.raises(FileNotFoundError, match=r"NAOSPRINT_SIMSERVER.*'/nowhere/rcssserver3d'"):
        server.open(NAO, 1, server.parameters(NAO)(name="server"), RuntimeOptions(max_server_failures=0))
