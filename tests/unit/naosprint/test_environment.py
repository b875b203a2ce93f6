"""Test the sprint task: rewards and ends of episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from naospec import STANDING_HEIGHT_M, Task, TrainingSpec, task
from naosprint.environment import SprintBatch, open_training_batch
from naosprint.simulator import EmbeddedSimulator
from naosprint.starts import draw_start_poses

FALL = np.ones(20)
FALL[8:] = np.tile([0.0, 0.0, 1.0, -1.0, -1.0, 0.0], 2)


def batch_of(
    n: int, the_task: Task, *, fall_height_m: float = 0.27, reward_scale: float = 100.0, **penalties: float
) -> SprintBatch:
    """Return n standard robots at their starts."""
    simulator = EmbeddedSimulator(n, robot_type=0, task=the_task)
    batch = SprintBatch(
        simulator, the_task, robot_type=0, fall_height_m=fall_height_m, reward_scale=reward_scale, **penalties
    )
    batch.load_starts(draw_start_poses(batch.actuation, n, 2.0, seed=0))
    batch.restart(np.arange(n), np.arange(n))
    return batch


def hold(batch: SprintBatch) -> np.ndarray:
    """Return the action that keeps the start pose."""
    low, high = batch.actuation.low_rad, batch.actuation.high_rad
    pose = batch.actuation.angles(np.rad2deg(batch.actuation.start_pose())[None])
    return np.repeat(2 * (pose - low) / (high - low) - 1, batch.n, axis=0)


def test_reward_is_forward_displacement_times_scale() -> None:
    """The rewards of an episode add up to the distance covered."""
    batch = batch_of(4, task("sprint1"))
    x = batch.simulator.truth.torso_position[:, 0].copy()
    total = np.zeros(4)
    rng = np.random.default_rng(0)
    for _ in range(30):
        before = batch.simulator.truth.torso_position[:, 0].copy()
        batch.step(rng.uniform(-1, 1, (4, 20)))
        after = batch.simulator.truth.torso_position[:, 0]
        np.testing.assert_allclose(batch.rewards, 100.0 * (after - before), atol=1e-9)
        total += batch.rewards
    moved = batch.simulator.truth.torso_position[:, 0] - x
    np.testing.assert_allclose(total, 100.0 * moved, atol=1e-9)
    np.testing.assert_allclose(batch.displacement, moved, atol=1e-12)


def test_penalties_take_from_the_reward_what_drift_and_fall_cost() -> None:
    """A step costs the metres it leads away from the line, and pays them back on the way home; a fall costs once."""
    batch = batch_of(4, task("sprint1"), drift_penalty=0.5, fall_penalty_m=3.0)
    rng = np.random.default_rng(0)
    homeward = 0
    for _ in range(200):
        before = batch.simulator.truth.torso_position.copy()
        batch.step(0.3 * rng.uniform(-1, 1, (4, 20)) + 0.7 * FALL)
        after = batch.simulator.truth.torso_position
        away = np.abs(after[:, 1]) - np.abs(before[:, 1])
        fell = after[:, 2] < 0.27
        np.testing.assert_allclose(
            batch.rewards, 100.0 * (after[:, 0] - before[:, 0] - 0.5 * away - 3.0 * fell), atol=1e-9
        )
        homeward += int((away < 0.0).sum())
        if fell.any():
            break
    assert fell.any()
    assert homeward > 0


def test_practised_starts_are_cut_off_after_two_seconds() -> None:
    """Only the environments that practise, and as a cut, after which something could still have come."""
    batch = batch_of(4, task("sprint2"))
    batch.practises[:2] = True
    for step in range(1, 101):
        batch.step(hold(batch))
        assert not batch.terminated.any()
        assert batch.truncated.tolist() == [step == 100, step == 100, False, False]


def test_share_of_environments_that_practise_starts(make_spec: Callable[..., TrainingSpec]) -> None:
    """The share is the specification's."""
    batch, _ = open_training_batch(make_spec(n_envs=8, n_steps=8, batch_size=64, start_practice=0.25))
    assert batch.practises.tolist() == [True] * 2 + [False] * 6
    batch.close()


def test_standing_robot_goes_on() -> None:
    """Holding the start pose neither falls nor ends the episode."""
    batch = batch_of(4, task("sprint1"))
    for _ in range(100):
        batch.step(hold(batch))
    assert not batch.terminated.any()
    assert not batch.truncated.any()
    assert (batch.steps == 100).all()


def test_fall_ends_the_episode_at_the_first_step_below_the_height() -> None:
    """Terminated exactly when the torso is below the minimum height."""
    batch = batch_of(4, task("sprint1"))
    for _ in range(200):
        batch.step(np.tile(FALL, (4, 1)))
        low = batch.simulator.truth.torso_position[:, 2] < 0.27
        assert np.array_equal(batch.terminated, low)
        assert np.array_equal(batch.fallen, low)
        if low.all():
            break
    assert low.all()


def test_erect_limit_ends_it_earlier() -> None:
    """The higher limit is met first."""
    ends = {}
    for limit in (0.27, 0.33):
        batch = batch_of(1, task("sprint1"), fall_height_m=limit)
        while not batch.terminated[0]:
            batch.step(FALL[None])
        ends[limit] = int(batch.steps[0])
    assert ends[0.33] < ends[0.27]


def test_finish_line_ends_the_episode() -> None:
    """Passing the line is an end without a fall."""
    near = replace(task("sprint1"), finish_x_m=-14.2)
    batch = batch_of(4, near)
    batch.step(hold(batch))
    assert batch.terminated.all()
    assert batch.arrived.all()
    assert not batch.fallen.any()


def test_horizon_of_task_two_is_an_end_and_that_of_task_one_a_cut() -> None:
    """Only a time limit that is no part of the task truncates."""
    for name, terminal in (("sprint1", False), ("sprint2", True)):
        batch = batch_of(2, replace(task(name), max_steps=3))
        for _ in range(3):
            assert not (batch.terminated | batch.truncated).any()
            batch.step(hold(batch))
        assert batch.terminated.all() == terminal
        assert batch.truncated.all() != terminal
        assert not batch.fallen.any()


def test_inactive_robots_stay_where_they_are() -> None:
    """A masked robot is not moved."""
    batch = batch_of(3, task("sprint1"))
    before = batch.simulator.truth.torso_position.copy()
    batch.step(np.tile(FALL, (3, 1)), np.array([True, False, True]))
    after = batch.simulator.truth.torso_position
    assert np.array_equal(after[1], before[1])
    assert not np.array_equal(after[0], before[0])


def test_state_and_load_state_continue_bit_for_bit() -> None:
    """Another batch takes over in the middle of an episode."""
    first, second = batch_of(3, task("sprint1")), batch_of(3, task("sprint1"))
    rng = np.random.default_rng(3)
    for _ in range(10):
        first.step(rng.uniform(-1, 1, (3, 20)))
    second.load_state(first.state())
    for _ in range(10):
        actions = rng.uniform(-1, 1, (3, 20))
        assert np.array_equal(first.step(actions), second.step(actions))
        assert np.array_equal(first.rewards, second.rewards)


def test_height_above_the_start_pose_is_refused(make_spec: Callable[..., TrainingSpec]) -> None:
    """A limit between crouching and standing would end every episode at once."""
    with pytest.raises(ValueError, match="min_height"):
        open_training_batch(make_spec(min_height=0.38))


def test_standing_heights_of_the_specification_are_the_simulators() -> None:
    """The specification's small table agrees with the robots."""
    from naosim.robots import nao_model

    for robot_type, height in STANDING_HEIGHT_M.items():
        assert nao_model.model(robot_type).standing_height == pytest.approx(height, abs=1e-9)
